"""A run from its start to its end: the handle that one holds, its folder, its events, what it may resume from."""
