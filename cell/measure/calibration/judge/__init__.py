"""How good a calibration is, and what is wrong with it: checks that its own fit does not set."""
