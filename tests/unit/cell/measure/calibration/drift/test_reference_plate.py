"""The witness of the laser's pointing: what it says of a turned light plane, by pictures of the simulator's optics."""

from dataclasses import replace

import numpy as np
import pytest

from cell.measure.calibration.drift.reference_plate import LARGEST_RAD, PlateLine, Pointing, pointing, rolled, turned
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.light_plane import LightPlane, triangulate
from drivers.errors import RefusedError
from sim_backends.optics.camera import CameraOptics
from sim_backends.optics.laser.stripe import crossings
from sim_backends.optics.scene import LaserOptics, PlaneInstance

OPTICS = CameraOptics(640, 480, 1667.0, 1667.0, 319.5, 239.5)
CAMERA = CameraModel(640, 480, 1667.0, 1667.0, 319.5, 239.5)
LASER = LaserOptics()
PLANE = LightPlane.of(LASER.normal, LASER.distance)
EXIT = np.array([-0.035, 0.0, 0.0])
SIGMA, WALL = 0.02, 0.130


def pointed(angle: float) -> LaserOptics:
    """The simulator's laser turned by `angle` about its exit point and the camera's y axis."""
    nx, ny, nz = LASER.normal
    normal = (nx * np.cos(angle) + nz * np.sin(angle), ny, nz * np.cos(angle) - nx * np.sin(angle))
    return replace(LASER, normal=normal, distance=float(np.dot(normal, LASER.origin)))


def rolled_laser(angle: float) -> LaserOptics:
    """The simulator's laser turned by `angle` about the middle of its beam."""
    normal, stripe = np.array(LASER.normal), np.array([0.0, 1.0, 0.0])
    nx, ny, nz = (float(v) for v in np.cos(angle) * normal + np.sin(angle) * stripe)
    return replace(LASER, normal=(nx, ny, nz), distance=float(np.dot((nx, ny, nz), LASER.origin)))


def seen(
    angle: float, seed: int, shift: float = 0.0, rows: int = 480, off: float = 0.0, laser: LaserOptics | None = None
) -> PlateLine:
    """The line on a plate 85 mm away and `off` m more, tilted by 3°, with noise, the whole picture `shift` px aside."""
    plate = np.eye(4)
    plate[:3, 3] = -0.0107, 0.0, 0.085 + off
    tilt = np.deg2rad(3.0)
    plate[:3, 0] = np.cos(tilt), 0.0, np.sin(tilt)
    plate[:3, 2] = -np.sin(tilt), 0.0, np.cos(tilt)
    found = crossings(OPTICS, laser or pointed(angle), PlaneInstance(plate, (0.02, 0.012)))
    columns = np.full(480, np.nan)
    columns[found.rows] = found.columns + shift + SIGMA * np.random.default_rng(seed).standard_normal(len(found.rows))
    columns[rows:] = np.nan
    return PlateLine(0.0, columns)


def wall(laser: LaserOptics, now: LightPlane, shift: float = 0.0) -> list[Array]:
    """Points on a wall 130 mm away by the plane of the calibration and by `now`, the picture `shift` px aside."""
    pose = np.eye(4)
    pose[2, 3] = WALL
    there = crossings(OPTICS, laser, PlaneInstance(pose, (0.2, 0.2)))
    pixels = np.column_stack([there.columns + shift, there.rows])
    return [triangulate(CAMERA, plane, pixels)[0] for plane in (PLANE, now)]


@pytest.mark.parametrize("angle", [0.5e-3, -0.2e-3, 0.0])
def test_the_turn_is_found_and_its_deviation_is_right(angle: float):
    off = []
    for seed in range(6):
        found = pointing(seen(0.0, seed), seen(angle, 100 + seed), CAMERA, PLANE, EXIT)
        off.append(abs(found.turn) - abs(angle))
        # A plate that is off by 20 µm, 85 mm away, with the laser 35 mm beside the camera; the turn, where it is noted.
        plate = 20e-6 * 0.035 / 0.085**2
        assert found.sigma == pytest.approx(np.hypot(plate, angle), rel=0.15)
    assert np.sqrt(np.mean(np.square(off))) < 0.025e-3


def test_depths_are_right_again_on_the_turned_plane():
    found = pointing(seen(0.0, 1), seen(0.5e-3, 2), CAMERA, PLANE, EXIT)
    before, after = wall(pointed(0.5e-3), turned(PLANE, EXIT, found.turn))
    assert np.abs(before[:, 2] - WALL).mean() > 0.2e-3
    assert np.abs(after[:, 2] - WALL).mean() < 0.02e-3


def test_a_shifted_picture_does_no_harm_to_depths_either():
    found = pointing(seen(0.0, 3), seen(0.0, 4, shift=0.3), CAMERA, PLANE, EXIT)
    before, after = wall(LASER, turned(PLANE, EXIT, found.turn), shift=0.3)
    assert np.abs(after[:, 2] - WALL).mean() < 0.2 * np.abs(before[:, 2] - WALL).mean()


@pytest.mark.parametrize("turn", [2 * LARGEST_RAD, -2 * LARGEST_RAD])
def test_a_laser_that_was_knocked_is_refused_with_its_angle(turn: float):
    with pytest.raises(RefusedError, match="laser points") as caught:
        pointing(seen(0.0, 5), seen(turn, 6), CAMERA, PLANE, EXIT)
    assert caught.value.numbers[0].unit == "mrad"


@pytest.mark.parametrize("off", [-1e-4, 2e-5, 1.4e-4])
def test_a_plate_that_was_knocked_is_within_what_is_stated(off: float):
    found = pointing(seen(0.0, 1), seen(0.0, 2, off=off), CAMERA, PLANE, EXIT)
    # Nothing has turned.
    assert abs(found.turn) < 1.3 * found.sigma


def test_looks_from_two_places_of_the_rail_are_not_compared():
    before, now = seen(0.0, 1), seen(0.0, 2)
    pointing(before, replace(now, rail=0.04e-3), CAMERA, PLANE, EXIT)
    for rail in (2e-3, -2e-3):
        with pytest.raises(RefusedError, match=rf"rail at {1e3 * rail:.2f} mm, at the calibration at 0\.00 mm"):
            pointing(before, replace(now, rail=rail), CAMERA, PLANE, EXIT)


TURNED = r"line .* is turned by .* mrad.*about its own beam.*cell calibrate"


@pytest.mark.parametrize(
    ("now", "words"),
    [
        (seen(0.0, 2, off=2e-4), r"plate on the claw.*cell calibrate verify"),
        (seen(0.0, 8, rows=150), "witness clean"),
        (seen(0.0, 2, laser=rolled_laser(1e-3)), TURNED),
        (seen(0.0, 2, laser=rolled_laser(-1e-3)), TURNED),
    ],
    ids=["knocked far off", "covered", "turned", "turned back"],
)
def test_a_line_that_says_nothing_of_the_laser_is_refused_with_the_next_step(now: PlateLine, words: str):
    with pytest.raises(RefusedError, match=words):
        pointing(seen(0.0, 1), now, CAMERA, PLANE, EXIT)


def test_it_is_kept_with_the_calibration():
    witness = seen(0.0, 9)
    again = PlateLine.read(witness.as_dict())
    assert np.array_equal(again.columns, witness.columns, equal_nan=True)
    assert PlateLine.read(None) is None
    assert "mrad" in Pointing(0.4e-3, 0.02e-3).words


@pytest.mark.parametrize("angle", [0.3e-3, -0.5e-3])
def test_a_laser_that_rolled_about_its_beam_tilts_nothing_any_more(angle: float):
    """As the paper draws the sheet, a scan would tilt by more than three times the roll."""
    laser = rolled_laser(angle)
    found = pointing(seen(0.0, 1), seen(0.0, 2, laser=laser), CAMERA, PLANE, EXIT)
    assert abs(found.roll) == pytest.approx(abs(angle), abs=0.08e-3)
    assert found.roll_sigma >= abs(found.roll) and "about its beam" in found.notes[-1]
    assert abs(found.turn) < 0.025e-3
    seen_on_wall = wall(laser, rolled(turned(PLANE, EXIT, found.turn), EXIT, found.roll))
    tilts = [abs(np.polyfit(points[:, 1], points[:, 2], 1)[0]) for points in seen_on_wall]
    assert tilts[0] == pytest.approx(3.7 * abs(angle), rel=0.1)
    assert tilts[1] < 0.3e-3


def test_a_line_that_has_not_turned_is_silent_and_its_noise_is_stated():
    found = [pointing(seen(0.0, seed), seen(0.0, 100 + seed), CAMERA, PLANE, EXIT) for seed in range(12)]
    assert all(one.roll == 0.0 and one.notes == () for one in found)
    assert all(0.01e-3 < one.roll_sigma < 0.1e-3 for one in found)
