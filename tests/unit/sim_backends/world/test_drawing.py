"""Promises of `sim_backends.world.drawing`."""

import numpy as np
import pytest

from sim_backends.world import drawing
from sim_backends.world.drawing import STOCK, read
from sim_backends.world.scene import draw


def test_a_drawing_survives_its_text():
    assert read(STOCK.as_json()).as_json() == STOCK.as_json()
    with pytest.raises(ValueError, match="no drawing of a cell"):
        read('{"cell": 3}')


def test_the_ideal_world_is_the_nominal_geometry():
    scene = draw(11, "ideal")
    assert scene.world_from_surface == pytest.approx(drawing.WORLD_FROM_PLACE)
    assert scene.flange_from_scan_camera == pytest.approx(drawing.FLANGE_FROM_SCAN_CAMERA)
    assert scene.flange_from_part == pytest.approx(drawing.FLANGE_FROM_PART)
    # Where the light plane meets the optical axis: l tan θ = 122.5 mm (paper, equation 6; docs/explanation/theory.md,
    # section 2).
    assert scene.light_plane_distance / scene.light_plane_normal[2] == pytest.approx(0.1225)
    assert scene.scan_lens.fx == pytest.approx(0.008 / 4.8e-6)
    assert scene.scan_lens.dist == (0, 0, 0, 0, 0)


def test_the_board_faces_the_vehicle_and_up_with_its_centre_where_the_drawing_says():
    place_from_board = drawing.PLACE_FROM_BOARD
    centre = place_from_board @ [0.08, 0.06, 0.0, 1.0]
    assert centre[:3] == pytest.approx([0.10, 0.32, 0.12])
    assert -place_from_board[:3, 2] == pytest.approx([-np.sqrt(0.5), 0.0, np.sqrt(0.5)])
    assert np.linalg.det(place_from_board[:3, :3]) == pytest.approx(1.0)
