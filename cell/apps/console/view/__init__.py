"""What the page shows of the cell: scene, pictures, readings, runs."""
