"""Named features of a placed part against closed forms."""

import json
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
import scipy
from pydantic import ValidationError

from cell.check.fit import require_fit
from cell.config.cell_config import load_config
from cell.config.job import FeatureSection, PartSection, load_job
from cell.measure.geometry.poses import from_parts
from cell.measure.inversion.local_deviation import LocalDeviation, Rim, Span
from cell.procedures.part_features import FeatureSeen, by_themselves, counting
from drivers.errors import ConfigError
from lab.bench.job.part_jobs import job_with_part
from tests.unit.cell.measure.inversion.test_flush import BELONGS
from tests.unit.cell.measure.inversion.test_local_deviation import HOLE, PLACE, pierced
from tests.unit.cell.measure.inversion.test_registration import TRUE, scanned

PERCENT = 99.9


def feature(kind: str, axis: tuple[float, ...], at: tuple[str, ...] = ("20 mm", "0 mm", "10 mm")) -> FeatureSection:
    return FeatureSection.model_validate(
        {"name": "rim", "kind": kind, "at": list(at), "axis": list(axis), "tolerance": "0.3 mm"}
    )


def sure(section: FeatureSection, seen: pin.SE3, belongs: pin.SE3 | None = None) -> FeatureSeen:
    where = pin.SE3.Identity() if belongs is None else belongs
    return FeatureSeen.of(section, seen, where, motions=np.zeros((10, 6)), percent=PERCENT)


def test_a_flat_counts_along_its_normal_and_the_others_across_their_direction():
    off = from_parts((0.3e-3, 0.4e-3, 1.2e-3))
    assert sure(feature("flat", (0, 0, 1)), off).off == pytest.approx(1.2e-3)
    assert sure(feature("flat", (0, 0, 0.5)), off).off == pytest.approx(1.2e-3), "of any length"
    for kind in ("edge", "hole", "pin"):
        assert sure(feature(kind, (0, 0, 1)), off).off == pytest.approx(0.5e-3)
    assert sure(feature("edge", (1, 0, 0)), off).off == pytest.approx(np.hypot(0.4e-3, 1.2e-3))
    assert sure(feature("flat", (0.6, 0.8, 0)), off).off == pytest.approx(0.5e-3)


def test_a_turned_part_moves_a_feature_by_its_arm():
    turned = from_parts((0.0, 0.0, 0.0), pin.exp3(np.array([0.0, 0.0, 2e-3])))
    # 20 mm from the origin: 40 um to the side, and next to nothing along the arm.
    assert sure(feature("flat", (0, 1, 0)), turned).off == pytest.approx(40e-6, rel=1e-3)
    assert sure(feature("flat", (1, 0, 0)), turned).off < 1e-7


def test_axes_are_the_parts_and_turn_with_its_place():
    belongs = from_parts((0.01, 0.0, 0.0), pin.exp3(np.array([0.0, 0.0, np.pi / 2])))
    seen = from_parts((0.01, 0.3e-3, 0.0), belongs.rotation)
    # The part's x axis lies along the surface's y axis.
    found = sure(feature("flat", (1, 0, 0)), seen, belongs)
    assert found.off == pytest.approx(0.3e-3) and sure(feature("flat", (0, 1, 0)), seen, belongs).off < 1e-9
    assert np.allclose(found.belongs, [0.01, 0.02, 0.01])
    projection = counting(feature("hole", (0.3, -0.5, 0.8)), belongs.rotation)
    assert np.allclose(projection @ projection, projection) and np.trace(projection) == pytest.approx(2.0)


def test_the_bound_of_a_feature_is_what_chance_adds_at_its_arm():
    rng = np.random.default_rng(3)
    shifts = np.concatenate([20e-6 * rng.standard_normal((200_000, 3)), np.zeros((200_000, 3))], axis=1)
    flat, hole = feature("flat", (0, 0, 1)), feature("hole", (0, 0, 1))
    for section, expected in ((flat, scipy.stats.halfnorm.ppf(0.999)), (hole, scipy.stats.rayleigh.ppf(0.999))):
        found = FeatureSeen.of(section, pin.SE3.Identity(), pin.SE3.Identity(), motions=shifts, percent=PERCENT)
        assert found.off == 0.0 and found.bound == pytest.approx(20e-6 * expected, rel=0.03)
    # Turns about y lift what lies 20 mm along x, and leave what lies on the axis.
    turns = np.zeros((200_000, 6))
    turns[:, 4] = 1e-3 * rng.standard_normal(len(turns))
    lifted = FeatureSeen.of(flat, pin.SE3.Identity(), pin.SE3.Identity(), motions=turns, percent=PERCENT)
    assert lifted.bound == pytest.approx(20e-6 * scipy.stats.halfnorm.ppf(0.999), rel=0.03)
    assert lifted.measured.kept and lifted.measured.most == pytest.approx(0.3)
    assert not replace(lifted, bound=0.31e-3).measured.kept
    assert json.loads(json.dumps(lifted.as_dict()))["bound_mm"] == round(1e3 * lifted.bound, 4)


def test_what_the_points_about_a_feature_say_by_themselves_counts_where_the_drawing_does_not_explain_it():
    here, still = pin.SE3.Identity(), np.zeros((10, 6))
    worn, inside = Span(-0.25e-3, -0.15e-3), Span(-0.05e-3, 0.05e-3)

    def of(kind: str, axis: tuple[float, ...], own: LocalDeviation) -> FeatureSeen:
        return FeatureSeen.of(feature(kind, axis), here, here, motions=still, percent=PERCENT, own=own)

    flat = of("flat", (0, 0, 1), LocalDeviation(worn))
    assert flat.off == flat.own_off == pytest.approx(0.15e-3) and flat.bound == pytest.approx(0.25e-3)
    assert "the part is off its drawing there by 0.15 mm" in flat.words
    assert flat.as_dict()["own_higher_mm"] == [-0.25, -0.15] and flat.as_dict()["own_farther_mm"] is None
    assert of("hole", (0, 0, 1), LocalDeviation(worn)).bound == 0.0, "along its direction nothing counts"
    # A hole along z: its middle lies .3 to .5 mm aside along x, and may lie where it is drawn along y.
    aside = ((Span(0.3e-3, 0.5e-3), np.array([1.0, 0.0, 0.0])), (inside, np.array([0.0, 1.0, 0.0])))
    hole = of("hole", (0, 0, 1), LocalDeviation(middle=aside))
    assert hole.off == pytest.approx(0.3e-3) and hole.bound == pytest.approx(0.5e-3) and hole.asked
    assert hole.as_dict()["own_aside_mm"] == [[0.3, 0.5], [-0.05, 0.05]] and not hole.measured.kept
    lower, own = still + 0.2e-3 * np.eye(6)[2], LocalDeviation(worn)
    unsure = FeatureSeen.of(feature("flat", (0, 0, 1)), here, here, motions=lower, percent=PERCENT, own=own)
    assert unsure.own_off == 0.0 and unsure.asked, "the part may lie as much lower"
    kept = of("flat", (0, 0, 1), LocalDeviation(inside))
    assert kept.off == kept.bound == kept.own_off == 0.0 and "drawing" not in kept.words
    # An edge along y: it is .15 mm low, and ends .4 to .6 mm farther along x.
    edge = of("edge", (0, 1, 0), LocalDeviation(worn, Rim(Span(0.4e-3, 0.6e-3), np.array([1.0, 0.0, 0.0]))))
    assert edge.off == pytest.approx(np.hypot(0.15e-3, 0.4e-3)) and edge.bound == pytest.approx(edge.off + 0.3e-3)
    assert not edge.measured.kept and edge.as_dict()["own_farther_mm"] == [0.4, 0.6]


def test_each_kind_of_feature_is_asked_for_what_its_points_tell():
    """A plate with a hole that lies .8 mm aside."""
    at = tuple(f"{1e3 * value} mm" for value in (*PLACE, 0.0))
    named = (feature("hole", (0, 0, 1), at), feature("edge", (0, 1, 0), ("20 mm", "0 mm", "0 mm")))
    named = tuple(one.model_copy(update={"name": one.kind}) for one in named)
    job = SimpleNamespace(part=SimpleNamespace(feature=named))
    seen = SimpleNamespace(base_from_surface=TRUE, surface_from_part=BELONGS, rocked=0.0)
    found = by_themselves(job, scanned(partial(pierced, by=(0.8e-3, 0.0)), 5), seen, HOLE)  # type: ignore[arg-type]
    assert found["hole"].rim is None and len(found["hole"].middle) == 2
    assert max(abs(span.off) for span, _ in found["hole"].middle) > 0.4e-3
    assert found["edge"].middle == () and found["edge"].rim is not None and found["edge"].rim.farther.off == 0.0
    job.part = None
    assert by_themselves(job, None, seen, HOLE) == {}  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"axis": [0, 0, 0]}, "has no direction"),
        ({"axis": [0, 0, 2]}, "-1 to 1"),
        ({"kind": "corner"}, "flat"),
        ({"tolerance": "0 mm"}, "0.01"),
        ({"name": "a/b"}, "is no name"),
    ],
)
def test_what_is_no_feature_is_told(change: dict[str, object], told: str):
    table = {"name": "rim", "kind": "edge", "at": ["0 mm", "0 mm", "0 mm"], "axis": [1, 0, 0], "tolerance": "0.3 mm"}
    with pytest.raises(ValidationError, match=told):
        FeatureSection.model_validate(table | change)
    with pytest.raises(ValidationError, match="feature rim is there twice"):
        PartSection.model_validate({"mesh": "a.ply", "mesh_unit": "m", "feature": [table, table]})


def test_features_beside_the_part_and_those_that_nobody_looks_at_are_told_before_anything_moves(tmp_path):
    job, mesh = load_job(job_with_part(tmp_path, "pot", verify="all"))
    on, off = (
        feature("edge", (0, 1, 0), ("0 mm", "0 mm", "5 mm")),
        feature("edge", (0, 1, 0), ("0 mm", "90 mm", "5 mm")),
    )
    config = load_config(None)
    told = r"part\.feature rim: at lies \d\d\.\d mm beside the box .*at most 2 mm"
    for section, verify, problem in ((on, "all", None), (off, "all", told), (on, "none", "nobody looks")):
        place = job.place.model_copy(update={"verify": verify})
        part = job.part.model_copy(update={"feature": (section,)})
        named = job.model_copy(update={"part": part, "place": place})
        if problem is None:
            require_fit(named, config, mesh)
            continue
        with pytest.raises(ConfigError, match=problem):
            require_fit(named, config, mesh)
