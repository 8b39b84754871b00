"""`cell doctor`: whether this computer is fit for the cell that a configuration describes. No device is touched."""
