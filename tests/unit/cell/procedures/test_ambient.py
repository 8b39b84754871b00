"""Ambient light: the exposure that it allows, photographs taken again, and a line that it hides."""

import math
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.camera import CameraModel
from cell.measure.geometry.light_plane import LightPlane
from cell.measure.reconstruction.build import ScanGeometry
from cell.procedures.ambient import MOST_DN, adapted, bearable, in_any_light, meet_light, require_line, shorten
from cell.procedures.sweep.swath import SweepCollector
from drivers.errors import RefusedError
from drivers.interfaces import Frame

CONFIG = load_config(None)


def frame(level: float, exposure: float = 1e-3) -> Frame:
    """A picture of one grey level."""
    image = np.full((480, 640), min(255.0, level), np.uint8)
    return Frame(image, 1, exposure, device_time=0.0, host_time=0.0, received=0.0)


@pytest.fixture
def cell() -> VirtualCell:
    """A cell whose scan camera looks at whatever lies before it, braked."""
    made = VirtualCell(CONFIG, 3, "nominal")
    made.devices.vehicle.brake()
    made.devices.scan_camera.configure(2e-3, 10.0)
    return made


@pytest.mark.parametrize(("level", "share"), [(5, 1.0), (MOST_DN, 1.0), (200, 0.5), (255, 0.25)])
def test_a_picture_that_is_too_bright_asks_for_a_shorter_exposure(level: float, share: float):
    assert bearable(frame(level)) == pytest.approx(share * 1e-3)


def test_a_camera_exposes_no_longer_than_the_light_allows_until_the_next_job(cell: VirtualCell):
    camera, devices = cell.devices.scan_camera, cell.devices
    assert not devices.bright and meet_light(devices) == ()
    shorten(camera, 0.1234e-3)
    assert camera.grab().exposure == pytest.approx(0.12e-3) and devices.bright
    camera.configure(2e-3, 10.0)
    assert camera.grab().exposure == pytest.approx(0.12e-3)
    assert "0.12 ms" in meet_light(devices)[0]
    devices.forget_ambient_light()
    assert camera.longest_exposure == math.inf and not devices.bright
    camera.configure(2e-3, 10.0)
    assert camera.grab().exposure == pytest.approx(2e-3)


def test_a_camera_that_cannot_expose_so_briefly_refuses_and_names_the_light(cell: VirtualCell):
    with pytest.raises(RefusedError, match=r"ambient light whitens the pictures of scan_camera.*as short as 0\.0"):
        shorten(cell.devices.scan_camera, 1e-6)


def test_the_exposure_follows_what_the_camera_sees(cell: VirtualCell, monkeypatch):
    camera = cell.devices.scan_camera
    monkeypatch.setattr(camera, "grab", lambda: frame(1e6 * camera.longest_exposure, camera.longest_exposure))
    assert adapted(camera, frame(255.0, 2e-3)).exposure == pytest.approx(0.12e-3)


def test_a_photograph_that_is_refused_and_partly_white_is_taken_again(cell: VirtualCell):
    camera, taken = cell.devices.target_camera, []
    camera.configure(8e-3, 10.0)

    def take(white: float) -> float:
        taken.append(camera.grab().exposure)
        if len(taken) < 3:
            raise RefusedError("no board").showing(seen={"frame": frame(white, taken[-1])})
        return taken[-1]

    assert in_any_light(camera, lambda: take(255.0)) == pytest.approx(0.5e-3)
    taken.clear()
    with pytest.raises(RefusedError, match="no board"):
        in_any_light(camera, lambda: take(200.0))
    assert len(taken) == 1


def test_a_line_that_shows_in_few_rows_is_hidden():
    lit = frame(110.0)
    require_line(np.full(100, 0.4), lit, np.full(50, 9.0))
    with pytest.raises(RefusedError, match=r"110 of 255 .* exposure of 1\.00 ms.*9 above it in 10 %") as refused:
        require_line(np.full(100, 0.1), lit, np.full(50, 9.0))
    assert "scan_camera.filter" in str(refused.value)
    assert refused.value.numbers[0].value == pytest.approx(10.0)


def test_white_pictures_of_a_bright_sweep_are_counted_and_not_looked_at():
    camera = CameraModel(640, 480, 1667.0, 1667.0, 319.5, 239.5, (0.0, 0.0, 0.0, 0.0, 0.0))
    plane = LightPlane.of((1.0, 0.0, -1 / 3.5), -0.035)
    geometry = ScanGeometry(camera, plane, np.array([1.0, 0.0, 0.0]), pin.SE3.Identity())
    collector = SweepCollector(geometry, load_job("pot")[0].scan, lambda frame, cut: None, lambda share, text: None)
    collector.notes = ("ambient light",)
    collector.see(frame(255.0))
    collector.see(replace(frame(120.0), frame_id=2))
    assert (collector.white, collector.counts) == (1, [0, 0]) and collector.whitest is not None
