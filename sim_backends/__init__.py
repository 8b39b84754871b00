"""One seeded world, one physical model per device in it, one wire-level peer per model.

Independent of the drivers and of the cell: it re-implements protocols and optics from their specifications, so
that an error on one side cannot cancel the same error on the other.
"""
