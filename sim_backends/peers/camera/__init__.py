"""Cameras on the network."""
