"""`cell qualify`: a job on many simulated worlds, and what that says of the real cell. Needs the extra `qualify`."""
