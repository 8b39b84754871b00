"""First touch: where a force begins, by closed forms; and a laser that turned unseen, on the simulated cell."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from cell.config.job import Job, load_job
from cell.measure.inversion import NominalSurface, PlacePose
from cell.measure.inversion.observability import PoseVerdict, SmallMotion
from cell.procedures.arm.touch import FELT_M, TouchCheck, TouchHeight, expected_touch, felt_touch
from drivers.errors import RefusedError
from drivers.interfaces import ArmSafety, ArmState
from lab.bench.job.whole_job import JobRecord
from sim_backends.world import levels
from tests.support.at_station import AtStation
from tests.support.report_runs import NAMES, changed

JOB, MESH = load_job("pot")
NOMINAL = NominalSurface.load(MESH, unit=JOB.surface.mesh_unit)
UP = np.array([0.6, 0.0, 0.8])
ORIGIN = np.array([0.3, -0.2, 0.5])
HEIGHTS = np.linspace(1e-3, -0.5e-3, 300)
NOISE_N = 0.35


def states(forces: np.ndarray, like: ArmState, seed: int = 0) -> list[ArmState]:
    """A descent along `UP` with a force along it, that ends at 8 N, and noise on every axis."""
    forces = forces[: np.argmax(forces > 8.0) or None]
    noise = np.random.default_rng(seed).normal(0.0, NOISE_N, (len(forces), 3))
    made = []
    for height, force, scatter in zip(HEIGHTS, forces, noise, strict=False):
        flange = np.concatenate([ORIGIN + height * UP, np.zeros(3)])
        made.append(replace(like, flange=flange, wrench=np.concatenate([force * UP + scatter, np.zeros(3)])))
    return made


@pytest.fixture(scope="module")
def still() -> ArmState:
    zero = np.zeros(6)
    return ArmState(0.0, zero, zero, zero, zero, ArmSafety.NORMAL, False, 0, 0)


@pytest.mark.parametrize("grows", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("height", [0.2e-3, -0.15e-3])
def test_the_touch_is_where_the_force_begins_flat_on_an_edge_or_round(height: float, grows: float, still: ArmState):
    """A flat contact presses back in proportion, an edge with the square, round bodies (Hertz) with the power 3/2."""
    forces = 8.0 * (np.maximum(0.0, height - HEIGHTS) / 0.4e-3) ** grows
    found = [felt_touch(states(forces, still, seed), ORIGIN, UP) for seed in range(8)]
    off = np.array([(one.height - height) / one.sigma for one in found if one is not None])
    assert len(off) == 8
    assert np.sqrt(np.mean(off**2)) < 1.2
    assert FELT_M <= max(one.sigma for one in found if one is not None) < 0.1e-3


@pytest.mark.parametrize("follows", [0.9, 0.97])
def test_force_errors_that_last_are_stated(follows: float, still: ArmState):
    """Friction and filters hold an error over many readings: taken for white noise, it was off by 5 deviations."""
    off = []
    for seed in range(12):
        drawn = np.random.default_rng(seed).normal(0.0, NOISE_N * np.sqrt(1 - follows**2), len(HEIGHTS) + 200)
        lasting = np.array([drawn[: k + 1] @ follows ** np.arange(k, -1, -1) for k in range(len(drawn))])[200:]
        forces = 20e3 * np.maximum(0.0, 0.1e-3 - HEIGHTS)
        made = states(forces, still, seed)
        found = felt_touch(
            [replace(s, wrench=np.concatenate([(f + more) * UP, np.zeros(3)])) for s, f, more in
             zip(made, forces, lasting, strict=False)], ORIGIN, UP
        )  # fmt: skip
        off.append((found.height - 0.1e-3) / found.sigma)
    assert np.sqrt(np.mean(np.square(off))) < 1.5 and np.abs(off).max() < 3.5


def test_an_arm_that_tells_next_to_nothing_is_no_witness(still: ArmState):
    assert felt_touch(states(np.zeros(300), still)[:10], ORIGIN, UP) is None


def test_a_touch_is_noted_before_it_is_refused():
    check = TouchCheck(TouchHeight(-0.3e-3, 0.0), TouchHeight(0.0, 0.1e-3))
    check.require()
    assert "0.300 mm lower than the scan says" in check.notes[0]
    assert TouchCheck(TouchHeight(-0.2e-3, 0.0), TouchHeight(0.0, 0.1e-3)).notes == ()


def test_a_part_that_may_be_tilted_is_expected_to_touch_early(placed_pot: JobRecord):
    pose, known = placed_pot.results["invert_pose"], replaced_grasp(1e-6, 1e-6)
    tilted = replaced_grasp(1e-6, 3e-3)
    steady, early = (expected_touch(job, NOMINAL, pose, placed_pot.placing) for job in (known, tilted))
    # Half of edges 35 and 18 mm away, which is what tilts of 3 mrad (1 σ) bring in the mean: 0.8 σ, for either way.
    assert early.height == pytest.approx(0.5 * 0.8 * 3e-3 * (0.035 + 0.018), rel=0.25)
    assert steady.height < 0.5 * early.height
    assert early.sigma > steady.sigma


def test_a_laser_that_turned_unseen_is_caught_when_the_part_touches(placed_pot: JobRecord, tmp_path, monkeypatch):
    """One milliradian, no plate to see it on, and a job that knows its grasp as this level's claw holds it."""
    blind = replace(placed_pot.calibration, scan=replace(placed_pot.calibration.scan, witness=None))
    monkeypatch.setattr(levels, "ALONE", replace(levels.ALONE, laser_pointing=150e-6))
    job = changed(replaced_grasp(0.02e-3, 0.1e-3), "scan", speed=2 * JOB.scan.speed)
    site = AtStation(
        replace(placed_pot, calibration=blind), tmp_path, job, level="nominal+laser_pointing",
        changed=lambda cell: cell.world.stand(3600.0),
    )  # fmt: skip
    with pytest.raises(RefusedError, match="still held") as caught:
        site.do(*NAMES[1:])
    assert "than the scan says" in str(caught.value) and site.cell.world.part.held


def replaced_grasp(sigma: float, angle: float) -> Job:
    """The job with a grasp that is known to `sigma` m and `angle` rad."""
    return JOB.model_copy(update={"grasp": JOB.grasp.model_copy(update={"sigma": sigma, "sigma_angle": angle})})


def test_a_part_that_is_put_down_aslant_touches_along_its_own_way():
    """On flat ground, on a way 40° off its normal, an error of the place is felt 1/cos 40° as large."""
    corners = 0.02 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    flat = NominalSurface(corners, [[0, 1, 2], [0, 2, 3]])
    made, none = np.diag([1e-8] * 3 + [0.0] * 3), np.zeros((6, 6))
    verdict = PoseVerdict(SmallMotion(np.zeros(3), np.zeros(3), 0.0, ""), (), ())
    pose = PlacePose(pin.SE3.Identity(), made, none, made, verdict, 0.0, 1.0, 1000, 1.0, 1.0, 0.0, np.zeros(6), 0.0)
    known = replaced_grasp(1e-9, 1e-9)

    def aslant(degrees: float) -> Job:
        way = {"translation": ["0 mm"] * 3, "rotation": ["0 deg", f"{degrees} deg", "0 deg"]}
        turned = JOB.place.surface_from_part.model_validate(way)
        return known.model_copy(update={"place": JOB.place.model_copy(update={"surface_from_part": turned})})

    touch = expected_touch(aslant(40.0), flat, pose, none)
    assert touch.sigma == pytest.approx(1e-4 / np.cos(np.radians(40.0)), rel=0.08)
    with pytest.raises(RefusedError, match="steeper everywhere"):
        expected_touch(aslant(90.0), flat, pose, none)
