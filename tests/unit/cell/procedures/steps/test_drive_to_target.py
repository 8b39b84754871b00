"""The drive to the target: only from a known place, until the board says that it stands there."""

import math
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from cell.config.cell_config import StationObstacle
from cell.config.job import BoardSection, load_job
from cell.devices.simulated.described import Described
from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import from_matrix
from cell.procedures.arm.moves import Pace
from cell.procedures.arm.photograph import BoardFix
from cell.procedures.drive.driving import Planar
from cell.procedures.drive.way import Way, Whereabouts
from drivers.errors import RefusedError
from drivers.make import Pose
from tests.unit.cell.procedures.drive.test_driving import LateVehicle, moved
from tests.unit.cell.procedures.drive.test_way import CONFIG, JOB, VEHICLE_FROM_BASE, Site


def test_a_vehicle_that_nobody_knows_about_is_not_driven_and_told_what_to_do():
    site = Site()
    stood = site.truth()
    with pytest.raises(RefusedError, match=r"has just connected.*no board found") as refused:
        site.run()
    assert "cell jog vehicle" in str(refused.value)
    assert "--at-start" in str(refused.value)
    assert moved(stood, site.truth()) == 0.0


def test_after_a_jog_in_another_process_three_runs_are_refused_and_nothing_drives():
    site = Site()
    site.turn(math.radians(30))
    for _ in range(3):
        stood = site.truth()
        site.whereabouts = Whereabouts(site.vehicle)  # each run is a new process
        with pytest.raises(RefusedError, match=r"where the vehicle stands is not known.*--at-start"):
            site.run()
        assert moved(stood, site.truth()) == 0.0


@pytest.mark.parametrize("seed", [2, 5])
def test_from_its_start_it_comes_to_the_target_and_stands_there_in_later_runs(seed: int):
    site = Site(seed)
    site.whereabouts.say_at_start()
    arrival = site.run()
    assert max(abs(arrival.error_along), abs(arrival.error_across)) < JOB.approach.tolerance
    stood = site.truth()
    assert moved(Planar.of(JOB.approach.target.se3()), stood) < 0.02
    site.run()
    assert moved(stood, site.truth()) < 0.002
    assert site.cell.world.collisions.found == ()


@pytest.mark.parametrize("off", [Planar(0.0, 0.04, 0.0), Planar(0.0, 0.0, math.radians(3)), Planar(-0.04, 0.0, 0.0)])
def test_a_vehicle_that_stands_beside_its_target_or_turned_is_brought_there_and_braked(off: Planar):
    site = Site()
    target = Planar.of(JOB.approach.target.se3())
    stands, model = target * off, site.cell.world.vehicle
    model._x, model._y, model._yaw = stands.x, stands.y, stands.yaw
    site.cell.clock.sleep(0.1)
    arrival = site.run()
    left = target.inverse() * site.truth()
    assert max(abs(left.x), abs(left.y)) < JOB.approach.tolerance
    assert abs(left.yaw) < JOB.approach.tolerance_angle
    assert (arrival.error_along, arrival.error_across) == pytest.approx((left.x, left.y), abs=1e-4)
    assert arrival.error_yaw == pytest.approx(left.yaw, abs=1e-3)
    assert model.feedback(site.cell.clock.now()).braked


@pytest.mark.parametrize("shimmers", [True, False])
def test_a_target_that_is_not_met_is_refused_with_the_vehicle_braked(shimmers: bool):
    """The board is seen turned about the vehicle, by a degree more each time as in shimmering air, or always by three
    from where it stood at first: however the vehicle turns, it is off."""
    site, seen, first, stood = Site(), 0.0, [], []
    target = Planar.of(JOB.approach.target.se3())
    model = site.cell.world.vehicle
    model._x, model._y, model._yaw = target.x, target.y, target.yaw
    site.cell.clock.sleep(0.1)
    photograph = site.photograph

    def turned() -> BoardFix:
        nonlocal seen
        seen = seen + math.radians(1.0) if shimmers else math.radians(3.0)
        first.append(photograph())
        stood.append(site.truth())
        fix = first[-1 if shimmers else 0]
        about = VEHICLE_FROM_BASE.inverse() * pin.SE3(pin.exp3(np.array([0.0, 0.0, seen])), np.zeros(3))
        return replace(fix, base_from_board=about * VEHICLE_FROM_BASE * fix.base_from_board)

    site.photograph = turned  # type: ignore[method-assign]
    cause = "warm air shimmers .* wheels are not" if shimmers else "check the floor and the wheels"
    with pytest.raises(RefusedError, match=rf"mm across and .* from its target after 9 photographs.*{cause}"):
        site.run()
    assert model.feedback(site.cell.clock.now()).braked
    # One before it drives, nine on the way and two that are compared with each other.
    assert len(first) == 12
    # Nobody would see where a drive after the last of the nine leads.
    assert (stood[9].x, stood[9].yaw) == pytest.approx((site.truth().x, site.truth().yaw), abs=1e-9)


def test_a_vehicle_that_late_readings_let_pass_its_goal_is_brought_back_to_see_the_board():
    site = Site()
    way = moved(Planar.of(JOB.approach.start.se3()), Planar.of(JOB.approach.staging.se3()))
    site.vehicle = LateVehicle(site.cell, way - 0.05, 0.6, looks_new=True)
    site.whereabouts = Whereabouts(site.vehicle)
    site.whereabouts.say_at_start()
    seen = site.photograph

    def narrow() -> BoardFix:
        if site.truth().x > JOB.approach.staging.translation[0] + 0.04 and not site.notes:
            raise RefusedError("the board is cut off by the picture's edge")
        return seen()

    site.photograph = narrow  # type: ignore[method-assign]
    arrival = site.run()
    assert max(abs(arrival.error_along), abs(arrival.error_across)) < JOB.approach.tolerance
    assert ["brought there" in note for note in site.notes] == [True]


def test_a_jog_in_the_same_process_is_counted_by_odometry():
    site = Site()
    site.whereabouts.say_at_start()
    site.turn(math.radians(20))
    site.turn(math.radians(-40))
    site.turn(math.radians(40))
    site.whereabouts.enter(JOB)
    assert site.whereabouts.turned == pytest.approx(math.radians(100), abs=0.05)
    assert site.whereabouts.pose().yaw == pytest.approx(site.truth().yaw, abs=0.03)
    site.run()
    assert moved(Planar.of(JOB.approach.target.se3()), site.truth()) < 0.02


def test_somebody_who_is_wrong_about_the_start_gets_no_further_than_its_way():
    """Turned by 30° and said to be at its start: it goes that way once, sees nothing, and is not driven again."""
    site = Site()
    site.turn(math.radians(30))
    stood = site.truth()
    site.whereabouts.say_at_start()
    for _ in range(3):
        with pytest.raises(RefusedError, match="no board found"):
            site.run()
    staging = Planar.of(JOB.approach.staging.se3())
    start = Planar.of(JOB.approach.start.se3())
    assert moved(stood, site.truth()) < moved(start, staging) + 0.05
    assert site.cell.world.collisions.found == ()


def test_a_target_in_the_table_is_not_driven_to():
    site = Site()
    site.whereabouts.say_at_start()
    target = JOB.approach.target.model_copy(update={"translation": (-0.8, 0.0, -0.6)})
    with pytest.raises(RefusedError, match="of the table"):
        site.run(JOB.model_copy(update={"approach": JOB.approach.model_copy(update={"target": target})}))
    assert moved(Planar.of(JOB.approach.staging.se3()), site.truth()) < 0.05
    assert site.cell.world.collisions.found == ()


def test_a_way_is_checked_at_the_pace_at_which_it_is_driven():
    """A slow vehicle comes later to its line: nearer to what stands beside it."""
    stands = Pose(translation=("-1750 mm", "660 mm", "-500 mm"), rotation=("0 deg",) * 3)
    fixture = StationObstacle(name="fixture", size=("200 mm",) * 3, place_from_centre=stands)
    approach = JOB.approach.model_copy(update={"speed": 0.2})
    job = JOB.model_copy(update={"approach": approach, "obstacle": (fixture,)})
    site, pace, stood = Site(), Pace(), Planar(approach.start.translation[0], 0.45, 0.0)
    model = site.cell.world.vehicle
    model._x, model._y, model._yaw = stood.x, stood.y, stood.yaw
    site.cell.clock.sleep(0.1)
    site.whereabouts.enter(job)
    site.whereabouts.see(stood)
    Way(job, VEHICLE_FROM_BASE, site.whereabouts).require_line(Planar.of(approach.staging.se3()))
    pace.share = 0.25
    with pytest.raises(RefusedError, match="of the station obstacle fixture"):
        site.run(job, pace=pace)
    assert moved(stood, site.truth()) < 1e-6


class TwoStations(Site):
    """A vehicle that stands before the first stop of `two-stations`, for the item at the second."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed, cell=VirtualCell(CONFIG, seed, "nominal", Described.of("two-stations")))
        self.left, self.right = (load_job(f"two-stations#{k}")[0] for k in (1, 2))
        self.boards = {self.left.board: self.cell.world.scene.world_from_board}
        model, target = self.cell.world.vehicle, Planar.of(self.left.approach.target.se3())
        model._x, model._y, model._yaw = target.x, target.y, target.yaw
        self.cell.clock.sleep(0.1)
        self.cell.make_ready(Described.of("two-stations#2"))
        self.boards[self.right.board] = self.cell.world.scene.world_from_board

    def photograph_of(self, board: BoardSection) -> BoardFix:
        return self.sight(self.boards[board])

    def off_target(self) -> Planar:
        """The vehicle in the true frame of the second stop's target."""
        place = Planar.of(from_matrix(self.cell.world.scene.world_from_place))
        return (place * Planar.of(self.right.approach.target.se3())).inverse() * self.truth()


@pytest.mark.parametrize(("seed", "known"), [(2, True), (5, False)])
def test_from_one_stop_it_backs_and_drives_round_to_the_next(seed: int, known: bool):
    """By odometry, or in a new process by the board of the stop before which it stands."""
    site = TwoStations(seed)
    if known:
        site.whereabouts.enter(site.left)
        site.whereabouts.see(Planar.of(site.left.approach.target.se3()))
    arrival = site.run(site.right)
    assert max(abs(arrival.error_along), abs(arrival.error_across)) < site.right.approach.tolerance
    assert math.hypot(site.off_target().x, site.off_target().y) < 0.012
    assert site.cell.world.collisions.found == ()
    assert ["stands before stop left" in note for note in site.notes] == [True] * (not known)
    # And back, as in the next round.
    site.cell.make_ready(Described.of("two-stations#1"))
    site.run(site.left)
    assert moved(Planar.of(site.left.approach.target.se3()), site.truth()) < 0.012


def test_a_vehicle_that_sees_the_board_of_no_stop_is_not_driven():
    site = TwoStations(2)
    site.boards[site.left.board] = site.boards[site.right.board]
    with pytest.raises(RefusedError, match=r"has just connected.*no board found"):
        site.run(site.right)
