"""A part out of its place is gripped again and placed by what was seen, where that helps, and only there."""

import math
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from cell.devices.simulated.direct import VirtualCell
from cell.motion.collision import PLACED
from cell.procedures.grasp import GraspSeries, best_expected
from cell.procedures.steps import verify
from drivers.errors import MisplacedError, RefusedError
from lab.bench.job.part_effects import motion, opened
from lab.bench.job.whole_job import JobRecord
from statemachine.step import OnFailure
from tests.support.lying_part import Lying, LyingPart, moved
from tests.support.report_runs import pot


def test_a_part_that_lies_aside_is_gripped_and_placed_where_it_belongs(lying_part: Lying):
    site = lying_part(also="corrections = 1")
    found = site.looked(moved(0.2e-3, 0.8e-3, 0.35e-3, turn=(0.0, 0.0, 0.007)))
    (before,) = found.before
    assert before > 0.7e-3 and found.off < 0.15e-3
    assert found.summary()["before_mm"] == [pytest.approx(1e3 * before, abs=1e-3)]
    assert site.parts == ["unknown", "held", "unknown", "released"], "whoever finds the run cut short knows"
    assert site.carried == [False, False, True, True], (
        "whoever moves with the part in the claw knows how far it reaches"
    )
    assert not site.cell.world.part.held and site.cell.world.collisions.found == ()
    true = site.lies()
    assert np.linalg.norm(true.translation) < 0.2e-3 and np.abs(pin.log3(true.rotation)).max() < 1e-3
    assert any("it is gripped and placed again" in note for note in site.notes)


def test_a_part_that_lies_on_something_is_left_there(lying_part: Lying):
    """Placed again it would lie as high."""
    site = lying_part(also="corrections = 3")
    # Moved to its place along the surface it would be as high.
    with pytest.raises(MisplacedError, match="it lies on something"):
        site.looked(moved(0.15e-3, z=0.8e-3))
    assert site.parts == []
    assert any("what the part lies on, or is, and comes again" in note for note in site.notes)
    assert any(note.startswith("no correction of the placed part") for note in site.notes)


def test_how_a_part_slips_each_time_the_claw_opens_is_seen_and_allowed_for(placed_pot: JobRecord, tmp_path):
    slips = opened(motion(0.5, turn=(0, 0, 3)))
    site = LyingPart(
        placed_pot, tmp_path, also='corrections = 2\naccept = "0.2 mm"', changed=lambda cell: slips(cell.world)
    )
    found = site.looked(moved(0.5e-3, z=0.2e-3))
    assert [round(1e3 * off, 1) for off in found.before] == [pytest.approx(0.5, abs=0.15)] * 2, "as far off again"
    assert found.off < 0.2e-3 and len(found.slips) == 2
    assert found.slips[0].translation == pytest.approx([0.5e-3, 0.0, 0.0], abs=0.15e-3)
    # A part that comes after others that slipped so is placed well at once.
    slip = moved(0.5e-3, turn=(0.0, 0.0, 3e-3))
    site.series = GraspSeries().after(slip, [slip, slip])
    again = site.looked(moved(0.5e-3, z=0.2e-3))
    assert len(again.before) == len(again.slips) == 1 and again.off < 0.2e-3
    assert np.allclose(again.slips[0].translation, slip.translation, atol=0.15e-3)


def test_what_is_in_the_way_to_the_part_ends_the_run_with_the_part_where_it_lay(
    placed_pot: JobRecord, lying_part: Lying
):
    """A force on the fingers from 10 mm above it on, as of a bolt that stands beside the part."""

    def bolt(cell: VirtualCell) -> None:
        touch, low = cell.world.arm.contact, float(placed_pot.results["place"].base_from_flange.translation[2]) + 0.010

        def met(base_from_flange: Any) -> Any:
            wrench = touch(base_from_flange)
            wrench[2] += 20.0 * (base_from_flange[2, 3] < low)
            return wrench

        cell.world.arm.contact = met

    def pushed(cell: VirtualCell, text: str) -> None:
        """The claw has pushed it aside as it touched."""
        if text.startswith("it was not corrected"):
            part = cell.world.part
            part._world_from_part = part._world_from_part @ moved(x=0.25e-3).homogeneous

    # One that lies in its place, and might lie better, stays there: where the claw may have moved it, by another look.
    near = lying_part(also='corrections = 1\naccept = "0.1 mm"', changed=bolt, heard=pushed)
    found = near.looked(moved(y=0.2e-3, z=0.1e-3))
    assert found.in_tolerance(pot()[0].place) and near.parts == []
    assert found.seen.surface_from_part.translation == pytest.approx([0.25e-3, 0.2e-3, 0.1e-3], abs=0.03e-3)
    assert any("it was not corrected: the claw touched something" in note for note in near.notes)
    site = lying_part(also="corrections = 1", changed=bolt)
    off = moved(y=0.8e-3, z=0.35e-3)
    with pytest.raises(RefusedError, match="the claw touched something as it went to grip the placed part"):
        site.looked(off)
    assert site.parts == []
    assert PLACED in site.stands(), "whoever moves next keeps clear of it"
    assert np.allclose(site.lies().homogeneous, off.homogeneous, atol=1e-9)


def test_what_is_interrupted_is_left_to_a_person():
    """The part may be between the fingers then."""
    step = verify.STEP.policy
    assert (step.max_retries, step.retry_on, step.on_failure) == (0, (), OnFailure.STOP)


def test_a_part_that_lies_too_far_aside_is_not_gripped(lying_part: Lying):
    site = lying_part(also="corrections = 1")
    with pytest.raises(MisplacedError):
        site.looked(moved(3e-3, z=1.5e-3))
    assert site.parts == [] and any("farther than 2 mm" in note for note in site.notes)


def test_the_more_corrections_are_left_the_less_is_one_content_with():
    """Closed forms of a Rayleigh distribution: its mean, and the mean of the lesser of a draw and that."""
    sigma = 40e-6
    drawn = np.random.default_rng(7).rayleigh(sigma, 400_000)
    mean = sigma * math.sqrt(math.pi / 2)
    assert best_expected(drawn, 1) == pytest.approx(mean, rel=5e-3)
    assert best_expected(drawn, 2) == pytest.approx(mean * math.erf(mean / (sigma * math.sqrt(2))), rel=5e-3)
    assert best_expected(drawn, 3) < best_expected(drawn, 2) - 4e-6
