"""What the points about a feature say by themselves, in scans whose truth is known; a part in the world: `verify`."""

from dataclasses import replace
from functools import partial

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from cell.measure.geometry.poses import from_parts
from cell.measure.inversion import NominalSurface
from cell.measure.inversion.flush import heights_over
from cell.measure.inversion.local_deviation import BLUR_M, LocalDeviation, Span, higher_about, seen_middle, seen_rim
from cell.measure.reconstruction.cloud import Cloud
from tests.unit.cell.measure.inversion.test_flush import BELONGS, HALF, THICK, TOP, in_surface, swept, with_local
from tests.unit.cell.measure.inversion.test_registration import TRUE, scanned

Array = NDArray[np.float64]
MIDDLE, RIGHT, LEFT, FRONT = ([0.0, 0.0, 0.0], [HALF, 0.0, 0.0], [-HALF, 0.0, 0.0], [0.0, 0.018, 0.0])
ACROSS, ALONG = [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]
LINES_M, ROWS_M = 0.072 / 159, 0.04 / 239


def without(cloud: Cloud, gone: NDArray[np.bool_]) -> Cloud:
    """The cloud without some of its points (lines, rows)."""
    return replace(cloud, points=np.where(gone[..., None], np.nan, cloud.points))


def ends(right: float, seed: int = 5) -> Cloud:
    """A part whose right end is `right` of where it is drawn, m."""
    return scanned(lambda x, y: np.where((x > -HALF) & (x < HALF + right), THICK, 0.0 * y), seed)


def about(
    at: list[float], cloud: Cloud, edge: list[float] | None = None, faces: NominalSurface = TOP,
    lies: pin.SE3 = BELONGS, rocks: float = 0.0,
) -> LocalDeviation:  # fmt: skip
    where, rim = np.array(at), None
    if edge is not None:
        rim = seen_rim(cloud, TRUE, lies, faces=faces, at=where, edge=np.array(edge))
    return LocalDeviation(higher_about(heights_over(cloud, TRUE, lies, faces), lies.act(where), rocks), rim)


def rim(at: list[float], cloud: Cloud, edge: list[float] = ACROSS, faces: NominalSurface = TOP) -> Span:
    return about(at, cloud, edge, faces).rim.farther


@pytest.mark.parametrize("seed", [0, 3, 6])
def test_of_a_part_as_drawn_the_points_about_each_feature_say_no_more_than_its_pose(seed: int):
    shift = 0.0015 + 0.1 * seed * LINES_M, -0.001 + 0.1 * seed * ROWS_M
    cloud = scanned(lambda x, y: np.where(np.abs(x) < HALF, THICK, 0.0 * y), seed, shift=shift)
    for at, edge, apart in ((RIGHT, ACROSS, LINES_M), (LEFT, ACROSS, LINES_M), (FRONT, ALONG, ROWS_M)):
        found = about(at, cloud, edge)
        assert found.higher.off == 0.0 and found.higher.more == 0.0 and found.higher.most < 0.1e-3
        farther, outward = found.rim
        assert farther.off == 0.0 and farther.most - farther.least < 2.0 * BLUR_M + 1.3 * apart
        assert np.allclose(outward, np.sign(at))
        assert [way.tolist() for _, way in found.spans] == [[0.0, 0.0, 1.0], outward.tolist()]


def test_a_flat_that_is_worn_about_a_feature_is_so_much_lower_there_and_nowhere_else():
    local = in_surface(swept(0.0))
    local[np.hypot(local[..., 0], local[..., 1]) < 5e-3, 2] -= 0.3e-3
    worn = with_local(swept(0.0), local)
    found = about(MIDDLE, worn).higher
    assert found is not None and found.least < -0.3e-3 < found.most < -0.25e-3
    assert found.off == found.most and found.more == pytest.approx(found.most - found.least)
    beside = about([0.012, 0.0, 0.0], worn).higher
    assert beside is not None and beside.off == 0.0


@pytest.mark.parametrize("right", [0.9e-3, -0.9e-3])
def test_a_part_that_was_cut_or_grew_ends_so_much_sooner_or_later(right: float):
    found = rim(RIGHT, ends(right))
    assert found.least < right < found.most
    assert np.sign(found.off) == np.sign(right) and abs(right) < abs(found.off) + found.more
    assert rim(LEFT, ends(right)).off == 0.0


def test_an_end_that_is_cut_off_farther_than_is_looked_is_gone():
    found = rim(RIGHT, ends(-9e-3))
    assert found.most < -5e-3 and found.off == found.most
    # Where the sweep shows nothing at all, nobody knows.
    cloud = ends(-9e-3)
    assert about(RIGHT, without(cloud, in_surface(cloud)[..., 0] > HALF - 9e-3), ACROSS).rim is None


def test_an_edge_at_an_angle_to_the_lines_is_looked_for_square_to_itself():
    turn = pin.exp3(np.array([0.0, 0.0, 0.5]))
    square = NominalSurface(np.array([[-8, -8, 0], [8, -8, 0], [8, 8, 0], [-8, 8, 0]]) * 1e-3 @ turn.T, TOP.triangles)

    def turned(x: Array, y: Array, farther: float = 0.0) -> Array:
        u, v = turn.T[:2, :2] @ np.stack([x.ravel(), y.ravel()])
        inside = (np.abs(u) < 8e-3 + farther * (u > 0.0)) & (np.abs(v) < 8e-3)
        return np.where(inside.reshape(x.shape), THICK, 0.0)

    at, edge = (turn @ [8e-3, 0.0, 0.0]).tolist(), turn[:, 1].tolist()
    assert rim(at, scanned(turned, 5), edge, square).off == 0.0
    longer = about(at, scanned(partial(turned, farther=0.8e-3), 5), edge, square).rim
    assert longer is not None and longer.farther.least < 0.8e-3 < longer.farther.most
    assert longer.farther.off > 0.3e-3 and np.allclose(longer.outward, turn[:, 0])


def test_what_is_no_rim_in_the_drawing_or_does_not_show_says_nothing():
    cloud = swept(0.0)
    assert about(MIDDLE, cloud, ACROSS).rim is None, "the face goes on"
    assert about([HALF + 5e-3, 0.0, 0.0], cloud, ACROSS).rim is None, "drawn elsewhere"
    assert about([HALF, 0.0, -6e-3], cloud, ACROSS).spans == (), "below the rim"
    assert about(RIGHT, cloud, [0.0, 0.0, 1.0]).rim is None, "upright"
    thin = about(RIGHT, swept(0.0, thick=0.2e-3), ACROSS, lies=from_parts((0.0, 0.0, 0.2e-3)))
    assert thin.rim is None, "the ground beside it is as high"
    assert about(RIGHT, without(cloud, np.ones(cloud.shape, dtype=bool)), ACROSS).spans == ()


def test_a_sweep_that_ends_before_the_rim_says_nothing_of_it():
    cloud = swept(0.0)
    assert rim(FRONT, without(cloud, in_surface(cloud)[..., 1] > 17e-3), ALONG).off == 0.0
    cut = scanned(lambda x, y: np.where((np.abs(x) < HALF) & (y < 17e-3), THICK, 0.0 * y), 5)
    assert rim(FRONT, cut, ALONG).off < -0.5e-3, "the ground shows beyond it"


@pytest.mark.parametrize("seed", range(2))
def test_a_side_that_leans_outward_is_no_part_of_the_face_above_it(seed: int):
    """By 15 deg: between the face and the ground the sweep sees it."""
    side = np.tan(np.radians(75.0))
    leaning = scanned(lambda x, y: np.clip(THICK - side * (np.abs(x) - HALF), 0.0, THICK), seed)
    assert rim(RIGHT, leaning).off == 0.0 and rim(LEFT, leaning).off == 0.0


def test_a_rim_that_is_drawn_round_is_looked_for_where_it_is_drawn():
    turns = np.linspace(0.0, 2.0 * np.pi, 73)[:-1]
    corners = 3e-3 * np.stack([np.cos(turns), np.sin(turns), 0.0 * turns], axis=1)
    disc = NominalSurface(np.vstack([corners, np.zeros(3)]), [[k, (k + 1) % 72, 72] for k in range(72)])
    cloud = scanned(lambda x, y: np.where(np.hypot(x, y) < 3e-3, THICK, 0.0), 5)
    assert rim([0.0, 3e-3, 0.0], cloud, ALONG, disc).off == 0.0


def test_a_rim_that_something_higher_may_hide_is_not_told_to_end_too_soon():
    tower = np.array([[5, -4, 12], [12, -4, 12], [12, 4, 12], [5, 4, 12]]) * 1e-3
    both = NominalSurface(np.concatenate([TOP.vertices, tower]), [*TOP.triangles, [4, 5, 6], [4, 6, 7]])
    assert rim(RIGHT, ends(-0.9e-3)).off < 0.0
    assert rim(RIGHT, ends(-0.9e-3), faces=both) == Span(rim(RIGHT, ends(-0.9e-3)).least, 0.0)
    assert rim(RIGHT, ends(0.9e-3), faces=both).off > 0.0


def test_a_vehicle_that_rocks_hides_as_much_of_a_height():
    cloud = swept(0.0)
    still, rocked = (about(MIDDLE, cloud, rocks=rocks).higher for rocks in (0.0, 0.1e-3))
    assert rocked.most == pytest.approx(still.most + 0.2e-3) and rocked.least == pytest.approx(still.least - 0.2e-3)


# --- holes and pins ---

RADIUS, PLACE = 4e-3, np.array([6e-3, -3e-3])


def ring(inner: float, height: float, top: bool) -> NominalSurface:
    """A plate about a circle at `PLACE`, `height` lower than it, m; with the circle itself where there is a `top`."""
    turns = np.linspace(0.0, 2.0 * np.pi, 97)[:-1]
    circle = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    # From the middle to the plate's sides, as far as they are in each direction.
    sides = np.sign(circle) * [HALF, 0.018] - PLACE
    reach = np.min(sides / np.where(np.abs(circle) < 1e-9, 1e-9 * np.sign(sides), circle), axis=1)
    rings = [PLACE + circle * inner, PLACE + circle * reach[:, None]]
    plate = np.vstack([np.column_stack([one, np.full(96, -height)]) for one in rings])
    pairs = [(k, (k + 1) % 96) for k in range(96)]
    faces = [[k, n, 96 + k] for k, n in pairs] + [[n, 96 + n, 96 + k] for k, n in pairs]
    if top:
        plate = np.vstack([plate, np.column_stack([rings[0], np.zeros(96)]), [[*PLACE, 0.0]]])
        faces += [[192 + k, 192 + (k + 1) % 96, 288] for k in range(96)]
    return NominalSurface(plate, faces)


def pierced(x: Array, y: Array, *, by: tuple[float, float] = (0.0, 0.0), wider: float = 0.0) -> Array:
    """A plate with a hole through it that lies aside `by` so much, m, and is `wider` in its radius."""
    away = np.hypot(x - PLACE[0] - by[0], y - PLACE[1] - by[1])
    return np.where((np.abs(x) < HALF) & (away > RADIUS + wider), THICK, 0.0)


def pinned(x: Array, y: Array, *, by: tuple[float, float] = (0.0, 0.0), wider: float = 0.0) -> Array:
    """The same with a pin of 3 mm."""
    away = np.hypot(x - PLACE[0] - by[0], y - PLACE[1] - by[1])
    return np.where(np.abs(x) < HALF, np.where(away < RADIUS + wider, THICK, THICK - 3e-3), 0.0)


HOLE, PIN = ring(RADIUS, 0.0, False), ring(RADIUS, 3e-3, True)
KINDS = [(pierced, HOLE), (pinned, PIN)]


def middle(cloud: Cloud, faces: NominalSurface, at: tuple[float, float, float] = (*PLACE, 0.0)) -> list[Span]:
    """What shows along x and along y."""
    found = seen_middle(cloud, TRUE, BELONGS, faces=faces, at=np.array(at), axis=np.array([0.0, 0.0, 1.0]))
    order = {int(np.argmax(np.abs(way))): (span, float(way[np.argmax(np.abs(way))])) for span, way in found}
    assert all(abs(sign) == pytest.approx(1.0) for _, sign in order.values())
    return [Span(*sorted((sign * span.least, sign * span.most))) for _, (span, sign) in sorted(order.items())]


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("drawn", "faces"), KINDS, ids=["hole", "pin"])
def test_a_hole_and_a_pin_as_drawn_lie_in_their_place(drawn: partial[Array], faces: NominalSurface, seed: int):
    shift = 0.0015 + 0.1 * seed * LINES_M, -0.001 + 0.1 * seed * ROWS_M
    spans = middle(scanned(drawn, seed, shift=shift), faces)
    assert len(spans) == 2
    for span in spans:
        assert span.off == 0.0 and span.most - span.least < 2.0 * BLUR_M + 1.3 * LINES_M


@pytest.mark.parametrize("by", [(0.8e-3, 0.0), (0.0, -0.8e-3)])
@pytest.mark.parametrize(("drawn", "faces"), KINDS, ids=["hole", "pin"])
def test_one_that_lies_aside_is_told_so_and_one_that_is_wider_is_not(
    drawn: partial[Array], faces: NominalSurface, by: tuple[float, float]
):
    spans = middle(scanned(partial(drawn, by=by), 5), faces)
    for span, true in zip(spans, by, strict=True):
        assert span.least < true < span.most
        assert np.sign(span.off) == np.sign(true) and abs(true) <= abs(span.off) + span.more
    assert [span.off for span in middle(scanned(partial(drawn, wider=0.5e-3), 5), faces)] == [0.0, 0.0]


@pytest.mark.parametrize("by", [0.0, 0.8e-3])
def test_the_face_about_a_hole_may_be_inclined(by: float):
    slope = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.25, 0.0, 1.0]])
    inclined = NominalSurface(HOLE.vertices @ slope.T, HOLE.triangles)

    def height(x: Array, y: Array) -> Array:
        return np.where(pierced(x, y, by=(by, 0.0)) > 0.0, THICK + 0.25 * x, 0.0)

    spans = middle(scanned(height, 5), inclined, (*PLACE, 0.25 * PLACE[0]))
    assert spans[0].least < by < spans[0].most and np.sign(spans[0].off) == np.sign(by) and spans[1].off == 0.0


@pytest.mark.parametrize("seed", range(4))
def test_a_glint_or_a_drawn_neighbour_beside_a_pin_moves_its_middle_by_nothing(seed: int):
    for spans in (middle(scanned(pinned, seed, outliers=0.03), PIN), middle(*beside_a_bar(seed))):
        assert all(span.off == 0.0 for span in spans), spans


def beside_a_bar(seed: int) -> tuple[Cloud, NominalSurface]:
    """The pin, and a bar as high 2.4 mm beside its rim, both as drawn."""
    low, high = (PLACE + np.array(corner) for corner in ((RADIUS + 2.4e-3, -1.5e-3), (RADIUS + 3.2e-3, 1.5e-3)))
    corners = np.array([[*low, 0.0], [high[0], low[1], 0.0], [*high, 0.0], [low[0], high[1], 0.0]])
    count = len(PIN.vertices)
    bar = [[count, count + 1, count + 2], [count, count + 2, count + 3]]
    faces = NominalSurface(np.vstack([PIN.vertices, corners]), [*PIN.triangles, *bar])

    def height(x: Array, y: Array) -> Array:
        on_bar = (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])
        return np.where(on_bar, THICK, pinned(x, y))

    return scanned(height, seed), faces


def test_where_no_hole_is_drawn_or_too_little_of_it_shows_nothing_is_told():
    cloud = scanned(pierced, 5)
    assert middle(cloud, TOP) == [], "the plate goes on"
    assert middle(cloud, HOLE, (-0.012, 0.0, 0.0)) == [], "the rim is too far away"
    assert middle(without(cloud, in_surface(cloud)[..., 0] > PLACE[0]), HOLE) == [], "half of it shows"
    tower = np.array([[12, -6, 12], [14, -6, 12], [14, 2, 12], [12, 2, 12]]) * 1e-3
    beside = NominalSurface(np.concatenate([HOLE.vertices, tower]), [*HOLE.triangles, [192, 193, 194], [192, 194, 195]])
    assert middle(cloud, beside) == [], "something rises over it"
