"""The part on the surface: forces of contact, where it comes to rest, and when the claw grips it."""

import numpy as np
import pytest
from numpy.typing import NDArray

from lab.bench.job.part_jobs import body
from sim_backends.world import drawing
from sim_backends.world.bodies.contact import STIFFNESS, Nest, PartContact
from sim_backends.world.bodies.surfaces import HALF_X, HALF_Y, Surface, mesh, surface, underside
from tests.support.simulator.optics_scene import pose as turned

Floats = NDArray[np.float64]


def stairs(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Steps of 3 mm every 5 mm, upright."""
    return 0.003 * np.floor(np.asarray(x) / 0.005), 0.0 * x, 0.0 * y


def test_a_part_put_down_a_little_aside_lies_on_the_floor_of_the_steps():
    ground = Surface("stairs", stairs, half_x=0.03, half_y=0.02, top=0.02)
    held = np.eye(4)
    held[2, 3] = 0.1
    part = PartContact(ground, np.eye(4), np.linalg.inv(held))
    aside = held.copy()
    aside[0, 3], aside[2, 3] = 1.5e-4, 0.1 + 1e-4
    part.set_claw(False, aside)
    lies = part.part_pose(aside)
    np.testing.assert_allclose(lies[:3, 3], (1.5e-4, 0.0, 0.0), atol=1e-9)


def contact(
    name: str = "pot", lean: tuple[float, float, float] = (0.004, -0.006, 0.01)
) -> tuple[PartContact, np.ndarray]:
    world_from_surface = turned(lean, (0.01, -0.02, 0.6))
    return PartContact(surface(name), world_from_surface, drawing.FLANGE_FROM_PART), world_from_surface


def flange_for(world_from_part: np.ndarray) -> np.ndarray:
    return world_from_part @ drawing.inverse(drawing.FLANGE_FROM_PART)


def raised(pose: np.ndarray, dx: float = 0.0, dz: float = 0.0) -> np.ndarray:
    made = pose.copy()
    made[0, 3] += dx
    made[2, 3] += dz
    return made


@pytest.mark.parametrize("low", [0.0, 0.3e-3])
def test_a_part_that_is_low_on_one_half_touches_as_much_earlier(tmp_path, low: float):
    """By its own mesh, drawn in the part frame, which is turned and shifted against the surface's."""
    surface_from_part = turned((0.0, 0.0, 0.3), (0.004, -0.003, 0.002))
    back, drawn = drawing.inverse(surface_from_part), mesh("pot", 20_000, walls=False)

    def changed(corners: Floats) -> Floats:
        lowered = corners - np.multiply.outer(corners[:, 0] > 0.0, [0.0, 0.0, low])
        return np.asarray(lowered @ back[:3, :3].T + back[:3, 3])

    made = body(drawn.vertices, np.asarray(drawn.triangles, dtype=np.int64), lambda corners: corners)
    # The top goes with the underside into the part frame.
    made.vertices = np.where(
        np.arange(len(made.vertices))[:, None] < len(drawn.vertices),
        changed(made.vertices), made.vertices @ back[:3, :3].T + back[:3, 3],
    )  # fmt: skip
    made.export(tmp_path / "part.stl")
    part = PartContact(
        surface("pot"), np.eye(4), drawing.FLANGE_FROM_PART, surface_from_part=surface_from_part,
        part=underside(str(tmp_path / "part.stl"), "m"),
    )  # fmt: skip
    target = surface_from_part
    assert not part.wrench(flange_for(raised(target, dz=low + 1e-4))).any()
    wrench = part.wrench(flange_for(raised(target, dz=low - 1e-4)))
    # All of it where nothing is low, else the half that is.
    share = wrench[2] / (1e-4 * STIFFNESS)
    assert (0.3 < share < 0.55) if low else (0.7 < share < 1.05)
    part.set_claw(False, flange_for(raised(target, dz=0.02)))
    assert part.part_pose(np.eye(4))[2, 3] == pytest.approx(0.002 + low, abs=3e-5)


@pytest.mark.parametrize("name", ["pot", "seat", "panel"])
def test_no_force_before_contact_and_stiffness_times_depth_after(name: str):
    part, target = contact(name, lean=(0.0, 0.0, 0.0))
    assert not part.wrench(flange_for(raised(target, dz=1e-4))).any()
    at_depth = [part.wrench(flange_for(raised(target, dz=-depth)))[2] for depth in (1e-4, 2e-4)]
    assert at_depth[1] == pytest.approx(2 * at_depth[0], rel=1e-3)
    # Slopes lower the vertical stiffness by cos² of the slope, averaged over the underside.
    assert 0.7 * STIFFNESS < at_depth[0] / 1e-4 < STIFFNESS


@pytest.mark.parametrize(
    ("dz", "within"), [(0.0, 1e-8), (0.008, 1e-7), (-0.0004, 5e-6)], ids=["touching", "above", "pressed in"]
)
def test_wherever_the_claw_lets_go_of_it_the_part_comes_to_touch_the_surface(dz: float, within: float):
    part, target = contact(lean=(0.0, 0.0, 0.0))
    part.set_claw(False, flange_for(raised(target, dz=dz)))
    assert not part.held and part.part_pose(np.eye(4)) == pytest.approx(target, abs=within)


def test_a_surface_that_is_pushed_takes_along_what_lies_on_it_and_nothing_that_is_held():
    part, target = contact()
    held = part.part_pose(flange_for(raised(target, dz=0.2)))
    part.slide(raised(target, dx=0.005))
    assert part.part_pose(flange_for(raised(target, dz=0.2))) == pytest.approx(held)
    part.set_claw(False, flange_for(raised(target, dx=0.005)))
    part.slide(raised(target, dx=0.02))
    assert part.part_pose(np.eye(4)) == pytest.approx(raised(target, dx=0.02), abs=1e-8)


def test_a_part_that_a_person_takes_is_neither_in_the_claw_nor_near():
    part, target = contact()
    part.take_away()
    assert not part.held and not part.untouched
    assert np.linalg.norm(part.part_pose(flange_for(target))[:3, 3] - target[:3, 3]) == pytest.approx(5.0)
    part.set_claw(True, flange_for(target))
    assert not part.held


def test_a_part_put_down_beside_its_place_rests_higher_on_its_first_contact():
    part, target = contact()
    part.set_claw(False, flange_for(raised(target, dx=0.002, dz=0.002)))
    rest = part.part_pose(np.eye(4))
    assert rest[:2, 3] == pytest.approx(target[:2, 3] + [0.002, 0.0])
    x, y = (
        a.ravel() for a in np.meshgrid(np.linspace(-HALF_X, HALF_X, 21) * 0.9, np.linspace(-HALF_Y, HALF_Y, 11) * 0.9)
    )
    underside = np.column_stack([x, y, surface("pot").height(x, y), np.ones_like(x)])
    seen = (drawing.inverse(target) @ rest @ underside.T).T
    gap = seen[:, 2] - surface("pot").height(seen[:, 0], seen[:, 1])
    assert 0 < rest[2, 3] - target[2, 3] < 0.002
    assert gap.min() > -2e-5 and gap.min() < 2e-4


def test_the_claw_grips_again_only_within_its_reach_and_not_across_the_part():
    part, target = contact()
    part.set_claw(False, flange_for(target))
    for off in (raised(target, dz=0.02), target @ turned((0.0, 0.0, 0.4), (0.0, 0.0, 0.0))):
        part.set_claw(True, flange_for(off))
        assert not part.held
        part.set_claw(False, flange_for(off))
    part.set_claw(True, flange_for(raised(target, dz=0.003)))
    assert part.held
    lifted = part.part_pose(flange_for(raised(target, dz=0.103)))
    assert lifted == pytest.approx(raised(target, dz=0.1), abs=1e-9)


def test_a_part_lies_at_first_is_taken_into_its_nest_and_rides_with_the_vehicle():
    base = [np.eye(4)]
    nest = Nest(
        turned((0.0, 0.0, 0.5), (-0.6, 0.1, 0.7)), lambda: base[0], turned((0.0, 0.0, 0.01), (0.4e-3, 0.0, 0.0))
    )
    world_from_surface = turned((0.0, 0.0, 0.0), (0.6, 0.0, 0.6))
    part = PartContact(surface("pot"), world_from_surface, drawing.FLANGE_FROM_PART, nest=nest)
    assert not part.held and part.untouched
    lay = part.part_pose(np.eye(4))
    aside = drawing.inverse(world_from_surface) @ lay
    assert aside[0, 3] == pytest.approx(0.4e-3) and 0.0 < aside[2, 3] < 1e-3, "it lies aside, on slopes"
    part.set_claw(True, flange_for(lay))
    assert part.held and not part.untouched
    # Pressed into the nest by .1 mm it is pushed back as by the surface, in the nest's own axes.
    there = base[0] @ nest.base_from_surface
    assert part.wrench(flange_for(raised(there, dz=-1e-4)))[2] == pytest.approx(0.1e-3 * STIFFNESS, rel=0.15)
    assert not part.wrench(flange_for(raised(there, dz=1e-3))).any()
    part.set_claw(False, flange_for(raised(there, dz=2e-4)))
    np.testing.assert_allclose(part.part_pose(np.eye(4)), there, atol=1e-6)
    base[0] = turned((0.0, 0.0, 0.3), (1.0, 2.0, 0.0))
    np.testing.assert_allclose(part.part_pose(np.eye(4)), base[0] @ there, atol=1e-6)
    part.set_claw(True, flange_for(base[0] @ there))
    assert part.held, "it is taken from there as well"


def test_a_part_that_sticks_holds_on_until_it_is_half_a_millimetre_away():
    part, world_from_surface = contact(lean=(0.0, 0.0, 0.0))
    part.sticks = 30.0
    pulls = [-part.wrench(flange_for(raised(world_from_surface, dz=height)))[2] for height in (25e-6, 2e-4, 6e-4)]
    assert pulls == pytest.approx([15.0, 30.0, 0.0], rel=0.1)
