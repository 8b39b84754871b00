"""Cameras on GigE Vision and USB3 Vision, through the library Aravis."""
