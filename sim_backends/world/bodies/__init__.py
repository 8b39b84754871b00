"""The solids of the world: what collides, what is touched, what is held, and the surfaces."""
