"""Programs for people: the command line, the console, commissioning, new jobs, calibration from recordings."""
