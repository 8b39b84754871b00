"""The console's end in the process that has the cell: it obeys the page and shows it the cell."""
