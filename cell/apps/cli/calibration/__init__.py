"""`cell calibrate` and its subcommands."""
