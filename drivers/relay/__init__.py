"""Laser and claw on relay boards that hang on a serial port."""
