"""A person at a text terminal: keys as they are pressed and let go of, the jog screen and the watch screen."""
