"""What every room uses and what knows nothing of a cell: units, TOML, addresses, durable files, compiled loops."""
