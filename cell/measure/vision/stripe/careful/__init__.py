"""The stripe of pictures that are not ordinary: its profile is learnt, and its surroundings are looked at."""
