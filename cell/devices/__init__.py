"""The devices of one cell: connected, gated, stopped together, diagnosed, jogged; real or simulated."""
