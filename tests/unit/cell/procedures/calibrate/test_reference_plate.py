"""The plate on the claw is looked at by a simulated head: where its edge is, and what has slipped since."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.devices.simulated.direct import VirtualCell
from cell.measure.calibration.drift.reference_plate import Edge, PlateLine
from cell.measure.calibration.drift.slip import Slip, slip_since
from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.light_plane import LightPlane
from cell.procedures.calibrate import reference_plate
from cell.procedures.calibrate.reference_plate import SPEED, look_at_edge, require_edge, require_reference_plate
from cell.procedures.steps.laser_sweep import unwatched
from drivers.errors import DeviceFault, RefusedError
from drivers.interfaces import Frame
from sim_backends.optics.scene import LaserOptics

CONFIG = load_config(None)


def let_go(what: str, frame: Frame) -> None:
    """No picture is kept."""


def looked(cell: VirtualCell, before: PlateLine | None = None) -> PlateLine:
    now = require_reference_plate(CONFIG, cell.devices, let_go)
    if before is not None:
        return require_edge(CONFIG, cell.devices, let_go, before, now)
    return replace(now, edge=look_at_edge(CONFIG, cell.devices, let_go, now, None))


@pytest.fixture(scope="module")
def cell() -> tuple[VirtualCell, PlateLine, Callable[[PlateLine], Slip]]:
    """A simulated cell, what it shows of the plate, and how a later look is held against that."""
    cell = VirtualCell(CONFIG, 3, "nominal")
    cell.devices.vehicle.brake()
    cell.devices.rail.home().wait(60.0)
    cell.devices.interlocks.work_with(CONFIG.calibration_hash())
    before = looked(cell)
    scene = cell.world.scene
    lens = scene.scan_lens
    camera = CameraModel(640, 480, lens.fx, lens.fy, lens.cx, lens.cy, lens.dist)
    plane = LightPlane.of(scene.light_plane_normal, scene.light_plane_distance)
    return cell, before, lambda now: slip_since(before, now, camera, plane, scene.rail_direction)


def test_the_edge_is_where_the_world_has_it(cell):
    world, before = cell[0].world, cell[1]
    world.rail.carriage(0.0)
    scene, plate = world.scene, world.scene.drawing.cell.witness
    edge = np.linalg.inv(scene.flange_from_scan_camera) @ plate @ np.array([0.0065, 0.0, 0.0, 1.0])
    # The way of the carriage, in the camera's frame, until the edge lies in the light plane.
    way = (edge[:3] @ scene.light_plane_normal - scene.light_plane_distance) / (
        scene.rail_direction @ scene.light_plane_normal
    )
    assert before.edge.place == pytest.approx(way / (1 + scene.rail_lead_error), abs=2e-5)
    # What comes later here is the carriage, by the play of its screw.
    assert before.edge.lag == pytest.approx(scene.rail_backlash / (2 * SPEED), abs=2e-3)


def slipped(virtual: VirtualCell, moved: tuple[float, float], monkeypatch: pytest.MonkeyPatch) -> None:
    """The head has slipped so far, m, until the test ends."""
    scene, off = virtual.world.scene, np.eye(4)
    off[:2, 3] = moved
    there = scene.flange_from_scan_camera @ off
    monkeypatch.setattr(virtual.world, "scene", replace(scene, flange_from_scan_camera=there))


@pytest.mark.parametrize("moved", [(0.0, 0.0), (0.12e-3, 0.0), (-0.1e-3, 0.15e-3)])
def test_a_head_that_has_slipped_is_seen_to_hundredths(cell, moved: tuple[float, float], monkeypatch):
    virtual, before, since = cell
    slipped(virtual, moved, monkeypatch)
    slip = since(looked(virtual, before))
    assert slip.shift == pytest.approx(moved, abs=2.5e-5)
    assert abs(slip.lag) < 3e-3 and not slip.hidden


def test_a_head_that_has_slipped_far_is_refused_with_the_next_step(cell, monkeypatch):
    virtual, before, _ = cell
    slipped(virtual, (1e-3, 0.0), monkeypatch)
    with pytest.raises(RefusedError, match=r"slipped.*cell calibrate"):
        looked(virtual, before)


def test_auto_gain_is_no_slip(cell, monkeypatch):
    virtual, before, _ = cell
    render = virtual.world.render

    def up_to_200(camera: str, t_mid: float, exposure: float) -> np.ndarray:
        image = render(camera, t_mid, exposure).astype(float)
        return np.clip(image * np.clip(200.0 / np.percentile(image, 99.9), 0.2, 8.0), 0, 255).astype(np.uint8)

    monkeypatch.setattr(virtual.world, "render", up_to_200)
    with pytest.raises(RefusedError, match=r"times as bright.*auto gain.*off"):
        looked(virtual, before)


def test_a_laser_that_has_turned_is_no_slip(cell, monkeypatch):
    virtual, before, since = cell
    world, scene = virtual.world, virtual.world.scene
    drifted = replace(scene, workshop=replace(scene.workshop, pointing=0.4e-3))
    monkeypatch.setattr(world._cameras, "_shown", (drifted, *world._cameras._shown[1:]))
    world.stand(1e5)
    assert since(looked(virtual, before)).size < 2.5e-5


def test_pictures_that_are_paired_one_off_are_seen(cell, monkeypatch):
    virtual, before, since = cell
    camera = virtual.scan_camera.model
    monkeypatch.setattr(camera, "spec", replace(camera.spec, latency=camera.spec.latency + 1 / 30))
    slip = since(looked(virtual, before))
    assert slip.lag == pytest.approx(1 / 30, abs=3e-3)
    assert abs(slip.along) < 2.5e-5
    with pytest.raises(RefusedError, match=r"pictures come 3\d\.\d ms later"):
        slip.require()


def test_a_laser_that_flickers_is_named_before_it_looks_like_a_slip(cell, monkeypatch):
    cameras, clock = cell[0].world._cameras, cell[0].devices.clock
    laser, begun = cameras.laser, clock.now()

    def flickers(warm: float) -> LaserOptics:
        now = laser(warm)
        return replace(now, brightness=(0.75 + 0.25 * np.cos(9.0 * (clock.now() - begun))) * now.brightness)

    monkeypatch.setattr(cameras, "laser", flickers)
    with pytest.raises(RefusedError, match=r"\d\.\d times as bright in one passage .*: the laser flickers"):
        looked(cell[0], cell[1])


@pytest.mark.parametrize("share", [0.0, 0.4, 0.7])
def test_a_laser_that_goes_out_or_dims_for_one_passage_is_named(share: float):
    places = np.linspace(0.0, 1.2e-3, 18)
    light = 19.0 / (1.0 + np.exp((places - 0.6e-3) / 4e-5)) + np.random.default_rng(0).normal(0.0, 0.1, 18)
    whole, dim = (places, light, light), (places, light, light.copy())
    dim[2][: 3 if share == 0.0 else None] *= share
    reference_plate._require_steady((whole, whole), 1.0)
    for passages in ((whole, dim), (dim, whole)):
        with pytest.raises(RefusedError, match="the laser flickers"):
            reference_plate._require_steady(passages, 1.0)


def test_pictures_lost_at_the_edge_make_neither_a_lag_nor_a_slip(cell, monkeypatch):
    virtual, before, since = cell
    camera, seen, light = virtual.scan_camera.model, [], reference_plate._light

    def lose(after: Callable[[int], bool]) -> PlateLine:
        def taken(image: np.ndarray, witness: PlateLine) -> np.ndarray:
            seen.append(image)
            if after(len(seen)):
                camera.fault("camera.frame_loss", 1)
            return light(image, witness)

        seen.clear()
        monkeypatch.setattr(reference_plate, "_light", taken)
        return require_edge(CONFIG, virtual.devices, let_go, before, replace(before, edge=None))

    lose(lambda k: False)
    undisturbed = len(seen)
    # The line leaves the plate at the middle of each pass.
    slip = since(lose(lambda k: k in (undisturbed // 4, undisturbed // 4 + 1)))
    assert len(seen) > 1.3 * undisturbed, "once more"
    assert abs(slip.lag) < 3e-3 and abs(slip.along) < 2.5e-5
    with pytest.raises(
        RefusedError, match=r"pictures were lost each of the 3 times.*open by \d\.\d+ mm.*then try again"
    ):
        lose(lambda k: k % 4 == 0)


@pytest.mark.parametrize("most_hz", [16.0, 10.0])
def test_a_slower_camera_sees_the_edge_at_the_same_place(cell, most_hz: float, monkeypatch):
    virtual, before, _ = cell
    camera = virtual.scan_camera.model
    monkeypatch.setattr(camera, "spec", replace(camera.spec, frame_rate_max=most_hz))
    edge = look_at_edge(CONFIG, virtual.devices, let_go, before, None)
    assert edge.place == pytest.approx(before.edge.place, abs=1e-5)


def test_an_end_of_the_line_that_is_covered_is_no_shift(cell):
    _, before, since = cell
    columns = before.columns.copy()
    columns[before.rows[-25:]] = np.nan
    slip = since(replace(before, columns=columns))
    assert slip.hidden and slip.across == 0.0 and "covered" in slip.notes[0]


@pytest.mark.parametrize(("low", "high"), [(-9e-3, 9e-3), (-20e-3, 9e-3), (-9e-3, 20e-3), (-20e-3, 20e-3)])
def test_a_slip_across_is_told_only_where_the_picture_holds_both_ends_of_the_line(low: float, high: float):
    camera = CameraModel(640, 480, 1667.0, 1667.0, 319.5, 239.5)
    across = (np.arange(480) - camera.cy) / camera.fy * 0.085

    def plate(head: float) -> PlateLine:
        lit = np.flatnonzero((across + head > low) & (across + head < high))[5:-5]
        columns = np.full(480, np.nan)
        columns[lit] = 200.0
        return PlateLine(0.0, columns, Edge(0.005, 0.0))

    plane = LightPlane.from_baseline(0.035, np.arctan(3.5))
    slip = slip_since(plate(0.0), plate(0.14e-3), camera, plane, np.array([1.0, 0.0, 0.0]))
    assert slip.hidden == (max(-low, high) > 12e-3)
    assert slip.across == pytest.approx(0.0 if slip.hidden else 0.14e-3, rel=0.1)
    assert slip.hidden == ("not in the picture" in slip.notes[-1])


def test_a_job_says_what_its_plate_does_not_show(cell):
    whole = cell[1]
    assert unwatched(whole) == ()
    assert "no edge" in " ".join(unwatched(replace(whole, edge=None)))
    assert "laser.witness" in " ".join(unwatched(None))


def test_it_is_kept_with_the_calibration(cell):
    before = cell[1]
    again = PlateLine.read(before.as_dict())
    assert again is not None and again.edge == before.edge


def test_a_rail_that_lost_so_many_steps_that_the_plate_is_out_of_sight_is_told_as_such():
    cell = VirtualCell(CONFIG, 3, "nominal")
    cell.devices.vehicle.brake()
    cell.devices.rail.home().wait(60.0)
    cell.devices.interlocks.work_with(CONFIG.calibration_hash())
    # The carriage stands 30 mm farther out than it counts.
    cell.devices.rail.move_to(0.03).wait(10.0)
    cell.world.rail.set_position(cell.clock.now(), 0)
    with pytest.raises(DeviceFault, match="lost steps"):
        looked(cell)
