"""The placement surfaces: what a registration and a scan may rely on."""

import numpy as np
import pytest

from sim_backends.world.bodies.surfaces import SURFACES, mesh, surface

NAMES = sorted(SURFACES)


def grid(name: str, margin: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    half_x, half_y = surface(name).half_x - margin, surface(name).half_y - margin
    x, y = np.meshgrid(np.linspace(-half_x, half_x, 141), np.linspace(-half_y, half_y, 73))
    return x.ravel(), y.ravel()


@pytest.mark.parametrize("name", NAMES)
def test_slopes_are_the_derivatives_of_the_height(name: str):
    x, y = grid(name, 0.001)
    _, gx, gy = surface(name).relief(x, y)
    step = 1e-7
    by_x = (surface(name).height(x + step, y) - surface(name).height(x - step, y)) / (2 * step)
    by_y = (surface(name).height(x, y + step) - surface(name).height(x, y - step)) / (2 * step)
    assert np.abs(gx - by_x).max() < 1e-7 and np.abs(gy - by_y).max() < 1e-7


@pytest.mark.parametrize("name", NAMES)
def test_mesh_lies_on_the_closed_form_and_closes_down_to_the_table(name: str):
    made = mesh(name)
    x, y, z = made.vertices.T
    top = z > 0
    assert abs(len(made.triangles) - 80_000) < 3_000
    assert np.abs(z[top] - surface(name).height(x[top], y[top])).max() < 1e-12
    corners = made.vertices[made.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[(corners[:, :, 2] > 0).all(axis=1) & (np.abs(normals[:, 2]) > 1e-12), 2] > 0).all()
    # A closed surface but for its bottom, whose vector area is the footprint's.
    assert normals.sum(axis=0) / 2 == pytest.approx(
        [0.0, 0.0, 4 * surface(name).half_x * surface(name).half_y], abs=1e-12
    )


def test_unknown_names_and_coarse_meshes_are_refused():
    with pytest.raises(ValueError, match="panel, pot, seat"):
        surface("vase")
    with pytest.raises(ValueError, match="100 or more"):
        mesh("pot", 10)
