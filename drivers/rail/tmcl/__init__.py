"""The rail on a TMCL stepper module."""
