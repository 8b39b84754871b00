"""Stored calibrations: written, read, checked against the configuration, and found for the devices of now."""
