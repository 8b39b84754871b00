"""Whether bodies stay apart all along a way, between its samples as well.

At each look every pair has a distance, and no joint can bring a pair nearer faster than the farther body reaches from
its axis. So the next look may be as far along as no pair can have met before: a few looks in free space, many where
bodies pass each other closely.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cell.motion.collision import ROUNDING, CollisionModel, Pair
from cell.motion.kinematics import Joints

GIVE = 3e-4
"""By how much in m a pair that touches at the beginning may come nearer again: the arm holds its place no better."""
AHEAD = 256
"""Samples of a way that are looked at together."""


@dataclass(frozen=True, eq=False)
class FirstContact:
    """Where on a way bodies touch first: joint angles (6,) rad, about which sample that is, and the pairs."""

    joints: Joints
    sample: int
    pairs: list[Pair]


def first_touch(
    model: CollisionModel, way: NDArray[np.float64], allowed: tuple[Pair, ...] = (), opening: bool = False
) -> FirstContact | None:
    """The first touch on a way (n, 6) rad, straight in joint angles between its samples; None when it is free.

    Pairs in `allowed` are not looked at. With `opening`, pairs that are nearer than the margin at the beginning may be
    so as long as they do not come nearer still; once they have parted they count like all others. On a free way every
    pair keeps the model's margin everywhere.
    """
    samples = np.asarray(way, dtype=np.float64)
    turned = np.vstack([np.zeros(6), np.cumsum(np.abs(np.diff(samples, axis=0)), axis=0)])
    kept = model.margin + ROUNDING
    apart = model.distances(samples[0])
    needed = np.where(model.excused(allowed), -np.inf, kept)
    if opening:
        needed = np.minimum(needed, apart - GIVE)
    place, sample = turned[0], 0
    joints = samples[0]
    while True:
        met = apart < needed
        if met.any():
            return FirstContact(joints, sample, [pair for pair, close in zip(model.pairs, met, strict=True) if close])
        if sample == len(samples) - 1:
            return None
        if opening:
            needed = np.where(needed > -np.inf, np.maximum(needed, np.minimum(kept, apart - GIVE)), needed)
        room = np.maximum(apart - needed, 2.0 * ROUNDING)
        joints, place, sample = _onwards(model, samples, turned, place=place, sample=sample, room=room)
        apart = model.distances(joints)


def _onwards(
    model: CollisionModel,
    samples: NDArray[np.float64],
    turned: NDArray[np.float64],
    place: Joints,
    sample: int,
    room: NDArray[np.float64],
) -> tuple[Joints, Joints, int]:
    """As far along as no pair can have come nearer by more than its `room` (pairs,) m.

    `turned` (n, 6) is by how much each joint has turned since the beginning, `place` (6,) the same where the last look
    was, after `sample`. Returns the joint angles, the new `place` and the last sample that was reached.
    """
    nearer = (turned[sample + 1 : sample + 1 + AHEAD] - place) @ model.swing.T
    beyond = (nearer > room).any(axis=1)
    if not beyond.any():
        reached = sample + len(nearer)
        return samples[reached], turned[reached], reached
    first = int(np.argmax(beyond))
    last = sample + first
    leg = turned[last + 1] - turned[last]
    begun = max(0.0, float(np.max((place - turned[last])[leg > 0] / leg[leg > 0]))) if first == 0 else 0.0
    from_there = (turned[last] + begun * leg - place) @ model.swing.T
    rates = leg @ model.swing.T
    moving = rates > 0
    fraction = begun + float(np.min((room - from_there)[moving] / rates[moving]))
    return samples[last] + fraction * (samples[last + 1] - samples[last]), turned[last] + fraction * leg, last
