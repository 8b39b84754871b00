"""Driving the vehicle: its way, its control law, and whether it stands where it should."""
