"""From observations to a calibration: closed forms, the joint adjustment, and how good it is."""
