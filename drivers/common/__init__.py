"""What several kinds of drivers share."""
