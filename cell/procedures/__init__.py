"""What is done with devices: the six steps, and drives, sweeps and calibrations that they are made of."""
