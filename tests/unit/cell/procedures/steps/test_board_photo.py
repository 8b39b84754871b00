"""A vehicle that rocks is waited for, and stated where it does not rest."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pinocchio as pin
import pytest

from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import from_ur
from cell.measure.inversion import PlacePose
from cell.measure.vision.board.view import BoardView, parse_board
from cell.motion.kinematics import HOME
from cell.procedures.arm.photograph import APART_S, BoardFix, swing, swing_covariance
from cell.procedures.drive.driving import Planar
from cell.procedures.steps.board_photo import WAIT_S, WAITS, photographed, require_board_unmoved, until_quiet
from cell.procedures.steps.workplace import PHOTO_RATE_HZ, PartsBefore
from drivers.errors import RefusedError
from lab.bench.job.whole_job import JobRecord
from tests.support.at_station import Station
from tests.support.report_runs import CONFIG


def test_every_look_at_the_board_is_taken_with_the_exposure_that_is_configured(
    placed_pot: JobRecord, station: Station, monkeypatch
):
    class Taken(Exception):
        """The camera was asked."""

    def photograph(count: int = 1) -> None:
        raise Taken

    workplace, fix, asked = station(folded=False).work, placed_pot.results["board_photo"], []
    monkeypatch.setattr(workplace, "photograph", photograph)
    monkeypatch.setattr(workplace, "mover", SimpleNamespace(to=lambda *given, within=0.0: None))
    monkeypatch.setattr(workplace.devices.target_camera, "configure", lambda *given: asked.append(given))
    with pytest.raises(Taken):
        photographed(workplace, fix.base_from_board, lambda share, text: None)
    with pytest.raises(Taken):
        require_board_unmoved(workplace, fix, "before the sweep", lambda share, text: None)
    assert asked == [(CONFIG.target_camera.photo_exposure, PHOTO_RATE_HZ)] * 2


def test_a_board_is_photographed_twice_at_least_since_one_picture_does_not_show_whether_the_vehicle_rocks(
    placed_pot: JobRecord, station: Station
):
    work = station(folded=False).work
    work.job = work.job.model_copy(update={"photo": work.job.photo.model_copy(update={"count": 1})})
    fix = photographed(work, from_ur(placed_pot.results["board_photo"].flange), lambda share, text: None)
    assert len(fix.views) == 2


def test_items_share_a_photograph_until_odometry_tells_that_the_vehicle_moved(placed_pot: JobRecord, station: Station):
    there, fix = station(), placed_pot.results["board_photo"]
    there.work.whereabouts.see(Planar(0.0, 0.0, 0.0))
    stands = replace(placed_pot.results["drive_to_target"], shared=fix)
    there.work.parts_before = PartsBefore(arrival=stands)
    found = there.do("drive_to_target")
    assert (found.shared, found.photographs, found.summary()["shared"]) == (fix, 0, True)
    assert found.head is not None and there.cell.devices.vehicle.state().braked
    assert there.do("board_photo").base_from_board is fix.base_from_board
    assert there.work.mover.near is fix.joints and np.ptp(fix.joints) > 1.0
    there.work.whereabouts.way += 0.01
    again = there.do("drive_to_target")
    assert again.shared is None and again.photographs > 0 and "shared" not in again.summary()
    assert there.do("board_photo").number > 0


@pytest.mark.parametrize("pushed", [0.0, 0.03])
def test_the_next_part_begins_where_the_arm_photographed_the_board_unless_the_vehicle_stands_elsewhere(
    placed_pot: JobRecord, station: Station, pushed: float
):
    said: list[str] = []
    site = station(further=pushed, notify=lambda event: said.append(event.data.get("text", "")))
    fix = placed_pot.results["board_photo"]
    site.work.whereabouts.enter(site.job)
    site.work.whereabouts.see(Planar(0.0, 0.0, 0.0))
    site.work.parts_before = PartsBefore(board=fix, more=True)
    site.work.looked = True
    site.work.mover.to_joints(fix.joints)
    found = site.do("drive_to_target")
    assert (np.abs(site.work.mover.joints - fix.joints).max() < 1e-3) == (pushed == 0.0)
    assert (found.photographs == 1) == (pushed == 0.0)
    assert any("off its target now, and is driven there again" in text for text in said) == (pushed > 0.0)
    # It is not moved by a hair for that, and rests there again in the end.
    stood = site.work.mover.joints
    assert site.do("board_photo").number > 0
    if not pushed:
        assert site.work.mover.joints == pytest.approx(stood, abs=1e-5)
    site.work.mover.to_joints(HOME)
    site.work.mover.fold()
    off = site.work.mover.joints - site.made["board_photo"].joints
    assert np.abs(np.sin(0.5 * off)).max() < 5e-3


BOARD = parse_board("chessboard:9x7:20mm")
FOCAL, AWAY, NOISE = 1667.0, 0.9, 0.05
MATRIX = np.array([[FOCAL, 0.0, 640.0], [0.0, FOCAL, 512.0], [0.0, 0.0, 1.0]])
BASE_FROM_BOARD = pin.SE3(np.eye(3), np.array([1.0, 0.4, 0.2]))
VEHICLE = pin.SE3(np.eye(3), np.array([-0.3, 0.0, -0.55]))


class SwingingBoard:
    """A board at `AWAY` m that goes to and fro by `height` m at `hz`, dying away within `lasts` s (1/e)."""

    def __init__(self, height: float, hz: float = 4.0, lasts: float = np.inf, seed: int = 0) -> None:
        self.height, self.hz, self.lasts, self.now = height, hz, lasts, 0.0
        self.rng = np.random.default_rng(seed)
        self.said: list[str] = []

    def view(self) -> BoardView:
        corners = BOARD.points()
        off = self.height * np.exp(-self.now / self.lasts) * np.sin(2 * np.pi * self.hz * self.now + 0.4)
        place = np.array([-0.08 + 0.8 * off, -0.06 + 0.6 * off, AWAY])
        pixels = cv2.projectPoints(corners, np.zeros(3), place, MATRIX, np.zeros(5))[0].reshape(-1, 2)
        pixels += self.rng.normal(0.0, NOISE, pixels.shape)
        return BoardView(BOARD, (1280, 1024), np.arange(len(corners)), pixels, np.full(len(corners), NOISE))

    def photograph(self) -> BoardFix:
        views = []
        for _ in range(4):
            views.append(self.view())
            self.now += APART_S
        return BoardFix(BASE_FROM_BOARD, 1e-10 * np.eye(6), 0.1, 0.0, (), tuple(views), swing(views, AWAY / FOCAL))

    def wait(self, seconds: float) -> None:
        self.now += seconds

    def fixed(self) -> BoardFix:
        return until_quiet(VEHICLE, self.photograph, self.wait, lambda share, text: self.said.append(text))


def test_a_board_that_stands_still_is_not_waited_for():
    for seed in range(200):
        board = SwingingBoard(0.0, seed=seed)
        fix = board.fixed()
        assert fix.swung == 0.0
        assert board.said == []
        assert fix.covariance == pytest.approx(1e-10 * np.eye(6))


@pytest.mark.parametrize("hz", [2.0, 4.0, 7.0])
def test_what_it_goes_to_and_fro_is_told_within_half_of_it(hz: float):
    assert SwingingBoard(0.1e-3, hz).photograph().swung == pytest.approx(0.1e-3, rel=0.5)


def test_a_vehicle_that_comes_to_rest_is_waited_for():
    board = SwingingBoard(0.5e-3, lasts=0.8)
    fix = board.fixed()
    assert fix.swung == 0.0
    assert fix.notes == ()
    assert 1 < len(board.said) <= WAITS
    assert "waiting until the vehicle is quiet: the board goes to and fro by ±0." in board.said[0]


def test_one_that_does_not_is_stated_and_noted():
    board = SwingingBoard(0.1e-3)
    fix = board.fixed()
    assert board.now == pytest.approx(WAITS * WAIT_S + (WAITS + 1) * 4 * APART_S)
    assert (
        "the vehicle rocks, or the board swings: after 4 s of waiting it still goes to and fro by ±0." in fix.notes[0]
    )
    assert np.sqrt(np.diag(fix.covariance)[:3]) == pytest.approx([0.1e-3 / np.sqrt(2)] * 3, rel=0.5)


def test_what_is_stated_of_a_board_that_swings_is_its_mean_square_and_the_roll_that_shows_so():
    # The board faces up: a roll moves it to the side by its height above the ground, and a camera above sees no more.
    above = float(BASE_FROM_BOARD.translation[2] - VEHICLE.translation[2])
    stated = swing_covariance(1e-4, BASE_FROM_BOARD, VEHICLE)
    np.testing.assert_allclose(stated, np.diag([0.5e-8] * 3 + [0.5e-8 / above**2] * 3))


def test_one_that_rocks_too_much_is_refused_by_name():
    with pytest.raises(RefusedError, match=r"the vehicle rocks by ±1\.\d\d mrad, which moves the board by"):
        SwingingBoard(1e-3).fixed()


def test_what_the_points_own_noise_does_is_no_swing_however_near_the_board_is_seen():
    """With a metre to a pixel no least height hides it: only the points' own standard deviations tell it."""
    for seed in range(50):
        board = SwingingBoard(0.0, seed=seed)
        assert swing([board.view() for _ in range(4)], 1.0) == 0.0
    assert swing([replace(view, sigma=0.1 * view.sigma) for view in (board.view() for _ in range(4))], 1.0) > 0.0


def test_views_that_share_no_point_or_are_but_one_tell_nothing():
    one = SwingingBoard(1e-3).view()
    assert swing([one], AWAY / FOCAL) == 0.0
    few = [
        BoardView(BOARD, one.size, one.ids[part], one.pixels[part], one.sigma[part])
        for part in (slice(9), slice(9, 20))
    ]
    assert swing(few, AWAY / FOCAL) == 0.0


def test_the_simulated_cell_of_firm_tyres_is_quiet(placed_pot: JobRecord):
    fix = placed_pot.results["board_photo"]
    assert len(fix.views) > 1
    assert fix.swung == 0.0


def test_a_vehicle_that_was_pushed_after_the_photograph_is_refused(placed_pot: JobRecord, station: Station):
    def look(further: float) -> None:
        work = station(further=further, folded=False).work
        require_board_unmoved(work, placed_pot.results["board_photo"], "before the sweep", lambda share, text: None)

    look(0.0)
    with pytest.raises(RefusedError, match=r"the board has moved by .* before the sweep.*run the job again") as refused:
        look(1.0e-3)
    (number,) = refused.value.numbers
    assert (number.name, number.value) == ("board moved by", pytest.approx(1.0, abs=0.3))


def test_where_the_board_alone_decides_it_is_looked_at_again_before_the_part_goes_down(station: Station):
    """The surface does not tell: round, it lies the same however it was turned, and where the board has gone."""

    def moved(cell: VirtualCell) -> None:
        world = cell.world
        pose = world.scene.world_from_board.copy()
        pose[0, 3] += 1e-3
        world.remake(replace(world.scene, world_from_board=pose), world.station)

    site = station(changed=moved)
    seen: PlacePose = site.made["invert_pose"]
    site.made["invert_pose"] = replace(seen, verdict=replace(seen.verdict, unseen=("rotation about the z axis",)))
    with pytest.raises(RefusedError, match="the board has moved by"):
        site.do("place")
    assert site.cell.world.part.held


def test_what_the_cameras_mounting_is_off_by_does_not_hide_it(placed_pot: JobRecord):
    fix = placed_pot.results["board_photo"]
    # Part of what is stated of the board, and no more than that.
    assert np.linalg.eigvalsh(fix.by_mount).min() > -1e-12
    assert np.linalg.eigvalsh(fix.covariance - fix.by_mount).min() > -1e-12
    assert np.trace(fix.by_mount) > 0.0
