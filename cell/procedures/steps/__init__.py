"""The steps of a job, a file each, and what they share."""
