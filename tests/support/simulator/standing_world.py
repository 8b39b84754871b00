"""A world whose arm stands wherever a test wants it."""

import numpy as np

from sim_backends.world import drawing
from sim_backends.world.drawing import STOCK
from sim_backends.world.world import World


class StandingWorld(World):
    """An ideal or nominal world whose vehicle stands at the station and whose arm is put wherever a test wants it."""

    def __init__(self, level: str = "ideal", seed: int = 5, surface: str = "pot") -> None:
        super().__init__(seed=seed, level=level, drawing=STOCK.with_surface(surface))
        self.base = drawing.pose((-0.75, 0.0, 0.55), (1, 0, 0), (0, 0, 1))

    def world_from_base(self, t: float) -> np.ndarray:
        return self.base

    def look(
        self, camera: str, world_from_camera: np.ndarray, exposure: float = 0.002, laser: bool = False
    ) -> np.ndarray:
        return self._cameras.picture(camera, world_from_camera, self.base, laser, exposure)
