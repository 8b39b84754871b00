"""The linear axis that carries the scan head, on a TMCL stepper module."""
