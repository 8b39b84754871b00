"""Cameras: the frame stream over TCP, and a folder of recorded pictures."""
