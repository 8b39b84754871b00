"""Streams, endings and long runs over the wires."""
