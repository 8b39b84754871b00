"""URScript's commands that move the arm: moves, streams, stops and compliance. Source: the maker's script manual.

A move that is asked to be faster than the joints can takes longer. Blend radii are not modelled: the arm stops at
every way point.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from sim_backends.models.arm_kinematics import Matrix, Vector
from sim_backends.models.arm_motion import (
    ArcMove,
    ForceMode,
    JointMove,
    JointSpeed,
    LinearMove,
    LinearSpeed,
    Servo,
    StopMotion,
)
from sim_backends.peers.arm.script.context import CYCLE, Job, ProgramError
from sim_backends.peers.arm.script.motion import tool_contact
from sim_backends.peers.arm.urscript.environment import Commands, Environment, List, ScriptPose, Value, matrix

_MOST_ACCELERATION = 8.0
"""rad/s², of which the moves that plan for themselves take a share."""
_RAMPS = 0.25
"""Share of a move of given time that it speeds up, and as much that it slows down."""


def _timed(length: float, t: float, speed: float, acceleration: float) -> tuple[float, float]:
    """Speed and acceleration of a move over `length`, which takes `t` s when that is not 0."""
    if t <= 0 or length <= 0:
        return speed, acceleration
    cruise = length / ((1 - _RAMPS) * t)
    return cruise, cruise / (_RAMPS * t)


def commands(environment: Environment) -> Commands:
    """By name; those that take time are generator functions."""
    parts = (_moves, _optimized_moves, _stops, _streams, _compliance, _waits)
    return {name: command for part in parts for name, command in part(environment).items()}


def _moves(e: Environment) -> Mapping[str, Callable[..., Job]]:
    """Moves to a target at a speed."""

    def movej(q: List, a: float = 1.4, v: float = 1.05, t: float = 0, r: float = 0) -> Job:
        goal = _joints(e, q)
        limit = e.context.model.params.joint_limit
        farthest = int(np.abs(goal).argmax())
        if abs(goal[farthest]) > limit:
            raise ProgramError(f"movej: joint {farthest} to {goal[farthest]:.6g} rad, its limit is {limit:.6g} rad")
        length = float(np.abs(goal - e.context.model.drive.q).max())
        yield from e.move(JointMove(goal, *_timed(length, t, v, a)))

    def movel(pose: List, a: float = 1.2, v: float = 0.25, t: float = 0, r: float = 0) -> Job:
        goal, here = _tool(e, pose), e.context.model.drive.base_from_tcp()
        length = math.dist(goal[:3, 3], here[:3, 3])
        yield from e.move(LinearMove(goal, *_timed(length, t, v, a), slows=True))

    def movep(pose: List, a: float = 1.2, v: float = 0.25, r: float = 0) -> Job:
        yield from movel(pose, a, v)

    def movec(pose_via: List, pose_to: List, a: float = 1.2, v: float = 0.25, r: float = 0, mode: float = 0) -> Job:
        yield from e.move(ArcMove(_tool(e, pose_via)[:3, 3], _tool(e, pose_to), v, a, fixed=mode == 1))

    return {"movej": movej, "movel": movel, "movep": movep, "movec": movec}


def _optimized_moves(e: Environment) -> Commands:
    """Moves that plan for themselves: `a` and `v` are shares of the most."""
    moves = _moves(e)

    def optimovej(q: List, a: float = 0.3, v: float = 0.3, r: float = 0) -> Job:
        yield from moves["movej"](q, a * _MOST_ACCELERATION, v * _leading(e))

    def optimovel(pose: List, a: float = 0.3, v: float = 0.3, r: float = 0) -> Job:
        yield from moves["movel"](pose, 2.5 * a, v)

    return {"optimovej": optimovej, "optimovel": optimovel}


def _stops(e: Environment) -> Commands:
    """Stops of what moves."""

    def stopj(a: float = 2.0) -> Job:
        yield from e.move(StopMotion(a))

    def stopl(a: float = 1.2, aRot: float = 0) -> Job:
        yield from e.move(StopMotion(a, linear=True))

    return {"stopj": stopj, "stopl": stopl}


def _streams(e: Environment) -> Commands:
    """Targets and speeds that are sent anew in each cycle."""

    def servoj(
        q: List, a: float = 0, v: float = 0, t: float = CYCLE, lookahead_time: float = 0.1, gain: float = 300
    ) -> Job:
        lag = max(e.context.model.params.tracking_lag, lookahead_time * 300.0 / max(gain, 1.0))
        motion, target = e.context.model.motion, _joints(e, q)
        if isinstance(motion, Servo):
            motion.target, motion.lag = target, lag
        else:
            motion = Servo(target, lag)
        yield from e.stream(motion, t, lasting=True)

    def speedj(qd: List, a: float = 1.4, t: float = 0) -> Job:
        yield from _speed(e, JointSpeed(_six(qd), a), t)

    def speedl(xd: List, a: float = 1.2, t: float = 0, aRot: float = 0) -> Job:
        yield from _speed(e, LinearSpeed(_six(xd), a), t)

    return {"servoj": servoj, "speedj": speedj, "speedl": speedl}


def _compliance(e: Environment) -> Commands:
    """Force mode, and what touches the tool."""

    def force_mode(task_frame: List, selection_vector: List, wrench: List, type: float, limits: List) -> None:
        e.force = ForceMode(matrix(task_frame), _six(selection_vector), _six(wrench), _six(limits))

    def end_force_mode() -> Job:
        if e.force is not None:
            e.force = None
            yield from e.move(StopMotion(10.0, linear=True))

    def contact(direction: Sequence[Value] = (0.0,) * 6) -> int:
        return tool_contact(e.context, _six(direction))

    return {"force_mode": force_mode, "end_force_mode": end_force_mode, "tool_contact": contact}


def _waits(_: Environment) -> Commands:
    """Cycles that pass."""

    def sleep(t: float) -> Job:
        for _ in range(round(t / CYCLE)):
            yield

    def sync() -> Job:
        yield

    return {"sleep": sleep, "sync": sync}


def _joints(e: Environment, target: List) -> Vector:
    return e.context.solve(matrix(target)) if isinstance(target, ScriptPose) else _six(target)


def _tool(e: Environment, target: List) -> Matrix:
    return matrix(target) if isinstance(target, ScriptPose) else e.context.forward(_six(target))


def _speed(e: Environment, wanted: JointSpeed | LinearSpeed, t: float) -> Job:
    motion = e.context.model.motion
    if isinstance(motion, JointSpeed | LinearSpeed) and type(motion) is type(wanted):
        motion.target, motion.acceleration = wanted.target, wanted.acceleration
    else:
        motion = wanted
    if not wanted.acceleration > 0:
        raise ProgramError(f"an acceleration of {wanted.acceleration:g} must be greater than 0")
    if t <= 0:
        # Until the speed is reached.
        gap = wanted.target - e.context.model.drive.qd if isinstance(wanted, JointSpeed) else wanted.target
        t = float(np.abs(gap).max()) / wanted.acceleration
    yield from e.stream(motion, t)


def _leading(e: Environment) -> float:
    return float(e.context.model.params.speed_limits.min())


def _six(values: Sequence[Value]) -> Vector:
    array = np.array(values, float)
    if array.shape != (6,) or not np.isfinite(array).all():
        raise ProgramError(f"{list(values)} are not six finite numbers")
    return array
