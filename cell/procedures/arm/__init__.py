"""The arm in a procedure: moves, poses of its cameras, photographs, first touch and the part in its claw."""
