"""A placed part's figures against closed forms; where it is seen is tested at `verify`."""

from dataclasses import replace
from typing import cast

import numpy as np
import pinocchio as pin
import pytest
import scipy

from cell.config.job import FeatureSection, job_path, load_job
from cell.measure.geometry.poses import from_parts
from cell.measure.inversion import NominalSurface, PlacePose
from cell.measure.inversion.flush import Flush
from cell.measure.inversion.local_deviation import LocalDeviation, Span
from cell.measure.inversion.mating import drawn_gap
from cell.measure.inversion.nominal import read_mesh
from cell.measure.inversion.observability import SmallMotion
from cell.measure.inversion.part_pose import PartPose
from cell.procedures.placed_part import AMISS, BENT, LIKELY, OFF_DRAWING, UNCLEAR, WHOLE, PlacedPart, along_surface
from drivers.errors import MisplacedError
from lab.bench.job.part_jobs import body
from tests.support.lying_part import moved

JOB, _ = load_job("pot")
PLACE = JOB.place
STATED = np.diag([0.1e-3**2] * 3 + [1e-3**2] * 3)
POINTS = np.array([[x, y, 0.0] for x in (-0.02, 0.0, 0.02) for y in (-0.01, 0.01)])


class Shows:
    """A fit of which the verdict names these motions."""

    def __init__(self, *weak: str) -> None:
        self.verdict = self
        self.n_points = 1000
        self.weak = [
            SmallMotion(np.zeros(3), np.zeros(3), 2.0, f"{words} is not determined: 3σ 6 mm") for words in weak
        ]


def part(off: pin.SE3, sigma: float = 10e-6, *, beside: int = 900, weak: tuple[str, ...] = ()) -> PlacedPart:
    """One that was seen `off` its place, known to `sigma` m, and to `sigma` over 20 mm."""
    covariance = np.diag([sigma**2] * 3 + [(sigma / 0.02) ** 2] * 3)
    if weak:
        covariance[0, 0] = 2e-3**2
    seen = PartPose(pin.SE3.Identity(), off, covariance, cast(PlacePose, Shows(*weak)), beside)
    job = JOB.model_copy(update={"place": PLACE.model_copy(update={"verify": "seen" if weak else "all"})})
    return PlacedPart.of(job, seen, POINTS, STATED)


def test_a_shift_is_what_every_point_is_off_by_and_the_bound_what_chance_adds():
    found = part(moved(0.3e-3), sigma=1e-9)
    assert found.off == pytest.approx(0.3e-3) and found.bound["d"] == pytest.approx(0.3, abs=1e-4)
    assert found.bound["x"] == pytest.approx(0.3, abs=1e-4) and found.bound["z"] < 1e-3
    still = replace(part(moved(), sigma=10e-6), covariance=np.diag([10e-6**2] * 3 + [1e-18] * 3))
    # All points move alike: each draw's distance is a Maxwell variable, of which 99.9 % lie below 4.03 sigma.
    assert still.bound["d"] == pytest.approx(1e3 * 10e-6 * scipy.stats.maxwell.ppf(0.999), rel=0.05)


def test_a_turn_moves_the_points_as_one_body():
    """Known about y alone: opposite ends go opposite ways, and what lies on the axis stays."""
    sure = np.full(6, 1e-12)
    sure[4] = 1e-3
    found = replace(part(moved()), covariance=np.diag(sure**2))
    middle = np.abs(found.points[:, 0]) < 1e-9
    left, right = found._errors[:, found.points[:, 0] < -0.01], found._errors[:, found.points[:, 0] > 0.01]
    assert np.allclose(left[..., 2], -right[..., 2], atol=1e-9) and np.abs(found._errors[:, middle]).max() < 1e-9
    assert found.turn_bound == pytest.approx(1e-3 * scipy.stats.norm.ppf(0.9995), rel=0.06)


@pytest.mark.parametrize(
    ("off", "likely"),
    [
        (moved(0.5e-3, z=0.5e-3, turn=(0.0, 0.006, 0.0)), LIKELY["shifted"]),
        (moved(turn=(0.0, 0.0, 0.004)), LIKELY["shifted"]),
        (moved(z=0.5e-3, turn=(0.0, 0.006, 0.0)), LIKELY["tilted"]),
        (moved(z=0.5e-3), LIKELY["raised"]),
        (moved(z=-0.5e-3), LIKELY["deep"]),
        (moved(0.2e-3, z=0.2e-3), UNCLEAR),
    ],
)
def test_the_first_motion_that_chance_does_not_bring_is_the_cause(off: pin.SE3, likely: str):
    found = part(off)
    assert found.likely == likely
    assert any(f"most likely {likely}" in note for note in found.notes) == (likely != UNCLEAR)


def test_a_part_is_kept_only_where_its_bound_is_inside_both_tolerances():
    assert part(moved(0.5e-3)).in_tolerance(PLACE)
    assert not part(moved(0.5e-3), sigma=0.1e-3).in_tolerance(PLACE), "it may lie farther"
    assert not part(moved(turn=(0.0, 0.0, 0.007))).in_tolerance(PLACE)
    told = str(part(moved(0.7e-3), beside=0).misplaced(PLACE, "It was not corrected: why"))
    assert "against the surface as swept before" in told and "Leave 10 mm of the surface free" in told
    assert "It was not corrected: why. See to it" in told


def test_what_is_not_seen_moves_nothing_and_is_known_as_stated():
    found = part(moved(1.5e-3, z=0.2e-3), weak=("translation along the x axis of the surface frame",))
    assert found.unseen == ("translation along the x axis of the part frame",)
    assert np.allclose(found.seen.surface_from_part.translation, [0.0, 0.0, 0.2e-3], atol=1e-9)
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(0.1e-3) and np.sqrt(found.covariance[2, 2]) < 20e-6
    seen = replace(found.seen, covariance=np.diag([2e-3**2] + [1e-10] * 5))
    with pytest.raises(MisplacedError, match=r"not all is seen .*part frame.*place\.verify"):
        PlacedPart.of(JOB, seen, POINTS, STATED)


def test_a_part_that_seems_to_go_into_the_surface_may_be_off_by_what_brings_it_out():
    file = job_path("pot").with_name("pot.ply")
    vertices, faces = read_mesh(file, "m")
    drawn, nominal = body(vertices, faces), NominalSurface(vertices, faces)
    underside = NominalSurface(drawn.vertices, drawn.faces)
    there, rests = part(moved(0.3e-3)), part(moved())
    gap, flush = (drawn_gap(nominal, each.seen.surface_from_part, underside) for each in (there, rests))
    found = there.over(gap)
    assert 0.05e-3 < found.interference < 0.2e-3 and any("would go into the surface" in note for note in found.notes)
    assert np.sqrt(np.diag(found.covariance))[:3] == pytest.approx([0.3e-3, 1e-5, 1e-5], abs=0.02e-3)
    assert there.in_tolerance(PLACE) and not found.in_tolerance(PLACE)
    told = str(found.misplaced(PLACE))
    assert AMISS in told and UNCLEAR not in told and "would go into the surface" in told
    assert rests.over(flush).interference == 0.0 and np.array_equal(rests.over(flush).covariance, rests.covariance)
    high = part(moved(z=0.1e-3))
    up = drawn_gap(nominal, high.seen.surface_from_part, underside)
    assert high.over(up).interference == 0.0, "it may lie on something"
    again = high.over(up, (0.2e-3,))
    assert again.interference == pytest.approx(-0.1e-3, abs=2e-6) and not again.in_tolerance(PLACE)
    assert np.sqrt(np.diag(again.covariance))[:3] == pytest.approx([0.2e-3, 0.2e-3, 1e-5], abs=2e-6), "it went there"
    tilted = part(moved(turn=(0.0, 0.008, 0.0)), sigma=2e-6)
    edge = drawn_gap(nominal, tilted.seen.surface_from_part, underside)
    assert (
        edge is not None and tilted.over(replace(edge, gaps=edge.gaps - edge.gaps.min()), (0.2e-3,)).interference == 0.0
    )
    assert again.before == (0.2e-3,) and any("would hang above the surface by 0.10 mm" in note for note in again.notes)
    unsure = part(moved(0.3e-3), sigma=0.1e-3)
    assert unsure.over(gap).interference == 0.0, "it may lie where it goes into nothing"
    unseen = part(moved(0.3e-3), weak=("translation along the x axis of the surface frame",))
    assert unseen.over(gap).interference == 0.0, "it was not seen where it lies"


def test_of_a_motion_only_what_is_along_the_surface_counts_as_aside():
    found = along_surface(moved(0.3e-3, -0.2e-3, 0.4e-3, turn=(0.005, -0.004, 0.006)))
    assert np.allclose(found.translation, [0.3e-3, -0.2e-3, 0.0])
    assert np.allclose(pin.log3(found.rotation), [0.0, 0.0, 0.006], atol=1e-6)
    assert part(moved(z=0.4e-3, turn=(0.0, 0.005, 0.0))).aside < 1e-6
    assert part(from_parts((0.3e-3, 0.4e-3, 0.2e-3))).aside == pytest.approx(0.5e-3)


def test_an_edge_that_stands_too_high_is_no_part_in_its_place():
    """It lies as it should, and is bent."""
    noise = np.full(3, 0.05e-3)
    along = [Flush(np.zeros((3, 3)), np.array([0.0, 0.1e-3, top]), noise) for top in (0.64e-3, 0.66e-3, -0.66e-3)]
    kept, high, low = (replace(part(moved(0.1e-3)), flush=flush) for flush in along)
    assert kept.in_tolerance(PLACE) and "flush +0.00 to +0.64 mm" in kept.words
    assert not high.in_tolerance(PLACE) and not low.in_tolerance(PLACE)
    refused = high.misplaced(PLACE)
    assert BENT in str(refused) and [number.kept for number in refused.numbers] == [True, True, False]
    assert BENT not in str(replace(high, seen=part(moved(0.9e-3)).seen).misplaced(PLACE)), "it also lies aside"
    assert high.summary()["flush"] == along[1].as_dict()
    told = str(part(moved(0.1e-3)).misplaced(PLACE, "It was not corrected: why"))
    assert BENT not in told, "nothing says so where its edge was not looked at"
    assert any("look along the rest" in note for note in replace(kept, flush=replace(along[0], seen=0.2)).notes)


def test_a_feature_out_of_its_own_tolerance_is_no_part_in_its_place():
    """As a whole the part keeps the place's tolerance of .6 mm."""
    table = {"kind": "hole", "at": ["20 mm", "0 mm", "0 mm"], "axis": [0, 0, 1]}
    named = tuple(
        FeatureSection.model_validate({**table, "name": name, "tolerance": tolerance})
        for name, tolerance in (("wide", "0.5 mm"), ("narrow", "0.2 mm"))
    )
    found = replace(part(moved(0.3e-3)), named=named)
    assert part(moved(0.3e-3)).in_tolerance(PLACE) and not found.in_tolerance(PLACE)
    assert replace(part(moved(0.1e-3)), named=named).in_tolerance(PLACE)
    told = found.misplaced(PLACE)
    assert "Out of tolerance: the hole narrow is 0.30 mm off" in str(told) and "hole wide" not in str(told)
    assert [number.kept for number in told.numbers] == [True, True, True, False]
    assert BENT not in str(told)
    features = cast(list[dict[str, object]], found.summary()["features"])
    assert [each["name"] for each in features] == ["wide", "narrow"]


def test_a_part_that_is_off_its_drawing_about_a_feature_is_told_as_that():
    """As a whole it lies in its place; one that lies aside as well is told by where it lies."""
    table = {"kind": "flat", "at": ["0 mm", "0 mm", "0 mm"], "axis": [0, 0, 1], "tolerance": "0.3 mm"}
    named = tuple(FeatureSection.model_validate({**table, "name": name}) for name in ("worn", "top"))
    worn = {"worn": LocalDeviation(Span(-0.5e-3, -0.4e-3))}
    found = replace(part(moved(0.1e-3)), named=named, own=worn)
    told = str(found.misplaced(PLACE))
    assert not found.in_tolerance(PLACE) and not found.not_aside.in_tolerance(PLACE)
    assert OFF_DRAWING in told and "flat worn is 0.3" in told and "flat top" not in told
    assert OFF_DRAWING not in str(replace(found, seen=part(moved(0.9e-3)).seen).misplaced(PLACE))
    # Of what nobody saw by itself, that is said.
    assert WHOLE.format("flat", "top") in found.notes and WHOLE.format("flat", "worn") not in found.notes


def test_moved_to_where_it_belongs_along_the_surface_it_is_as_high_and_as_tilted():
    found = part(moved(0.5e-3, -0.3e-3, 0.2e-3, turn=(0.003, 0.0, 0.004))).not_aside
    assert found.aside < 2e-6 and found.offsets[:, 2].mean() == pytest.approx(0.2e-3, abs=0.02e-3)
    assert np.allclose(found.turn, [0.003, 0.0, 0.0], atol=2e-5)


def test_its_figures_are_those_of_its_points():
    off = moved(0.2e-3, -0.1e-3, 0.4e-3, turn=(0.001, -0.002, 0.003))
    found = replace(part(off, sigma=20e-6), before=(0.9e-3, 0.7e-3))
    apart = POINTS @ off.rotation.T + off.translation - POINTS
    mean = float(np.linalg.norm(apart, axis=1).mean())
    aside = np.array([0.2e-3, -0.1e-3, 0.0]) + np.cross([0.0, 0.0, 0.003], POINTS)
    assert found.off == pytest.approx(mean) and found.off < 0.95 * np.linalg.norm(apart, axis=1).max()
    assert found.aside == pytest.approx(float(np.linalg.norm(aside, axis=1).mean()), rel=0.02)
    assert found.summary() == {
        "off_mm": pytest.approx(1e3 * mean, abs=1e-4), "unsure_mm": round(1e3 * found.unsure, 4),
        "shift_mm": pytest.approx((1e3 * apart.mean(axis=0)).tolist(), abs=1e-4),
        "turn_mrad": pytest.approx([1.0, -2.0, 3.0], abs=1e-4), "sigma_mm": [0.02] * 3, "sigma_mrad": [1.0] * 3,
        "points": 1000, "beside": 900, "unseen": [], "gap": None, "flush": None, "features": [], "unlike": None,
            "before_mm": [0.9, 0.7],
    }  # fmt: skip
    assert found.words == f"{1e3 * mean:.2f} ± {1e3 * found.unsure:.2f} mm off"
    x, y, z = 1e3 * apart.mean(axis=0)
    told = str(found.misplaced(PLACE))
    assert f"by ({x:+.2f}, {y:+.2f}, {z:+.2f}) mm and (+1.0, -2.0, +3.0) mrad in the surface's axes" in told
    most = f"{found.bound['d']:.2f} mm and {1e3 * found.turn_bound:.1f} mrad"
    assert f"Allowed are 0.6 mm and 6 mrad; it may be as much as {most}" in told


def test_what_95_percent_of_its_points_are_known_to():
    """A shift along one axis alone: of its normal deviate 95 % lie below 1.96 sigma."""
    sure = np.full(6, 1e-12)
    sure[1] = 20e-6
    found = replace(part(moved()), covariance=np.diag(sure**2))
    assert found.unsure == pytest.approx(20e-6 * scipy.stats.norm.ppf(0.975), rel=0.05)
    turned = np.diag([1e-24] * 3 + [1e-3**2] * 3)
    assert replace(part(moved()), covariance=turned).turn_bound == pytest.approx(
        1e-3 * scipy.stats.maxwell.ppf(0.999), rel=0.05
    )
