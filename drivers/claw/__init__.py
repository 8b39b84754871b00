"""Grippers with a controller of their own."""
