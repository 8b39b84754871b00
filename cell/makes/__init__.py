"""Makes of devices: what a make is, the table of makes, and their records in `cell.toml`."""
