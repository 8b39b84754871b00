"""Kinematics, collisions, trajectories and paths of the arm."""
