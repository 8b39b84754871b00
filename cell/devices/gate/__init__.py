"""The gate through which every command to a device passes: interlocks, their table, and what is checked in a way."""
