"""Judges what a cell does by the simulated world's truth at every tick; it shares no code with the product.

Nothing here asks a device or the cell what it did. Positions are of the world's own chain of poses, SI, and what is
told to the oracle is only what people did, when a run ended, and with which words.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lab.bench.schedules.causes import named
from sim_backends.models.camera import CameraState
from sim_backends.world.bodies.contact import PartContact
from sim_backends.world.drawing import inverse
from sim_backends.world.world import World

Pose = NDArray[np.float64]

LIMIT_S = 0.5
"""Seconds after an end from which on nothing may move or shine."""
DROP_M = 1.5e-3
"""A part falls at most so far when it is let go."""
UNSEEN_S = 2.5
"""The laser is on at most so long without an exposure of the scan camera: its silence is noticed after 2 s."""
MOST_FORCE_N = 60.0
"""Between part and place: what the fast part of a descent ends at, and its way to brake."""
FINGERS_N = 1.0
"""An empty claw touches nothing harder."""
SWITCHING_S = 0.8
"""After so long it is known what has become of a part that the claw opened or closed on."""
BLIND_S = 15.0
"""For so long before the part is let go the surface is looked at no more: what is moved then, nobody can know."""
CROWDED = 20


@dataclass(frozen=True)
class Violation:
    """The rule that was broken, the world's time, s, and how."""

    rule: str
    at: float
    how: str

    def __str__(self) -> str:
        return f"{self.rule} at {self.at:.2f} s: {self.how}"


@dataclass(frozen=True)
class RunEnd:
    """How a run ended in its own words; `part` is what its journal tells last of the part, None if nothing. `tolerance`
    and `bound` (m) are the job's, and what the report states that the part is off by at most, if it does."""

    outcome: str
    reason: str
    part: str | None
    tolerance: float
    bound: float | None = None


@dataclass(eq=False)
class Oracle:
    """The judge of one world. `tick` is called after each of the world's ticks. `camera` counts the scan camera's
    exposures; `home` is where a part lies at first: "held", "at the station" or "in its nest"."""

    world: World
    camera: CameraState
    level: str
    home: str = "held"
    violations: list[Violation] = field(default_factory=list)
    acts: list[str] = field(default_factory=list)
    released: int = 0
    """How often the present part was let go."""
    taken: bool = False
    """Whether a person has taken the part away."""
    switched: float = -math.inf
    """When the claw took or let go the part last."""
    blind: bool = False
    """Whether something was moved too late to be seen before the part was let go."""
    unseen: float = -math.inf
    """When something was moved last that only a look shows."""
    _ended: float | None = None
    _cut: float = -math.inf
    _held: Pose | None = None
    _part: PartContact | None = None
    _exposures: int = 0
    _shown: float = 0.0
    _collisions: int = 0

    def broken(self, rule: str, how: str) -> None:
        """A rule was broken now; each is told once in a second."""
        now = self.world.clock.now()
        again = any(each.rule == rule and now - each.at < 1.0 for each in self.violations)
        if not again and len(self.violations) < CROWDED:
            self.violations.append(Violation(rule, round(now, 3), how))

    def tick(self) -> None:
        """Look at the world as it is now."""
        t = self.world.clock.now()
        flange = self.world.world_from_flange(t)
        feedback = self.world.vehicle.feedback(t)
        drives, arm = feedback.speed != 0.0 or feedback.yaw_rate != 0.0, self.world.arm.moving
        lit, rail = self.world.switched("laser"), self.world.rail.velocity(t) != 0
        if drives and arm:
            self.broken("arm and vehicle", f"the arm moves while the vehicle drives at {feedback.speed:.3f} m/s")
        self._light(t, lit, drives)
        self._touch(flange)
        self._follow_part(flange)
        moving = {"vehicle": drives, "arm": arm, "rail": rail, "laser": lit}
        if self._ended is not None and t > self._ended + LIMIT_S and any(moving.values()):
            names = ", ".join(name for name, does in moving.items() if does)
            self.broken("after the end", f"{names}: {t - self._ended:.2f} s after the run's end")

    def _light(self, t: float, lit: bool, drives: bool) -> None:
        exposures = self.camera.next_frame_id
        if not lit or exposures != self._exposures:
            self._shown, self._exposures = t, exposures
        if lit and drives:
            self.broken("laser", "it shines while the vehicle drives")
        if lit and t - self._shown > UNSEEN_S:
            self.broken("laser", f"it has shone {t - self._shown:.2f} s with nobody looking")

    def _touch(self, world_from_flange: Pose) -> None:
        found = self.world.collisions.found
        for each in found[self._collisions :]:
            self.broken("touch", f"{each.body} met {each.obstacle}")
        self._collisions = len(found)
        force = float(np.linalg.norm(self.world.part.wrench(world_from_flange)[:3]))
        allowed = MOST_FORCE_N if self.world.part.held else FINGERS_N
        if force > allowed:
            what = "part" if self.world.part.held else "empty claw"
            self.broken("force", f"the {what} is pressed with {force:.1f} N, at most {allowed:.0f} N is allowed")

    def _follow_part(self, world_from_flange: Pose) -> None:
        part = self.world.part
        if part is not self._part:
            self._part, self._held, self.released, self.taken = part, None, 0, False
        pose = part.part_pose(world_from_flange)
        if part.held is not (self._held is not None):
            self.switched = self.world.clock.now()
        if part.held:
            self._held = pose
        elif self._held is not None and not self.taken:
            before, self._held = self._held, None
            self.released += 1
            self.blind = self.world.clock.now() - self.unseen < BLIND_S
            drop = float(before[2, 3] - pose[2, 3])
            if abs(drop) > DROP_M:
                self.broken("let go in the air", f"the part fell {1e3 * drop:.2f} mm")

    def did(self, act: str) -> None:
        """Something was done to the cell by its surroundings."""
        self.acts.append(act)
        if act in ("vehicle_bumped", "surface_moved"):
            self.unseen = self.world.clock.now()
        if act == "part_taken":
            self.taken = True

    @property
    def put_down(self) -> bool:
        """Whether the part was let go and nobody holds it."""
        return self.released > 0 and not self.world.part.held

    def begun(self) -> None:
        """A run begins."""
        self._ended = None

    def resumed(self) -> None:
        """A run is resumed that was cut short: what it has done is not to be done again."""
        if self.put_down and not self.taken:
            self.broken("done twice", "a run is resumed whose part was put down already")

    def unresumed(self, reason: str, torn: bool) -> None:
        """A run that was cut short is not resumed, for this reason; `torn` where its journal was damaged."""
        untouched = self.released == 0 and self.world.part.untouched and not self.taken
        if untouched and not torn and "releasing or gripping" not in reason:
            self.broken("forgotten", f"nothing was done with the part, and the run is not resumed: {reason}")
        if self._cut - self.switched > SWITCHING_S and not torn and "releasing or gripping" in reason:
            self.broken("journal", f"the claw has switched more than {SWITCHING_S} s before the end: {reason}")

    def stopped(self) -> None:
        """A run has come to its end: `tick` looks what still moves."""
        self._ended = self._cut = self.world.clock.now()

    def ended(self, end: RunEnd) -> None:
        """How a run ended in its own words."""
        self._judge_part(end)
        if end.outcome in ("placed", "done"):
            if end.outcome == "placed":
                self._judge_place(end)
        elif end.outcome == "misplaced":
            if not set(self.acts) and self.level == "nominal":
                self.broken("misplaced", f"nothing was done to the cell: {end.reason}")
        elif not named(end.reason, self.acts, self.level):
            self.broken("cause", f"{end.outcome} names none of {', '.join(self.acts) or 'nothing'}: {end.reason}")

    def _judge_part(self, end: RunEnd) -> None:
        told, held = end.part or self.home, self.world.part.held
        if end.outcome == "placed" and told == "unknown":
            self.broken("journal", "it does not tell what has become of the part that was placed")
        if told == "unknown" or self.taken:
            return
        if held != (told == "held"):
            self.broken(
                "journal", f"it tells that the part is {told}; in truth the claw holds {'it' if held else 'none'}"
            )

    def _judge_place(self, end: RunEnd) -> None:
        if self.world.part.held:
            self.broken("placed", "the claw still holds the part")
            return
        off = self.part_off()
        if self.blind:
            return
        if off > end.tolerance:
            self.broken("placed", f"the part lies {1e3 * off:.2f} mm off, tolerance {1e3 * end.tolerance:.2f} mm")
        if end.bound is not None and off > 2.0 * end.bound:
            self.broken("bound", f"the part lies {1e3 * off:.3f} mm off, stated is at most {1e3 * end.bound:.3f} mm")

    def part_off(self) -> float:
        """How far, m, a corner of the part is from where it belongs, on the surface or in its nest."""
        world, t = self.world, self.world.clock.now()
        drawn, ground = world.scene.drawing.station, world.station.ground
        world_from_part = world.part.part_pose(world.world_from_flange(t))
        if drawn.nest is not None and not drawn.nest_filled:
            found, wanted = inverse(world.world_from_base(t)) @ world_from_part, drawn.nest
        else:
            found = inverse(world.scene.world_from_surface) @ world_from_part
            wanted = np.eye(4) if drawn.surface_from_part is None else drawn.surface_from_part
        x, y = ground.half_x, ground.half_y
        corners = np.array([[a * x, b * y, ground.top, 1.0] for a in (-1, 1) for b in (-1, 1)])
        return float(np.linalg.norm((corners @ (found - wanted).T)[:, :3], axis=1).max())
