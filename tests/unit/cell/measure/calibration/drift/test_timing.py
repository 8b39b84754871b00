"""How late a camera's stamps come, from sweeps to and fro: on boards projected by OpenCV, and on the simulated cell."""

import time
from contextlib import nullcontext, suppress
from dataclasses import replace

import cv2
import numpy as np
import pinocchio as pin
import pytest

from cell.config.calibrations.finding import find_calibration
from cell.config.calibrations.store import CellCalibration, changed, link_of, save_calibration
from cell.config.cell_config import load_config
from cell.measure.calibration import ScanCalibration
from cell.measure.calibration.drift.evidence import Reference
from cell.measure.calibration.drift.timing import (
    Shutter,
    StampTiming,
    TimedFrame,
    TimedSweep,
    TimesRefused,
    find_shutter,
    find_timing,
    refuse_late,
    refuse_rolling,
    roughly_late,
)
from cell.measure.geometry.camera import CameraModel
from cell.measure.vision.board.view import BoardView, parse_board
from cell.procedures.steps.laser_sweep import times_known
from cell.run.calibration import kept_if_refused
from drivers.errors import CalibrationStale, RefusedError
from tests.unit.cell.config.calibrations.test_store import made
from tests.unit.cell.procedures.sweep.test_sweeping import ERRORS, sweep

CONFIG = load_config(None)
HERE = pin.SE3.Identity()
CAMERA = CameraModel(640, 480, 1667.0, 1667.0, 319.5, 239.5)
BOARD = parse_board("chessboard:9x7:3mm")
FAR_MM = 130.0
MOST_LATE_S, LEAD_M = 2e-3, 2e-3
FOUND = StampTiming(1.4e-3, 0.05e-3, 10e-6, 2e-6, 0.0, 1e-5, 0.0, 1e9, link_of(CONFIG))


def calibration() -> ScanCalibration:
    """A head that looks square at the board, a hair off where the board is, as calibrations are."""
    board = pin.SE3(np.eye(3), np.array([-12e-3 + 2e-4, -9e-3, 1e-3 * FAR_MM + 3e-4]))
    return replace(made().scan, camera=CAMERA, reference=Reference(board, np.eye(27), 1e-4, 1e-4, 1e-5, 1.0, 1.0))


def sweeps(
    seed: int, late: float, play: float = 12e-6, readout: float = 0.0, by_exposure: float = 0.0,
    jitter: float = 0.25e-3, bound: float = 0.25e-3,
) -> list[TimedSweep]:  # fmt: skip
    """Sixteen of them, as the cell makes them, of clocks that are known to ±`bound` s; each sweep's are off by anything
    up to ±`jitter` s."""
    rng = np.random.default_rng(seed)
    corners = BOARD.points()
    swept = []
    fast, slow = [(0.04, 10e-3), (0.04, 5e-3)], [(0.01, 10e-3), (0.01, 5e-3)]
    for speed, exposure in [*fast, slow[0], *fast, slow[1], *fast]:
        for velocity in (speed, -speed):
            off = late + by_exposure * exposure + rng.uniform(-jitter, jitter)
            frames = []
            for read in np.linspace(-0.01, 0.01, 7) + rng.uniform(-1e-3, 1e-3):
                # The screw's own error, which is the same whichever way it is passed.
                screw = 3e-6 * np.sin(2 * np.pi * read / LEAD_M + 1.0)
                true = read - velocity * off - np.sign(velocity) * play / 2 + screw
                place = np.array([-12e-3 - true, -9e-3, 1e-3 * FAR_MM])
                pixels = cv2.projectPoints(corners, np.zeros(3), place, CAMERA.matrix, np.zeros(5))[0].reshape(-1, 2)
                rows = pixels[:, 1] / CAMERA.height - 0.5
                pixels[:, 0] -= velocity * readout * rows * CAMERA.fx / (1e-3 * FAR_MM)
                pixels += rng.normal(0.0, 0.03, pixels.shape)
                seen = BoardView(BOARD, (640, 480), np.arange(len(corners)), pixels, np.full(len(corners), 0.03))
                frames.append(TimedFrame(seen, float(read)))
            swept.append(TimedSweep(velocity, exposure, bound, frames))
    return swept


def timing(swept: list[TimedSweep]) -> StampTiming:
    return find_timing(calibration(), HERE, swept, MOST_LATE_S, LEAD_M, {})


def test_it_is_known_to_a_tenth_of_a_millisecond_and_no_better_than_it_says():
    off = []
    for seed in range(10):
        late = np.random.default_rng(100 + seed).uniform(-0.5e-3, 2e-3)
        found = timing(sweeps(seed, late))
        assert found.sigma < 0.12e-3 and abs(found.readout) < 0.1e-3
        assert found.play == pytest.approx(12e-6, abs=4 * found.play_sigma)
        off.append((found.late - late) / found.sigma)
    assert np.abs(off).max() < 3.5
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 1.5


def test_clocks_that_are_off_alike_in_all_sweeps_are_stated_though_nothing_scatters():
    """A link whose shortest round trip is kept: what it left open once, it leaves open in every sweep."""
    found = timing(sweeps(5, 1e-3 + 0.2e-3, jitter=0.0))
    assert found.sigma == pytest.approx(0.25e-3 / np.sqrt(3), rel=0.1)
    assert abs(found.late - 1e-3) < 2 * found.sigma


@pytest.mark.parametrize(
    ("spoilt", "words"),
    [
        ({"readout": 12e-3}, r"rolling shutter: its last row is exposed 12\.0 ms after"),
        ({"by_exposure": 1.0}, r"1\.\d\d times what an exposure is longer|0\.9\d times what an exposure is longer"),
        ({"by_exposure": 0.5}, r"stamp the start of the exposure"),
        ({"jitter": 1.5e-3}, r"the sweeps differ by more than time stamps do"),
        ({"late": 4.4e-3}, r"come 4\.\d+ ms late, scan_camera\.late allows 2 ms.*scan_camera\.late = \"5 ms\""),
    ],
)
def test_what_no_correction_mends_is_refused_by_name(spoilt: dict[str, float], words: str):
    with pytest.raises(RefusedError, match=words):
        timing(sweeps(3, **{"late": 0.5e-3, **spoilt}))


def test_sweeps_that_hardly_show_the_board_are_refused():
    few = [replace(one, frames=one.frames[:2]) for one in sweeps(1, 0.0)]
    with pytest.raises(RefusedError, match="2 pictures of the sweep at \\+40 mm/s"):
        timing(few)


def test_one_sweep_to_and_fro_tells_a_rolling_shutter():
    found = find_shutter(calibration(), HERE, sweeps(3, 1e-3, readout=12e-3)[:2], {})
    assert found.readout == pytest.approx(12e-3, abs=4 * found.sigma)
    assert found.sigma < 0.15e-3
    with pytest.raises(RefusedError, match=r"rolling shutter: its last row is exposed 12\.0 ms after"):
        refuse_rolling(found.readout, found.sigma)
    found = find_shutter(calibration(), HERE, sweeps(4, 1e-3)[:2], {})
    refuse_rolling(found.readout, found.sigma)
    crawling = [replace(one, velocity=1e-2 * one.velocity) for one in sweeps(4, 1e-3)[:2]]
    with pytest.raises(RefusedError, match="known to ±"):
        find_shutter(calibration(), HERE, crawling, {})


@pytest.mark.parametrize("late", [0.0, 1.5e-3, -1e-3, 30e-3])
def test_one_sweep_to_and_fro_tells_roughly_how_late_stamps_come(late: float):
    found, sigma = roughly_late(calibration(), HERE, sweeps(6, late)[:2])
    assert sigma < 0.5e-3
    assert abs(found - late) < 3 * sigma
    refused = pytest.raises(RefusedError, match=r'come (29|30)\.\d+ ms late, .*scan_camera.late = "3[01] ms"')
    with refused if late > MOST_LATE_S else nullcontext():
        refuse_late(found, sigma, MOST_LATE_S)


def test_what_is_refused_of_the_times_later_ends_the_stored_calibration_too(tmp_path):
    """Else the job after a refused `cell calibrate` would go on with the calibration before it."""
    old = made(2.0)
    save_calibration(old, tmp_path / f"{old.name}.json")
    save_calibration(replace(old, made=old.made + 1.0), tmp_path / "newer.json")

    def found() -> CellCalibration:
        return find_calibration(tmp_path, old.identities, old.configuration, 60.0)

    with kept_if_refused(tmp_path, old.name):
        refuse_rolling(0.1e-3, 1e-5)
    assert found().scan.refused == ""
    with suppress(TimesRefused), kept_if_refused(tmp_path, old.name):
        refuse_rolling(10e-3, 1e-5)
    with pytest.raises(CalibrationStale, match=r"holds no more.*rolling shutter: .*10\.0 ms.*cell calibrate"):
        found()
    save_calibration(replace(old, made=time.time()), tmp_path / f"{old.name}.json")
    assert found().scan.refused == ""


def test_it_is_stored_with_the_calibration():
    head = replace(calibration(), timing=FOUND)
    assert ScanCalibration.from_dict(head.as_dict()).timing == FOUND
    assert "timing" not in calibration().as_dict()
    with pytest.raises(ValueError, match="time stamps"):
        StampTiming.read(vars(FOUND) | {"sigma": 0.0})


@pytest.mark.parametrize(
    "spoilt", [{"sigma": 0.0}, {"late": float("nan")}, {"late": "much"}, {"link": None}, {"made": None}]
)
def test_kept_lateness_that_cannot_be_read_is_left_out_and_the_calibration_holds(spoilt: dict[str, object]):
    head = replace(calibration(), timing=FOUND, shutter=Shutter(1e-5, 2e-5, link_of(CONFIG)))
    stored = head.as_dict()
    read = ScanCalibration.from_dict(stored | {"timing": stored["timing"] | spoilt})
    assert read.timing is None
    assert read.shutter == head.shutter
    known, (doubt,) = times_known(read, CONFIG)
    assert known is None
    assert "timing cannot be read" in doubt and "scan_camera.late until `cell calibrate timing`" in doubt


def test_times_hold_for_the_settings_they_were_measured_with():
    """By the rail's baud rate, that is when its readings come; where a device is does not matter, nor what it sees."""
    faster = CONFIG.model_copy(update={"rail": CONFIG.rail.model_copy(update={"baud": 115200})})
    elsewhere = CONFIG.model_copy(update={"rail": CONFIG.rail.model_copy(update={"url": "/dev/ttyACM7"})})
    assert changed(link_of(CONFIG), link_of(elsewhere)) == ""
    assert changed(link_of(CONFIG), link_of(faster)) == "rail.baud was 9600, is 115200"
    head = replace(calibration(), timing=FOUND)
    assert times_known(head, CONFIG) == (FOUND, ())
    known, (late, shutter) = times_known(head, faster)
    assert known is None
    assert "with other settings (rail.baud was 9600, is 115200)" in late
    assert "rolling shutter is not known" in shutter
    less = CONFIG.model_copy(update={"scan_camera": CONFIG.scan_camera.model_copy(update={"late": 1e-3})})
    assert "it is 1.4 ms, scan_camera.late and rail.late allow 1 ms" in times_known(head, less)[1][0]
    early = replace(calibration(), timing=replace(FOUND, late=-FOUND.late))
    assert "it is -1.4 ms, scan_camera.late and rail.late allow 1 ms" in times_known(early, less)[1][0]
    assert times_known(calibration(), CONFIG)[1] == (shutter,)


def test_a_sweep_puts_late_stamps_back_and_is_surer_of_its_place():
    before = sweep(errors=replace(ERRORS, late=MOST_LATE_S))
    after = sweep(errors=replace(ERRORS, late=MOST_LATE_S, timing=FOUND))
    same = np.isin(before.frame_ids, after.frame_ids)
    # At 20 mm/s.
    moved = before.rail[same] - after.rail[np.isin(after.frame_ids, before.frame_ids)]
    assert moved == pytest.approx(np.full(len(moved), 0.02 * FOUND.late), abs=0.3e-6)
    shares = [float(np.sqrt(np.linalg.eigvalsh(one.covariance)[-1])) for one in (before, after)]
    assert shares[0] > 0.02 * MOST_LATE_S / np.sqrt(3) and shares[1] < 0.005e-3
