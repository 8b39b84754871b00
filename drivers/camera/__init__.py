"""Cameras: GigE Vision, USB3 Vision, V4L2, the frame stream over TCP, and folders of recorded pictures."""
