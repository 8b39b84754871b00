"""The operator's screen: a page in the browser, and the server that shows it the cell and takes its commands."""
