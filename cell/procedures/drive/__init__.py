"""Driving the vehicle: its way, its control law, and where it stands."""
