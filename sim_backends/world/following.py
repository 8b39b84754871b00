"""The world after real devices: takes their readings, lets a picture wait for them, and knows how late they come.

A picture of some moment is made once every reading up to that moment is there: that the readings come late makes it
late, not wrong. Where they do not come, or leave too long a gap while something moves, there is no picture.
"""

import threading
from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim_backends.models.followed import FollowedArm, FollowedRail, FollowedVehicle, Track
from sim_backends.world.drawing import inverse
from sim_backends.world.world import World

FOLLOWED = ("arm", "rail", "vehicle", "laser", "claw")
"""What can be real beside a simulated camera, and is followed."""
SEEN_BY = {"scan": ("arm", "rail", "vehicle", "laser"), "target": ("arm", "vehicle")}
"""Which of them a camera's picture depends on."""
LONGEST_WAIT_S = 1.0
"""Seconds on the wall for which a picture waits for a reading."""
CLOSE_S, LONGEST_GAP_S = 0.025, 0.5
"""World seconds between two readings: closer ones are always taken to be on a line, wider ones never if they differ."""
STRAIGHT = {"arm": 5e-5, "rail": 2e-5, "vehicle": 1e-3}
"""By how much that line may be off in between, rad and m, as its neighbours tell. A laser is on or off."""
_KEPT = 5000


class NotFollowed(Exception):
    """There is no picture, because where something was at its moment is not known."""


class WorldFollowing:
    """The world's view of the `devices` that are real."""

    def __init__(self, world: World, devices: Sequence[str]) -> None:
        self._world = world
        self._tracks = {name: Track() for name in devices}
        self._late: dict[str, deque[float]] = {name: deque(maxlen=_KEPT) for name in devices}
        self._gaps: dict[str, deque[float]] = {name: deque(maxlen=_KEPT) for name in devices}
        self._waited: deque[float] = deque(maxlen=_KEPT)
        self._lost = 0
        self._why = ""
        self._told = threading.Condition()
        self._arm_outputs = 0

    @property
    def devices(self) -> tuple[str, ...]:
        """Those that are followed."""
        return tuple(self._tracks)

    def begin_arm(self, table: Sequence[Sequence[float]] | None, outputs: int) -> None:
        """Before the arm's first reading: its controller's table, rows a, d, alpha, offset, None where it tells none;
        `outputs` are the bits of its outputs on which real devices hang."""
        arm = self._world.arm
        if not isinstance(arm, FollowedArm):
            raise ValueError("the arm is simulated here, it does not follow another one")
        if table is not None:
            arm.take_table(np.array(table, dtype=np.float64))
        self._arm_outputs = int(outputs)

    def tell(self, device: str, rows: Sequence[Sequence[float]]) -> list[list[float]]:
        """Readings of `device`, oldest first, each with its world time in s first. ValueError for what is no reading.

        arm: six joints in rad, whether it moves, its outputs; rail: position in m; vehicle: x, y, yaw, speed, yaw
        rate, braked; laser, claw: on. Gives for the arm the wrench (6,) of contact at each, in base axes.
        """
        if device not in self._tracks:
            raise ValueError(f"{device} is not followed here; followed: {', '.join(self._tracks) or 'nothing'}")
        clock, track, wrenches = self._world.clock, self._tracks[device], []
        for row in rows:
            t, values = float(row[0]), np.array(row[1:], dtype=np.float64)
            if len(values) != _LENGTHS[device] or not np.isfinite(row).all():
                raise ValueError(f"a reading of {device} is a time and {_LENGTHS[device]} numbers, not {list(row)}")
            before = track.until
            wrenches.append(self._take(device, t, values))
            # The arm's bits are not on a line between two readings, and its track is of joints alone.
            if track.append(t, values[:6] if device == "arm" else values):
                self._late[device].append(clock.wall(clock.now() - t))
                self._gaps[device].append(clock.wall(t - before) if np.isfinite(before) else 0.0)
        with self._told:
            self._told.notify_all()
        return wrenches if device == "arm" else []

    def require(self, camera: str, t: float) -> None:
        """Wait until all is known that a picture of `camera` at world time `t` shows; `NotFollowed` when it is not."""
        needed = [name for name in SEEN_BY[camera] if name in self._tracks]
        clock = self._world.clock
        begun = clock.now()
        with self._told:
            there = self._told.wait_for(lambda: self._behind(needed, t) is None, LONGEST_WAIT_S)
        self._waited.append(clock.wall(clock.now() - begun))
        if not there:
            late = self._behind(needed, t)
            raise self._no_picture(f"no reading of the {late} came within {LONGEST_WAIT_S:g} s")
        for name in needed:
            if name not in STRAIGHT:
                continue
            track, allowed = self._tracks[name], STRAIGHT[name]
            seconds, doubt = track.seconds(t), track.doubt(t)
            if seconds > CLOSE_S and (doubt > allowed or (doubt > 0.0 and seconds > LONGEST_GAP_S)):
                raise self._no_picture(
                    f"where the {name} was is not known: two readings of it are {1e3 * seconds:.0f} ms apart, and "
                    f"between them it may be {doubt:.2g} (rad, m) off a straight line (allowed: {allowed:.2g})"
                )

    def switch(self, output: int, on: bool, t: float) -> None:
        """An output of the world's arm is on or off since world time `t`: a laser or claw hangs on it."""
        world = self._world
        world.arm.write_digital_outputs(1 << output, int(on) << output)
        if output == world.scene.drawing.cell.laser_output:
            world.laser.record(t, on)

    def board_seen(self, base_from_board: NDArray[np.float64]) -> None:
        """A real camera has measured the station's board (4, 4) in the arm's base: this world's vehicle is put where
        that is so here."""
        vehicle = self._world.vehicle
        if not isinstance(vehicle, FollowedVehicle):
            raise ValueError("the vehicle is simulated here: it stands where it has driven")
        t = self._world.arm.time
        wanted = self._world.scene.world_from_board @ inverse(base_from_board)
        vehicle.shift = wanted @ inverse(self._world.world_from_base(t)) @ vehicle.shift

    def figures(self) -> dict[str, object]:
        """How late the readings came, how far apart, how long pictures waited (ms on the wall), and how many were not
        made."""
        devices = {
            name: {
                "readings": len(self._late[name]),
                "latency_ms": _shares(self._late[name]),
                "apart_ms": _shares(self._gaps[name]),
            }
            for name in self._tracks
        }
        return {
            "devices": devices, "pictures": len(self._waited) - self._lost, "waited_ms": _shares(self._waited),
            "not_made": self._lost, "why_not": self._why,
        }  # fmt: skip

    def _behind(self, needed: Sequence[str], t: float) -> str | None:
        """The first of them that is not known up to `t`."""
        return next((name for name in needed if not self._known(self._tracks[name], t)), None)

    @staticmethod
    def _known(track: Track, t: float) -> bool:
        return track.until >= t and (track.seconds(t) <= CLOSE_S or bool(np.isfinite(track.doubt(t))))

    def _no_picture(self, why: str) -> NotFollowed:
        self._lost, self._why = self._lost + 1, why
        return NotFollowed(why)

    def _take(self, device: str, t: float, values: NDArray[np.float64]) -> list[float]:
        """Put the device where it was measured; gives the wrench on the arm."""
        world = self._world
        match device, getattr(world, device, None):
            case "arm", FollowedArm() as arm:
                arm.write_digital_outputs(self._arm_outputs, int(values[7]))
                return [float(v) for v in arm.follow(t, values[:6], bool(values[6]))]
            case "rail", FollowedRail() as rail:
                rail.follow(t, float(values[0]))
            case "vehicle", FollowedVehicle() as vehicle:
                x, y, yaw, speed, yaw_rate, braked = (float(v) for v in values)
                vehicle.follow(t, x, y, yaw=yaw, speed=speed, yaw_rate=yaw_rate, braked=bool(braked))
            case "laser", _:
                # Whoever switched it waited until it was seen: the new state holds since the reading before.
                since = self._tracks["laser"].until
                world.switch("laser", bool(values[0]), since if np.isfinite(since) else t)
            case "claw", _:
                world.switch("claw", bool(values[0]))
        return []


_LENGTHS = {"arm": 8, "rail": 1, "vehicle": 6, "laser": 1, "claw": 1}


def _shares(seconds: Sequence[float]) -> dict[str, float] | None:
    """Median, 99th percentile and largest in ms; None of nothing."""
    if not seconds:
        return None
    values = 1e3 * np.array(seconds)
    return {
        "p50": round(float(np.median(values)), 3),
        "p99": round(float(np.percentile(values, 99)), 3),
        "most": round(float(values.max()), 3),
    }
