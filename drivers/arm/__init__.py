"""The arm: Universal Robots e-series through ur-rtde, which runs in a child process of its own."""
