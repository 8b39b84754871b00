"""Whether a job fits a cell, told before anything moves."""
