"""Pose inversion."""
