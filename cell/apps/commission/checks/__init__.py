"""The checks of the commissioning, a file for each device."""
