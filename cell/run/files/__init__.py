"""A run's folder: made, written, logged into and read."""
