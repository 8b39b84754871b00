"""The process in which the vendor library lives, since it can crash or hang."""
