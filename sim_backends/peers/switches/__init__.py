"""Relay boards on a serial line."""
