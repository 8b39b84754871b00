"""Placing, on the simulated arm without wires: what the force, the claw and a fault make of it."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pinocchio as pin
import pytest

from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import from_matrix, from_parts, from_ur
from cell.measure.inversion import NominalSurface
from cell.measure.vision.board.view import parse_board
from cell.motion.collision import CollisionError
from cell.motion.kinematics import HOME
from cell.motion.trajectory import Trajectory
from cell.procedures.arm import touch as touch_height
from cell.procedures.arm.moves import PLACED, Mover, PartProgress, PartState
from cell.procedures.arm.touch import TouchHeight
from cell.procedures.drive.way import Whereabouts
from cell.procedures.grasp import GraspSeries
from cell.procedures.part_error import stated_bound
from cell.procedures.steps import drive_to_target
from cell.procedures.steps.kinds import PLACE
from cell.procedures.steps.place import FAST_FORCE, NEAR_M, AimedPlace, PlaceResult, Placing, _mated, felt_from
from cell.procedures.steps.workplace import PartsBefore, Workplace
from cell.run.report.report import place_error
from cell.run.resumption import UnfinishedRun
from drivers.clock import Clock
from drivers.errors import ConfigError, DeviceError, DeviceFault, RefusedError
from drivers.switches import ArmSwitchedClaw
from lab.bench.job.part_jobs import job_with_part
from lab.bench.job.whole_job import JobRecord, NoFrames
from sim_backends.world.drawing import inverse
from statemachine.journal import Journal
from statemachine.runner import StepContext
from statemachine.step import OnFailure
from tests.support.at_station import AtStation

CONFIG = load_config(None)
JOB, MESH = load_job("pot")
STATED = TouchHeight(0.0, 0.06e-3)
"""Where the part is to touch first: as sure as a job that knows its grasp well is of it."""
NOMINAL = NominalSurface.load(MESH, unit=JOB.surface.mesh_unit)


class Site:
    """A simulated cell at its target with the part in the claw, the arm folded, and the true place of the surface."""

    def __init__(self) -> None:
        self.cell = VirtualCell(CONFIG, seed=1, level="ideal")
        world = self.cell.world
        target = JOB.approach.target.se3()
        world.vehicle._x, world.vehicle._y = target.translation[:2]
        self.cell.clock.sleep(0.1)
        self.cell.devices.vehicle.brake()
        self.cell.devices.interlocks.work_with(CONFIG.calibration_hash())
        self.arm = self.cell.devices.arm
        self.arm.move_joints(HOME, 1.0, 2.0).wait(60.0)
        world_from_base = world.world_from_base(self.cell.clock.now())
        self.base_from_surface = from_matrix(inverse(world_from_base) @ world.scene.world_from_surface)
        self.mover = Mover(self.arm, self.cell.clock, CONFIG, JOB)
        self.mover.avoid_station(
            self.base_from_surface * JOB.surface.place_from_surface.se3().inverse(), JOB, parse_board(JOB.board.spec),
            NOMINAL.extent,
        )  # fmt: skip
        self.part = PartProgress()
        self.noted: list[PartState] = []
        self.forces: list[float] = []
        self.heights: list[float] = []
        self.way: list[tuple[float, np.ndarray]] = []
        """Times, and where the flange was."""
        touch = world.arm.contact

        def watched(base_from_flange: Any) -> Any:
            wrench = touch(base_from_flange)
            self.forces.append(float(np.linalg.norm(wrench[:3])))
            self.heights.append(float(base_from_flange[2, 3]))
            self.way.append((self.cell.clock.now(), np.array(base_from_flange[:3, 3])))
            return wrench

        world.arm.contact = watched

    def place(self, too_low: float = 0.0, **exchanged: Any) -> PlaceResult:
        """Place where the surface is taken to be `too_low` m below where it truly is."""
        given = {"claw": self.cell.devices.claw, "note": lambda part: self.noted.append(part.state), **exchanged}
        placing = Placing(
            JOB, self.base_from_surface * from_parts((0.0, 0.0, -too_low)), STATED, mover=self.mover, arm=self.arm,
            claw=given["claw"], part=self.part, check=lambda: None, progress=lambda share, text: None,
            note=given["note"], ready=given.get("ready", lambda: None), feel=given.get("feel"),
        )  # fmt: skip
        return placing.put_down()

    @property
    def held(self) -> bool:
        return self.cell.world.part.held

    def height_above(self) -> float:
        """Of the flange over where it places, along the surface's normal, m."""
        at = self.base_from_surface * JOB.place.surface_from_part.se3() * JOB.grasp.flange_from_part.se3().inverse()
        return float((at.inverse() * from_ur(self.arm.state().flange)).translation @ normal())


@pytest.fixture
def site() -> Site:
    return Site()


@pytest.fixture(scope="module")
def work(placed_pot: JobRecord, tmp_path_factory) -> Workplace:
    """Where `placed_pot` placed."""
    return AtStation(placed_pot, tmp_path_factory.mktemp("place"), folded=False).work


def normal() -> np.ndarray:
    return np.asarray(JOB.grasp.flange_from_part.se3().rotation[:, 2])


def test_the_part_is_put_down_in_contact_and_that_is_noted_before_the_retreat(site: Site):
    above: list[float] = []

    def note(part: PartProgress) -> None:
        site.noted.append(part.state)
        above.append(site.height_above())

    result = site.place(note=note)
    assert result.contact
    assert abs(result.depth_error) < JOB.place.contact_travel
    assert not site.held
    assert site.noted == [PartState.UNKNOWN, PartState.RELEASED], "known before the claw is told, and after"
    assert above == pytest.approx([0.0, 0.0], abs=JOB.place.contact_travel)
    assert max(site.forces) < 3 * JOB.place.contact_force
    assert site.cell.world.collisions.found == ()
    where = site.part.where
    with pytest.raises(CollisionError, match="claw and placed part"):
        site.mover.plan_to(where * JOB.grasp.flange_from_part.se3().inverse(), "where the part stands now")
    true = pin.SE3(site.base_from_surface * JOB.place.surface_from_part.se3())
    assert np.linalg.norm(where.translation - true.translation) < 1e-3
    at = true * JOB.grasp.flange_from_part.se3().inverse()
    times, way = np.array([now for now, _ in site.way]), np.array([at.actInv(place) for _, place in site.way])
    up = way @ normal()
    low = np.flatnonzero(up < 0.9 * JOB.place.contact_travel)
    down, rise = slice(low[0], int(np.argmin(up))), slice(int(np.argmin(up)), len(up))
    seconds = times[down][-1] - times[down][0]
    assert up[down][0] - up[down][-1] == pytest.approx(JOB.place.contact_speed * seconds, rel=0.3), "felt for slowly"
    clear = int(np.argmax(up[rise] > 0.8 * JOB.place.approach))
    beside = way[rise][:clear] - np.outer(up[rise][:clear], normal())
    assert np.linalg.norm(beside, axis=1).max() < 1e-3, "straight up from the part before the arm folds"
    np.testing.assert_allclose(site.mover.joints, HOME, atol=2e-3)


def test_who_leaves_a_placed_part_may_be_near_that_and_nothing_else():
    near = [("claw", PLACED), ("claw", "table")]
    mover = Mover(VirtualCell(CONFIG, seed=1).devices.arm, Clock(), CONFIG, JOB)
    mover._planner = cast(Any, SimpleNamespace(collisions=SimpleNamespace(touching=lambda start: near)))
    assert mover._leaving(HOME) == (("claw", PLACED),)


def test_a_straight_line_gains_its_speed_gently():
    """At most by its speed in a third of a second, planned beforehand or not."""
    mover, speed = Site().mover, 0.05
    lines: list[Trajectory] = []
    mover.follow = lambda line, *_: bool(lines.append(line))  # type: ignore[method-assign]
    start = mover.kinematics.fk(mover.joints)
    goal = from_parts((0.0, 0.0, 0.03)) * start
    mover.line(goal, speed)
    for line in (*lines, mover.plan_line(start, goal, speed)[1]):
        times = np.linspace(0.0, line.duration, 200)
        joints = [np.interp(times, line.times, line.joints[:, k]) for k in range(6)]
        way = np.array([mover.kinematics.fk(each).translation for each in np.transpose(joints)])
        fast = np.linalg.norm(np.diff(way, axis=0), axis=1) / np.diff(times)
        assert fast.max() == pytest.approx(speed, rel=0.02)
        assert times[np.argmax(fast > 0.9 * speed)] > 0.9 / 3


def test_near_its_place_a_line_of_a_higher_speed_takes_no_longer():
    mover = Site().mover
    lines: list[Trajectory] = []
    mover.follow = lambda line, *_: bool(lines.append(line))  # type: ignore[method-assign]
    goal = from_parts((0.0, 0.0, 0.05)) * mover.kinematics.fk(mover.joints)
    for speed in (0.02, 0.04, 0.055, 0.06, 0.08, 0.1, 0.2):
        mover.line(goal, speed, near=NEAR_M, force_limit=FAST_FORCE * JOB.place.contact_force)
    assert np.diff([line.duration for line in lines]).max() < 0.01


def test_what_the_force_sensor_showed_before_the_descent_is_no_touch(site: Site):
    touch = site.cell.world.arm.contact
    drift = np.array([0.0, 0.0, 1.5 * JOB.place.contact_force, 0.0, 0.0, 0.0])
    site.cell.world.arm.contact = lambda base_from_flange: np.asarray(touch(base_from_flange)) + drift
    result = site.place()
    assert result.contact
    assert abs(result.depth_error) < JOB.place.contact_travel


@pytest.mark.parametrize(
    ("early", "feel", "told"),
    [
        (0.0015, 0.4e-3, r"touched something more than 0\.40 mm above"),
        (0.002, None, r"touched something more than 1\.00 mm above"),
        (0.004, None, r"touched something more than 1\.00 mm above"),
        (0.02, None, r"touched something more than 1\.00 mm above"),
        (-0.004, None, r"no contact within 1\.00 mm"),
    ],
)
def test_a_surface_that_comes_early_or_not_at_all_is_refused_with_the_part_held_lifted_and_not_crushed(
    site: Site, early: float, feel: float | None, told: str
):
    """Also one that is met just before the slow part of the descent, where the fast one does not feel it yet."""
    with pytest.raises(RefusedError, match=told):
        site.place(too_low=early, feel=feel)
    assert site.held
    assert site.noted == []
    assert site.part.state is PartState.HELD
    assert site.height_above() > 0.5 * JOB.place.approach
    # 40 mm/s until 24 N is felt: far below the 150 N of a protective stop.
    assert early < 0.0 or 10.0 < max(site.forces) < 100.0
    assert site.part.explain("touched") == "touched"


@pytest.mark.parametrize(("off", "from_mm"), [(None, 1.0), (0.02e-3, 0.47), (-0.2e-3, 1.0)])
def test_where_the_part_before_touched_as_expected_contact_is_felt_for_nearer(
    work: Workplace, off: float | None, from_mm: float
):
    work.parts_before = PartsBefore(touch_off=off)
    # Above all that would be placed: 3.5 standard deviations over the expected touch.
    assert 1e3 * felt_from(work, TouchHeight(0.05e-3, 0.07e-3)) == pytest.approx(from_mm, abs=0.01)


@pytest.mark.parametrize(("too_low", "side"), [(0.4e-3, "higher"), (-0.4e-3, "lower")])
def test_a_touch_that_contradicts_the_scan_is_refused_with_the_part_held_and_lifted(
    site: Site, too_low: float, side: str
):
    """Within the way in which contact is looked for: only what is stated of the place tells that it is wrong."""
    with pytest.raises(RefusedError, match=rf"touched 0\.\d+ mm {side} than the scan says.*verify") as caught:
        site.place(too_low=too_low)
    (number,) = caught.value.numbers
    assert number.value == pytest.approx(1e3 * too_low, abs=0.03)
    assert number.most == pytest.approx(3.5 * np.hypot(0.06, 0.03), abs=0.01)
    assert site.held
    assert site.noted == []
    assert site.part.state is PartState.HELD
    assert site.height_above() > 0.5 * JOB.place.approach


@pytest.mark.parametrize("too_low", [0.38e-3, 0.45e-3, 0.55e-3, 0.9e-3])
def test_one_that_touches_before_it_is_felt_for_is_refused_as_well(work: Workplace, site: Site, too_low: float):
    """Whether the force begins on the slow part of the descent, just before it, or on the fast one."""
    work.parts_before = PartsBefore(touch_off=0.0)
    feel = felt_from(work, STATED)
    assert 0.3e-3 < feel < 0.5e-3
    with pytest.raises(RefusedError, match="lifted again, still held"):
        site.place(too_low=too_low, feel=feel)
    assert site.held and max(site.forces) < 40.0


@pytest.mark.parametrize("too_low", [0.1e-3, -0.1e-3])
def test_a_touch_within_what_is_stated_is_placed_and_told(too_low: float):
    result = Site().place(too_low=too_low)
    assert result.touch.off == pytest.approx(too_low, abs=0.02e-3)
    # Pressed on until the force that lets go: the surface gives way by half a millimetre.
    assert result.depth_error < result.touch.felt.height - 0.3e-3
    assert result.notes == ()


@pytest.mark.parametrize("told", [True, False])
def test_a_stiff_touch_as_soon_as_it_is_felt_for_is_refused_with_the_part_held(site: Site, told: bool, monkeypatch):
    """The way on which the force grows is too short to tell where it began; where it ended tells enough. Also for an
    arm that tells too few states on that way."""
    if not told:
        monkeypatch.setattr(touch_height, "LEAST_STATES", 10_000)
    touch = site.cell.world.arm.contact
    site.cell.world.arm.contact = lambda base_from_flange: 6.0 * np.asarray(touch(base_from_flange))
    with pytest.raises(RefusedError, match="mm higher than the scan says"):
        site.place(too_low=1.06e-3)
    assert site.held


def test_nothing_is_held_between_the_last_look_and_the_release():
    """A surface that is moved in a pause there would not be looked at again."""
    site, held = Site(), []
    site.mover.hold = lambda: held.append(site.held)
    site.place()
    assert held == [False]


def test_steps_that_the_rail_lost_before_are_found_with_the_part_held_and_lifted(site: Site):
    rail = site.cell.devices.rail
    rail.home().wait(60.0)
    site.cell.fault("rail.lost_steps")
    rail.move_to(0.05).wait(30.0)
    looking = rail.check_zero()
    assert looking is not None
    with pytest.raises(DeviceFault, match="lost steps"):
        site.place(ready=lambda: looking.wait(30.0))
    assert site.held and site.noted == []
    assert site.height_above() > 0.5 * JOB.place.approach
    assert max(site.forces) == 0.0


def test_a_claw_that_lost_its_part_does_not_go_down(site: Site):
    site.cell.devices.claw.bare.release()
    site.heights.clear()
    with pytest.raises(RefusedError, match="the claw lost the part before the descent"):
        site.place()
    assert site.noted == [PartState.UNKNOWN]
    assert site.height_above() > 0.9 * JOB.place.approach
    assert min(site.heights) > site.arm.state().flange[2] - 0.002


def test_a_part_that_is_lost_as_it_touches_is_not_told_as_released(site: Site):
    world, touch = site.cell.world, site.cell.world.arm.contact

    def lost(base_from_flange: Any) -> Any:
        wrench = touch(base_from_flange)
        if np.linalg.norm(wrench[:3]) > JOB.place.contact_force:
            world.part.take_away()
        return wrench

    world.arm.contact = lost
    with pytest.raises(RefusedError, match="the claw lost the part as it was set down"):
        site.place()
    assert site.noted == [PartState.UNKNOWN]


def test_a_job_with_an_empty_claw_ends_before_anything_moves(site: Site):
    site.cell.devices.claw.bare.release()
    workplace = Workplace(
        CONFIG, JOB, NOMINAL, cast(Any, None), site.cell.devices, NoFrames(), Path(),
        Whereabouts(site.cell.devices.vehicle),
    )  # fmt: skip
    before = site.arm.state().joints
    context = StepContext(drive_to_target.STEP.policy, 1, 1e9, {}, site.cell.clock, lambda event: None)
    with pytest.raises(RefusedError, match="the claw holds no part"):
        drive_to_target.STEP.work(workplace, context)
    assert np.array_equal(site.arm.state().joints, before)


def test_a_fault_after_the_release_says_that_the_part_is_down(site: Site):

    def note(part: PartProgress) -> None:
        if part.state is PartState.RELEASED:
            site.cell.world.arm.fault("protective_stop")

    with pytest.raises(DeviceError) as caught:
        site.place(note=note)
    assert not site.held
    assert site.part.state is PartState.RELEASED
    told = site.part.explain(str(caught.value))
    assert told.startswith("the part is already down at (")
    assert "only the retreat failed" in told
    assert "not to be placed again" in told


def test_a_release_that_is_not_confirmed_leaves_the_part_unknown(site: Site):
    miswired = ArmSwitchedClaw("claw", site.arm, 5, CONFIG.claw.feedback, clock=site.cell.clock)
    with pytest.raises(DeviceFault) as caught:
        site.place(claw=miswired)
    assert site.part.state is PartState.UNKNOWN
    assert "look whether it did" in site.part.explain(str(caught.value))
    assert site.noted == [PartState.UNKNOWN]


def test_nothing_is_placed_twice_and_nothing_moves_for_it(site: Site):
    site.place()
    before = site.arm.state().joints
    with pytest.raises(RefusedError, match="the part is released, not held: nothing is placed a second time"):
        site.place()
    assert np.array_equal(site.arm.state().joints, before), "nothing has moved"
    told = site.part.explain("a later step failed")
    assert told.startswith("the part is already down")
    assert "retreat" not in told


def with_part(
    record: JobRecord, folder: Path, changed: Callable[[np.ndarray], np.ndarray] = lambda corners: corners
) -> AtStation:
    """A cell where `record` placed, with a part whose underside's corners are `changed`, as drawn and in its world."""
    job, mesh = load_job(job_with_part(folder, "pot", changed))
    return AtStation(record, folder, job, NominalSurface.load(mesh, unit=job.surface.mesh_unit))


def test_a_part_as_drawn_that_fits_the_scanned_surface_is_placed_and_its_gap_told(placed_pot: JobRecord, tmp_path):
    found = with_part(placed_pot, tmp_path).do("place").summary()["mating"]
    assert found["seen"] > 0.75 and abs(found["median_mm"]) < 0.03
    assert found["largest_mm"] < 0.3


@pytest.mark.parametrize(
    ("height", "told"),
    [
        (-0.5e-3, r"the part as drawn goes 0\.\d\d mm into the surface at .* half of the place's tolerance"),
        (0.5e-3, r"the part as drawn lies 0\.\d\d mm or more above the surface"),
    ],
)
def test_a_part_as_drawn_is_held_against_the_scanned_surface_before_it_goes_down(
    placed_pot: JobRecord, tmp_path, height: float, told: str
):
    site = with_part(placed_pot, tmp_path, lambda corners: corners + np.array([0.0, 0.0, height]))
    with pytest.raises(RefusedError, match=told):
        site.do("place")
    assert site.cell.world.part.held


def test_what_parts_had_alike_is_aimed_beside_where_the_part_fits_there(placed_pot: JobRecord, tmp_path):
    site, notes = with_part(placed_pot, tmp_path), list[str]()
    site.notify = lambda event: notes.append(str(event.data.get("text")))
    pose, aside, still = placed_pot.results["invert_pose"], from_parts((0.2e-3, 0.0, 0.0)), pin.SE3.Identity()

    def aimed(by: pin.SE3, *slips: pin.SE3) -> AimedPlace:
        site.work.parts_before = PartsBefore(GraspSeries().after(by, slips).after(by, slips))
        return AimedPlace.of(site.work, pose).fitted(site.work, pose, site.context("place"))[0]

    def touching(aim: AimedPlace) -> list[float]:
        return [round(1e3 * float(lies.translation[0]), 3) for lies in aim.touching]

    assert touching(aimed(aside)) == [0.0, -0.2], "nobody knows whether it is held so, or slips as the claw opens"
    assert touching(aimed(aside, still)) == [0.0] and touching(aimed(aside, aside)) == [-0.2]
    held = aimed(aside).job.grasp.flange_from_part.se3()
    assert np.allclose(held.translation, (JOB.grasp.flange_from_part.se3() * aside).translation)
    assert any("(+0.20, +0.00) mm and +0.0 mrad aside" in note for note in notes)
    # So far aside it would meet the flanks of the surface.
    far = aimed(from_parts((1.9e-3, 0.0, 0.0)))
    assert far.allowed is None and touching(far) == [0.0]
    assert any("which is not allowed for" in note for note in notes)


def test_where_nothing_was_scanned_it_is_told_that_the_underside_was_not_looked_at(placed_pot: JobRecord, tmp_path):
    site, said = with_part(placed_pot, tmp_path), []
    del site.made["reconstruct"]
    site.notify = said.append
    assert _mated(site.work, placed_pot.results["invert_pose"], pin.SE3.Identity(), site.context("place")) is None
    assert any("was not held against the surface" in str(event.data) for event in said)


def test_what_the_part_goes_into_the_surface_is_in_the_expected_touch_and_in_the_stated_bound(
    placed_pot: JobRecord, tmp_path
):
    """Half of the underside .25 mm low, as drawn and in the simulated world: less than is allowed."""
    site = with_part(placed_pot, tmp_path, lambda v: v - np.multiply.outer(v[:, 0] > 0.0, [0.0, 0.0, 0.25e-3]))
    site.do("place")
    job, nominal, done = site.job, site.nominal, site.ended
    placed, before = done.results["place"], placed_pot.results["place"]
    assert placed.mating.lift == pytest.approx(0.25e-3, abs=0.03e-3)
    assert placed.touch.expected.height - before.touch.expected.height == pytest.approx(0.25e-3, abs=0.03e-3)
    assert abs(placed.touch.off) < 2.5 * placed.touch.sigma
    error = place_error(job, nominal, done.at_end)["d_p95"]
    assert isinstance(error, float) and error > 0.2
    assert error < cast(float, stated_bound(job, nominal, placed.pose, done.placing)["d"])


def test_placing_is_tried_once_whatever_becomes_of_it():
    step = PLACE.policy().of("place")
    assert (step.max_retries, step.retry_on, step.on_failure) == (0, (), OnFailure.STOP)


@pytest.mark.parametrize(
    ("parts", "ended", "words"),
    [
        (("unknown", "released"), False, "had put its part down already, only the retreat failed"),
        (("released",), True, "what came after that failed"),
        (("unknown",), False, "Look what has become of the part"),
        (("unknown", "released", "unknown", "held"), True, "had gripped a part that lay"),
        (("unknown", "released", "unknown"), True, "releasing or gripping its part"),
    ],
)
def test_a_run_whose_part_may_be_down_is_not_resumed(tmp_path, parts: tuple[str, ...], ended: bool, words: str):
    """Whether it was killed or faulted afterwards: the journal had it before the retreat began."""
    journal = Journal(tmp_path, "run", {"job_file": "pot.toml", "job_hash": "0"})
    key = journal.step_started("place", 1)
    for part in parts:
        journal.event("note", "place", {"part": part, "base_from_part": [0.0] * 6})
    if ended:
        journal.step_ended(key, 1.0, {})
    journal.close()
    with pytest.raises(ConfigError, match=words):
        UnfinishedRun.find(tmp_path)
