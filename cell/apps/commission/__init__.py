"""`cell commission`: from the crate to the first part, one check after the other, in an order that is safe."""
