"""A part with upright walls has room beside them: put down a little to the side it lies on the floor, not on a wall."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_backends.world.bodies.contact import PartContact
from sim_backends.world.bodies.surfaces import Surface

Floats = NDArray[np.float64]


def stairs(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Steps of 3 mm every 5 mm, upright."""
    return 0.003 * np.floor(np.asarray(x) / 0.005), 0.0 * x, 0.0 * y


def test_a_part_put_down_a_little_aside_lies_on_the_floor_of_the_steps() -> None:
    ground = Surface("stairs", stairs, half_x=0.03, half_y=0.02, top=0.02)
    held = np.eye(4)
    held[2, 3] = 0.1
    part = PartContact(ground, np.eye(4), np.linalg.inv(held))
    aside = held.copy()
    aside[0, 3], aside[2, 3] = 1.5e-4, 0.1 + 1e-4
    part.set_claw(False, aside)
    lies = part.part_pose(aside)
    np.testing.assert_allclose(lies[:3, 3], (1.5e-4, 0.0, 0.0), atol=1e-9)
