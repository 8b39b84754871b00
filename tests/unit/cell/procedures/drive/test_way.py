"""The vehicle drives only from where it is known to stand, not too far unseen, and not through the station."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from cell.config.cell_config import load_config
from cell.config.job import BoardSection, Job, load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import from_matrix
from cell.procedures.arm.moves import Pace
from cell.procedures.arm.photograph import BoardFix
from cell.procedures.drive.driving import Planar, RelativeOdometry, turn_to, wrap
from cell.procedures.drive.way import TURN_DRIFT, Way, Whereabouts, distance, left_at
from cell.procedures.steps.drive_to_target import TargetDrive, VehicleArrival
from drivers.errors import RefusedError
from drivers.interfaces import VehicleState
from sim_backends.world.drawing import inverse

CONFIG = load_config(None)
JOB = load_job("pot")[0]
VEHICLE_FROM_BASE = CONFIG.arm.vehicle_from_base.se3()
SIGHT_M, SIGHT = 2.3, math.radians(40)


class Site:
    """A simulated cell whose vehicle drives; the board's sight is told by the world's truth."""

    photograph_of: Callable[[BoardSection], BoardFix] | None = None

    def __init__(self, seed: int = 2, level: str = "nominal", cell: VirtualCell | None = None) -> None:
        self.cell = cell or VirtualCell(CONFIG, seed, level)
        self.vehicle = self.cell.vehicle
        self.whereabouts = Whereabouts(self.vehicle)
        self.notes: list[str] = []

    def truth(self) -> Planar:
        """Where the vehicle truly stands in the world, which is the place frame but for its height."""
        return Planar(*self.cell.world.vehicle.planar(self.cell.clock.now()))

    def photograph(self) -> BoardFix:
        return self.sight(self.cell.world.scene.world_from_board)

    def sight(self, world_from_board: np.ndarray) -> BoardFix:
        t = self.cell.clock.now()
        base_from_board = inverse(self.cell.world.world_from_base(t)) @ world_from_board
        x, y, _ = base_from_board[:3, 3]
        if math.hypot(x, y) > SIGHT_M or abs(math.atan2(y, x)) > SIGHT:
            raise RefusedError("no board found")
        return BoardFix(from_matrix(base_from_board), 1e-8 * np.eye(6), 0.1, 0.0, ())

    def run(self, job: Job = JOB, check: Callable[[], None] = lambda: None, pace: Pace | None = None) -> VehicleArrival:
        self.vehicle.enable()
        self.whereabouts.enter(job)
        drive = TargetDrive(
            job, VEHICLE_FROM_BASE, self.vehicle, self.whereabouts, self.photograph, clock=self.cell.clock,
            check=check, progress=lambda share, text: None, note=self.notes.append,
            photograph_of=self.photograph_of, pace=pace or Pace(),
        )  # fmt: skip
        return drive.to_target()

    def turn(self, angle: float) -> None:
        """As `cell jog vehicle` does."""
        self.vehicle.enable()
        turn_to(self.vehicle, RelativeOdometry(self.vehicle), angle, self.cell.clock, self.whereabouts.count)
        self.vehicle.brake()


@pytest.fixture
def site() -> Site:
    return Site()


def test_a_word_about_the_start_of_one_job_does_not_hold_for_the_next(site: Site):
    site.whereabouts.say_at_start()
    site.whereabouts.forget_word()
    site.whereabouts.enter(JOB)
    with pytest.raises(RefusedError, match="start of another job, which did not begin to drive"):
        site.whereabouts.pose()
    site.whereabouts.see(Planar.of(JOB.approach.staging.se3()))
    site.whereabouts.forget_word()
    site.whereabouts.pose()


@pytest.mark.parametrize("seen", [True, False])
def test_the_anchor_is_lost_with_an_interruption_and_says_which(site: Site, seen: bool, monkeypatch):
    site.whereabouts.enter(JOB)
    site.whereabouts.see(Planar.of(JOB.approach.start.se3())) if seen else site.whereabouts.say_at_start()
    told = site.vehicle.state

    def interrupted(*age: float) -> VehicleState:
        return replace(told(*age), interruptions=1, interruption="somebody else drove it")

    monkeypatch.setattr(site.vehicle, "state", interrupted)
    site.whereabouts.enter(JOB)
    with pytest.raises(RefusedError, match="not known: somebody else drove it"):
        site.whereabouts.pose()


def test_the_board_is_believed_over_odometry_and_a_contradiction_is_told(site: Site):
    site.whereabouts.say_at_start()
    site.whereabouts.enter(JOB)
    start = site.whereabouts.pose()
    assert site.whereabouts.see(Planar(start.x + 0.03, start.y, start.yaw)) is None
    told = site.whereabouts.see(Planar(start.x + 0.4, start.y, start.yaw))
    assert "370 mm" in told
    assert site.whereabouts.pose().x == pytest.approx(start.x + 0.4)
    turned = Planar(start.x + 0.4, start.y, start.yaw + 0.5)
    assert "28.6 deg" in str(site.whereabouts.see(turned))
    assert site.whereabouts.see(turned) is None, "it stands where it was seen before, turned by as much"


def test_another_jobs_board_tells_nothing_about_this_place(site: Site):
    site.whereabouts.say_at_start()
    site.whereabouts.enter(JOB)
    board = JOB.board.model_copy(update={"spec": "marked_dots:9x7:25mm"})
    site.whereabouts.enter(JOB.model_copy(update={"board": board}))
    with pytest.raises(RefusedError, match="board of another job"):
        site.whereabouts.pose()


def test_what_was_seen_at_one_stop_counts_at_the_next_and_each_stop_is_kept_clear_of(site: Site):
    left, right = (load_job(f"two-stations#{k}")[0] for k in (1, 2))
    site.whereabouts.enter(left)
    site.whereabouts.see(Planar.of(left.approach.target.se3()))
    site.whereabouts.enter(right)
    stands = site.whereabouts.pose()
    # 2.75 m back and aside, less 1.05 m before its table: it looks to the left from there.
    assert (stands.x, stands.y, stands.yaw) == pytest.approx((-2.75, 1.7, math.radians(90)), abs=1e-3)
    way = Way(right, VEHICLE_FROM_BASE, site.whereabouts)
    (stop,) = right.other_stops
    way.require_line(left_at(stop))
    with pytest.raises(RefusedError, match="of the table of stop left"):
        way.require_line(left_at(stop) * Planar(2.5, 0.0, 0.0))


def seen_at(site: Site, pose: Planar) -> Way:
    site.whereabouts.enter(JOB)
    site.whereabouts.see(pose)
    return Way(JOB, VEHICLE_FROM_BASE, site.whereabouts)


def test_a_way_through_the_table_is_refused_and_the_planned_one_is_not(site: Site):
    target, staging = Planar.of(JOB.approach.target.se3()), Planar.of(JOB.approach.staging.se3())
    way = seen_at(site, staging)
    way.require_line(target)
    with pytest.raises(RefusedError, match="of the table"):
        way.require_line(Planar(-0.6, -0.6, 0.0))
    # Turning on the spot, a corner of the vehicle sweeps 0.64 m around it.
    near = seen_at(site, Planar(-1.0, -0.2, 0.0))
    near.require_turn(math.radians(2))
    with pytest.raises(RefusedError, match="of the table"):
        near.require_turn(math.radians(45))


def test_the_longer_it_was_not_seen_the_more_room_it_needs(site: Site):
    close = Planar(-0.95, -0.2, 0.0)  # its front 100 mm before the table
    way = seen_at(site, Planar(-1.2, -0.2, 0.0))
    way.require_line(close)
    site.whereabouts.way = 1.0
    with pytest.raises(RefusedError, match="allowed 1"):
        way.require_line(close)


def test_turns_on_the_spot_are_counted_and_need_room_too(site: Site):
    close = Planar(-0.95, -0.2, 0.0)
    way = seen_at(site, Planar(-1.2, -0.2, 0.0))
    way.require_line(close)
    start = site.whereabouts.pose().yaw
    for goal in (0.5, -0.5, 0.0):
        site.vehicle.enable()
        turn_to(site.vehicle, site.whereabouts, start + goal, site.cell.clock, lambda: None)
    assert site.whereabouts.turned == pytest.approx(0.5 + 1.0 + 0.5, abs=0.05)
    assert site.whereabouts.way < 0.02
    with pytest.raises(RefusedError, match="of the table"):
        way.require_line(close)
    site.whereabouts.see(Planar(-1.2, -0.2, 0.0))
    assert site.whereabouts.turned == 0.0
    way.require_line(close)


def test_a_turn_is_refused_for_what_it_adds_to_what_is_not_known(site: Site):
    way = seen_at(site, Planar(-1.2, -0.2, 0.0))
    way.require_turn(math.radians(20))
    site.whereabouts.turned = 4.0
    with pytest.raises(RefusedError, match="of the table"):
        way.require_turn(math.radians(20))


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_the_heading_is_off_by_no_more_than_is_reckoned_with_in_a_harsh_cell(seed: int):
    site = Site(seed, "harsh")
    site.whereabouts.enter(JOB)
    site.whereabouts.see(site.truth())
    for goal in (1.5, 3.0):
        site.vehicle.enable()
        turn_to(site.vehicle, site.whereabouts, goal, site.cell.clock, lambda: None)
    off = abs(wrap(site.whereabouts.pose().yaw - site.truth().yaw))
    assert site.whereabouts.turned == pytest.approx(3.0, abs=0.1)
    assert off < TURN_DRIFT * site.whereabouts.turned


def test_a_curve_is_way_and_no_turn_on_the_spot(site: Site):
    site.whereabouts.enter(JOB)
    site.whereabouts.see(Planar(-3.0, 0.0, 0.0))
    site.vehicle.enable()
    for _ in range(60):
        site.vehicle.drive(0.3, 0.3)
        site.cell.clock.sleep(0.04)
        site.whereabouts.pose()
    assert site.whereabouts.way > 0.5 and site.whereabouts.turned < 0.02


def test_it_goes_no_further_unseen_than_the_jobs_way_to_its_staging_pose(site: Site):
    way = seen_at(site, Planar(-3.05, -0.6, 0.0))
    way.require_line(Planar(-1.85, -0.6, 0.0))
    far = seen_at(site, Planar(-4.5, -0.6, 0.0))
    with pytest.raises(RefusedError, match=r"2\.65 m on odometry alone .* allowed 1\.45 m"):
        far.require_line(Planar(-1.85, -0.6, 0.0))


def test_a_way_that_lasts_minutes_is_looked_at_to_its_end(site: Site):
    far = seen_at(site, Planar(-10.0, 0.0, 0.0))
    with pytest.raises(RefusedError, match=r"8\.15 m on odometry alone .* allowed 1\.45 m"):
        far.require_line(Planar(-1.85, 0.0, 0.0), share=0.01)
    slow = seen_at(site, Planar(-3.05, 0.0, 0.0))
    assert slow.require_line(Planar(-1.85, 0.0, 0.0), share=0.01).x == pytest.approx(-1.85, abs=1e-3)


def test_the_distance_between_outlines_is_that_of_their_nearest_points():
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    for aside, expected in (((1.3, 0.4), 0.3), ((1.3, 1.4), 0.5), ((0.5, 0.5), 0.0)):
        assert distance(square, square + np.array(aside)) == pytest.approx(expected)
    diamond = np.array([[2.0, 0.5], [2.5, 1.0], [3.0, 0.5], [2.5, 0.0]])
    assert distance(square, diamond) == pytest.approx(1.0)
