"""What a cell is told by files: `cell.toml`, job files, obstacles and stored calibrations."""
