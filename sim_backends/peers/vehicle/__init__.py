"""The vehicle on its CAN bus."""
