"""One picture of a scene: ambient light on boards, planes and meshes, the laser stripe with speckle, the sensor."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.boards import render_rectangle
from sim_backends.optics.camera import CameraOptics, sensor
from sim_backends.optics.laser.profile import add_speckled
from sim_backends.optics.laser.stripe import render_stripe
from sim_backends.optics.lighting import add_sun, ambient_dn, fill_background, gain_parameters, render_mesh
from sim_backends.optics.scene import BoardInstance, LaserOptics, Light, MeshInstance, PlaneInstance, SceneObject

Image = NDArray[np.float32]


def render(
    optics: CameraOptics, scene: Sequence[SceneObject], laser: LaserOptics | None, exposure: float,
    rng: np.random.Generator, light: Light | None = None, speckle: np.random.Generator | None = None,
) -> NDArray[np.uint8]:  # fmt: skip
    """Picture (height, width) uint8 that the camera takes of `scene` with `exposure` seconds; `laser` None is off.
    `speckle` draws the laser's speckle, which stays as it is while nothing moves; None: `rng`."""
    return sensor(expected_image(optics, scene, laser, exposure, speckle or rng, light=light), optics, rng)


def expected_image(
    optics: CameraOptics, scene: Sequence[SceneObject], laser: LaserOptics | None, exposure: float,
    rng: np.random.Generator, light: Light | None = None,
) -> Image:  # fmt: skip
    """The light that `render` puts on the sensor, (height, width) float32 in DN, before noise and saturation. Planes
    lie behind everything else, then the farther object is drawn first. `rng` draws the speckle only."""
    if not exposure > 0:
        raise ValueError(f"exposure {exposure} s: must be above 0 s")
    light = Light() if light is None else light
    image = np.empty((optics.height, optics.width), dtype=np.float32)
    fill_background(image, ambient_dn(optics, light, exposure) * light.surroundings, gain_parameters(optics, light))
    for instance in sorted(scene, key=_order):
        if isinstance(instance, MeshInstance):
            render_mesh(image, optics, instance, light, exposure)
        else:
            render_rectangle(image, optics, instance, light, exposure)
    for sun in light.suns:
        add_sun(image, optics, sun)
    if laser is not None:
        stripe = np.zeros_like(image)
        touched = render_stripe(stripe, optics, laser, list(scene), exposure)
        add_speckled(image, stripe, touched, contrast=laser.speckle_contrast, grain_px=laser.speckle_px, rng=rng)
    return image


def _order(instance: SceneObject) -> tuple[bool, float]:
    if isinstance(instance, PlaneInstance):
        return False, -float(np.linalg.norm(instance.camera_from_plane[:3, 3]))
    if isinstance(instance, BoardInstance):
        return True, -float(np.linalg.norm(instance.camera_from_board[:3, 3]))
    return True, -float(np.linalg.norm(instance.camera_from_mesh[:3, 3]))
