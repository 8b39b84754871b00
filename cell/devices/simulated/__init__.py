"""Simulated devices: a world in another process or in this one, beside real devices or alone."""
