"""The console's server, in a process of its own: pages, their sessions and what they may ask."""
