"""A surface whose parts do not agree about its place is refused; noise, clutter and calibration are no disagreement.

What stands on the place is seen in the scan, and refused before the part is put onto it."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import difference, from_parts
from cell.measure.inversion import Prior, invert_pose
from cell.measure.inversion.demands import _squares
from cell.measure.inversion.disagreement import (
    Dissent,
    Standing,
    _beyond_noise,
    dissent,
    highest_standing,
    require_bare,
)
from cell.measure.inversion.nominal import Scan
from cell.measure.inversion.registration import register
from cell.measure.reconstruction.cloud import Cloud
from cell.procedures.steps.kinds import PLACE
from cell.procedures.steps.place import STEP
from drivers.errors import RefusedError
from lab.bench.inversion.campaign import BOARD, TOLERANCE, judge_case, task
from lab.bench.inversion.scenes import PARTS, TRUE, Setting, nominal, scan
from lab.bench.job.whole_job import JobRecord, NoFrames
from statemachine.runner import Event, StepContext
from tests.support.report_runs import CONFIG, at_station, pot, work_of

Array = NDArray[np.float64]
POT = PARTS["pot"].height
EDGE = -0.0175
"""A quarter of the pot lies at smaller x, m."""


def deformed_pot(by: Callable[[Array], Array]) -> Cloud:
    """A scan of a pot whose height has changed by a function of x."""
    return scan(PARTS["pot"], np.random.default_rng(3), height=lambda x, y: POT(x, y) + by(x))


def asked(by: Callable[[Array], Array]) -> Dissent:
    return dissent(Scan.of(deformed_pot(by)), TRUE, nominal("pot"), TOLERANCE)


def test_a_quarter_that_has_sunk_or_is_tilted_is_found_with_its_depth_and_its_angle():
    sunk = asked(lambda x: -0.0004 * (x < EDGE))
    assert sunk.shift == pytest.approx(0.0004, abs=1e-4)
    assert sunk.middle[0] < -0.015 and sunk.excess > 0.5
    tilted = asked(lambda x: 0.006 * np.minimum(x - EDGE, 0.0))
    assert (tilted.turn, tilted.shift) == (pytest.approx(0.006, rel=0.1), pytest.approx(0.006 * -EDGE, rel=0.15))
    assert tilted.middle[0] < EDGE
    assert asked(lambda x: 0.0 * x).excess < 0.05, "noise alone"


@pytest.mark.parametrize("axis", range(6))
def test_a_motion_along_any_axis_counts_beyond_three_sigma(axis: int):
    allowed = TOLERANCE.translation if axis < 3 else TOLERANCE.rotation
    motion, spread = np.zeros(6), np.zeros((6, 1))
    motion[axis], spread[axis] = 2.0 * allowed, 0.25 * allowed
    assert _beyond_noise(motion, spread, TOLERANCE) == pytest.approx(2.0 - 3 * 0.25)


def test_how_much_of_the_area_lies_off_is_told_by_squares():
    seen = Scan.of(deformed_pot(lambda x: 0.001 * (x < EDGE)))
    medians = _squares(seen, TRUE, nominal("pot"))
    raised = ((seen.points - TRUE.translation) @ TRUE.rotation)[:, 0] < EDGE
    assert len(medians) > 50
    assert np.mean(np.abs(medians) > 0.5e-3) == pytest.approx(raised.mean(), abs=0.1)
    assert len(_squares(seen, from_parts((1.0, 1.0, 1.0)) * TRUE, nominal("pot"))) == 0


@pytest.mark.parametrize("part", list(PARTS))
def test_foreign_objects_and_missing_data_are_no_dissent(part: str):
    seen = Scan.of(scan(PARTS[part], np.random.default_rng(8), Setting(clutter=0.2, missing=0.4)))
    pose = register(seen, nominal(part), Prior(TRUE, BOARD)).base_from_surface
    assert dissent(seen, pose, nominal(part), TOLERANCE).excess < 0.25


def test_what_the_calibration_explains_is_no_dissent():
    plain = scan(PARTS["pot"], np.random.default_rng(3))
    along = plain.points[:, :, 0] - TRUE.translation[0]
    bow = 0.0002 * (along[..., None] / 0.035) ** 2 * TRUE.rotation[:, 2]
    bent: Cloud = replace(plain, points=plain.points + bow)
    seen, moved = Scan.of(bent), bow[bent.subsample(10_000)][:, :, None]
    pose = register(seen, nominal("pot"), Prior(TRUE, BOARD)).base_from_surface
    assert dissent(seen, pose, nominal("pot"), TOLERANCE).excess > 0.5
    assert dissent(seen, pose, nominal("pot"), TOLERANCE, moved).excess < 0.05


@pytest.mark.parametrize("worn", [0.1e-3, 0.2e-3])
def test_a_wear_too_small_to_be_refused_is_stated_as_a_tilt_that_is_less_well_known(worn: float):
    found = invert_pose(
        deformed_pot(lambda x: worn * np.maximum(x, 0) / 0.035), nominal("pot"), Prior(TRUE, BOARD), TOLERANCE
    )
    tilt = np.abs(difference(found.base_from_surface, TRUE)[4])
    assert 0.1 < found.parts_differ < 0.5
    assert tilt > 5.0 * np.sqrt(found.random[4, 4]) and tilt > 0.5 * worn / 0.07
    assert tilt < 2.5 * found.sigma[4]


def test_a_surface_worn_like_a_ramp_is_not_taken_for_a_tilted_one():
    for seed in (0, 12):
        judged = judge_case("worn 0.3 to 2 mm on one side", seed)
        assert judged.ended == "refused"
        assert "the parts of the surface do not agree" in judged.reason


@pytest.mark.parametrize(("part", "seed"), [("seat", 1), ("seat", 30), ("pot", 6)])
def test_starts_that_mislead_a_search_with_few_points_lead_to_the_true_pose(part: str, seed: int):
    for outcome in task(part, seed):
        assert outcome.error[0] < 5e-5, outcome
        assert outcome.error[1] < 2e-3, outcome


def with_chip(
    record: JobRecord, height: float, radius: float = 1.5e-3, at: tuple[float, float] = (0.012, 0.005)
) -> Cloud:
    """The cloud of `record` as if a round chip lay on the surface, m."""
    cloud, pose = record.results["reconstruct"].cloud, record.results["invert_pose"].base_from_surface
    local = (cloud.points - pose.translation) @ pose.rotation
    on_chip = np.hypot(local[..., 0] - at[0], local[..., 1] - at[1]) < radius
    return replace(cloud, points=cloud.points + np.where(on_chip[..., None], height * pose.rotation[:, 2], 0.0))


def standing(record: JobRecord, cloud: Cloud, aside: float = 0.0) -> Standing | None:
    """What stands highest below the part, put down so many metres aside."""
    job, nominal = pot()
    pose = record.results["invert_pose"].base_from_surface
    return highest_standing(cloud, nominal, pose, from_parts((aside, 0.0, 0.0)), job.grasp.size)


def test_nothing_stands_on_a_surface_that_is_as_drawn(placed_pot: JobRecord):
    found = standing(placed_pot, placed_pot.results["reconstruct"].cloud)
    assert found is not None and found.height < 0.1e-3
    require_bare(found, pot()[0].place.tolerance)


@pytest.mark.parametrize(
    ("height", "at"), [(0.45e-3, (0.012, 0.005)), (1e-3, (-0.0153, -0.0041)), (2e-3, (0.0206, -0.0107))]
)
def test_a_chip_of_three_millimetres_is_seen_as_high_as_it_is(
    placed_pot: JobRecord, height: float, at: tuple[float, float]
):
    found = standing(placed_pot, with_chip(placed_pot, height, at=at))
    assert found is not None and found.height == pytest.approx(height, abs=0.12e-3)
    assert np.hypot(*(found.at[:2] - at)) < 1.5e-3
    with pytest.raises(RefusedError, match=r"something stands (\d\.\d\d) mm out of the surface") as refused:
        require_bare(found, pot()[0].place.tolerance)
    (number,) = refused.value.numbers
    assert number.value > number.most == pytest.approx(0.3)


def test_what_stands_higher_than_the_part_is_seen_too_and_a_place_that_was_not_seen_is_not_bare():
    job, cloud = pot()[0], scan(PARTS["pot"], np.random.default_rng(3))
    local = (cloud.points - TRUE.translation) @ TRUE.rotation
    on_bolt = np.abs(local[..., :2] - 0.004).max(axis=-1) < 0.005
    cloud.points[on_bolt] += 0.02 * TRUE.rotation[:, 2]
    found = highest_standing(cloud, nominal("pot"), TRUE, from_parts((0.0, 0.0, 0.0)), job.grasp.size)
    assert found is not None and found.height == pytest.approx(0.02, abs=2e-3)
    with pytest.raises(RefusedError, match="something stands"):
        require_bare(found, job.place.tolerance)
    aside = highest_standing(cloud, nominal("pot"), TRUE, from_parts((0.2, 0.0, 0.0)), job.grasp.size)
    with pytest.raises(RefusedError, match=r"nothing of the surface below the part.*scan\.swath"):
        require_bare(aside, job.place.tolerance)


def test_what_lies_beside_the_part_or_below_the_surface_does_not_lift_it(placed_pot: JobRecord):
    beside = standing(placed_pot, with_chip(placed_pot, 1e-3), aside=-0.03)
    hollow = standing(placed_pot, with_chip(placed_pot, -1e-3))
    for found in (beside, hollow):
        assert found is not None and found.height < 0.1e-3


def placing(record: JobRecord, folder: Path, cloud: Cloud, notify: Callable[[Event], None]) -> str:
    """Why the step that places after a scan of this `cloud` is refused, in the cell of `record`, before it moves."""
    job, nominal = pot()
    cell = VirtualCell(CONFIG, record.seed, record.level)
    at_station(cell, record)
    work = work_of(cell, job, nominal, record, NoFrames(), folder)
    made = {name: result for name, result in record.results.items() if name != "place"}
    made["reconstruct"] = replace(made["reconstruct"], cloud=cloud)
    context = StepContext(PLACE.policy().of("place"), 1, math.inf, made, cell.clock, notify)
    before = cell.clock.now()
    with pytest.raises(RefusedError) as refused:
        STEP.work(work, context)
    assert cell.clock.now() == before and cell.world.part.held
    return str(refused.value)


def test_the_job_ends_before_anything_moves(placed_pot: JobRecord, tmp_path):
    told = placing(placed_pot, tmp_path, with_chip(placed_pot, 1e-3), lambda event: None)
    assert "Look what it is" in told and re.search(r"at \(1[123], [456], \d+\) mm", told)


def test_a_place_of_which_little_was_scanned_is_told_of(placed_pot: JobRecord, tmp_path):
    def ended(event: Event) -> None:
        raise RefusedError(str(event.data["text"]))

    whole = placed_pot.results["reconstruct"].cloud
    first = np.arange(whole.shape[0]) < whole.shape[0] // 3
    third = replace(whole, points=np.where(first[:, None, None], whole.points, np.nan))
    told = placing(placed_pot, tmp_path, third, ended)
    assert re.match(r"2\d % of the surface below the part were scanned", told)
