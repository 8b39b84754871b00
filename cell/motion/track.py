"""Where the flange was at a given time: between the states that the arm reported while it moved.

A packet's arrival tells its time only roughly, always late, and all of them may be late alike. The arm's own clock
runs evenly; round trips tie it to the host's, and then every state has its time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.measure.geometry.poses import from_ur
from drivers.clock_map import ClockMap
from drivers.errors import DeviceFault
from drivers.interfaces import ArmState, Vector

LEAST_STATES = 10
LONGEST_GAP_S = 0.2
"""Between two states further apart than this the arm may have done anything."""
MOST_BEND_M = 2e-5
"""What a straight and even way between two states may be off by, by how the speed before and after differs from it."""


class FlangeTrack:
    """The poses base_from_flange of a motion by host time in s."""

    def __init__(
        self, name: str, states: Sequence[ArmState], clocks: ClockMap, longest_gap: float = LONGEST_GAP_S
    ) -> None:
        """`name` is the arm's, for errors: `DeviceFault` when there are too few states. `clocks` maps its clock to the
        host's; `longest_gap` is in s."""
        device = np.array([state.device_time for state in states])
        kept = np.flatnonzero(np.diff(device, prepend=-np.inf) > 0)
        self._name, self._longest_gap = name, longest_gap
        if len(kept) < LEAST_STATES:
            raise self._fault(f"only {len(kept)} states of the arm came during the motion, at least {LEAST_STATES}")
        self.times: Vector = np.array([clocks.host_time(time) for time in device[kept]])
        poses = [from_ur(states[int(k)].flange) for k in kept]
        self.translations: Vector = np.array([pose.translation for pose in poses])
        self._rotations = [pose.rotation for pose in poses]
        gaps = np.diff(self.times)
        speeds = np.diff(self.translations, axis=0) / gaps[:, None]
        change = np.linalg.norm(np.diff(speeds, axis=0), axis=1)
        self._bends = 0.25 * gaps * np.maximum(np.append(0.0, change), np.append(change, 0.0))

    def inside(self, times: Vector) -> NDArray[np.bool_]:
        """Which of the times (n,) lie between the first and the last state."""
        return np.asarray((times >= self.times[0]) & (times <= self.times[-1]))

    def even(self, times: Vector) -> NDArray[np.bool_]:
        """At which of the times (n,), which must be `inside`, the arm is known to have moved evenly.

        An arm that paused where no state came from it was not on the straight way between the two states around.
        """
        after = np.clip(np.searchsorted(self.times, times), 1, len(self.times) - 1)
        return np.asarray(self._bends[after - 1] <= MOST_BEND_M)

    def at(self, times: Vector) -> Vector:
        """base_from_flange (n, 4, 4) at the times (n,), which must be `inside`.

        Straight and at an even turn between two states. Raises `DeviceFault` when those are too far apart.
        """
        after = np.clip(np.searchsorted(self.times, times), 1, len(self.times) - 1)
        gaps = self.times[after] - self.times[after - 1]
        if len(gaps) and gaps.max() > self._longest_gap:
            raise self._fault(
                f"no state of the arm came for {gaps.max():.3f} s of the motion, allowed {self._longest_gap:g} s"
            )
        shares = (times - self.times[after - 1]) / gaps
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        for n, (k, share) in enumerate(zip(after, shares, strict=True)):
            before = self._rotations[k - 1]
            turn = pin.log3(before.T @ self._rotations[k])
            poses[n, :3, :3] = before @ pin.exp3(share * turn)
            poses[n, :3, 3] = (1 - share) * self.translations[k - 1] + share * self.translations[k]
        return poses

    def _fault(self, text: str) -> DeviceFault:
        return DeviceFault(
            self._name,
            "arm.states_lost",
            text,
            recoverable=True,
            hint="Look at the arm's link and at what else this machine is busy with.",
        )
