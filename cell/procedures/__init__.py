"""What is done with devices: the steps of a job, and drives, sweeps and calibrations that they are made of."""
