"""Sweeping the laser: by rail or arm, what comes of it, how it is stored and checked by a second one."""
