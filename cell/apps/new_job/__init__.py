"""A job of one's own from a mesh: what the surface is, how it is swept, and whether that tells its place."""
