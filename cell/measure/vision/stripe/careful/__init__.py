"""The stripe of pictures that are not ordinary: its profile is learnt, its neighbours and surroundings are looked at."""
