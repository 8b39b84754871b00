"""What `cell watch` shows at a text terminal."""
