"""The other commands, a file for each group."""
