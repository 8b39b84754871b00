"""A run as one page for a browser and for paper: made of what lies in its folder, and of the runs beside it."""
