"""Reconstruction: outliers and holes."""
