"""What a URScript program computes with: its values, the commands that only compute, and what its commands share.

Lists are added and scaled element by element; a pose is a list of six that prints with a `p`. Members that scripts
can reach begin with `u_`, so that a script reaches nothing else of an object. Source: the maker's script manual.
"""

import itertools
import math
import operator
import random
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Self, SupportsIndex, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from sim_backends.models.arm_kinematics import (
    Matrix,
    invert,
    matrix_from_pose,
    pose_from_matrix,
    rotation_matrix,
    rotation_vector,
)
from sim_backends.models.arm_motion import ForceMode, SimulatedMotion, StopMotion
from sim_backends.peers.arm.commands import CYCLE, Context, HeldOutputs, Job, ProgramError

MOST_ELEMENTS, MOST_CHARACTERS, MOST_INTEGER = 100_000, 1_000_000, 2**63
"""What a variable may hold; a controller's own limits are lower, and a program that exceeds them ends."""


Value: TypeAlias = "bool | int | float | str | List | Struct | None"
Commands = Mapping[str, Callable[..., object]]
"""What a script may call, by name; what they return, a script takes as it is."""


class List(list[Value]):
    """A list or, as a list of lists, a matrix."""

    def __getitem__(self, index: SupportsIndex | float | slice) -> Any:
        """The element at a whole number, counted from 0; negative ones do not exist."""
        return list.__getitem__(self, index if isinstance(index, slice) else _whole(index))

    def __setitem__(self, index: SupportsIndex | float | slice, value: Any) -> None:
        """Change the element at a whole number."""
        list.__setitem__(self, _whole(index), value)

    def _each(self, other: object, act: Callable[[object, object], Value]) -> Self:
        if isinstance(other, list):
            if len(other) != len(self):
                raise TypeError(f"lists of {len(self)} and {len(other)} elements")
            return type(self)(map(act, self, other))
        return type(self)(act(mine, other) for mine in self)

    def __add__(self, other: object) -> Any:
        """Element by element."""
        return self._each(other, operator.add)

    def __sub__(self, other: object) -> Self:
        """Element by element."""
        return self._each(other, operator.sub)

    def __mul__(self, other: object) -> Self:
        """By a number, or element by element."""
        return self._each(other, operator.mul)

    __rmul__ = __mul__
    __radd__ = __add__

    def __truediv__(self, other: object) -> Self:
        """By a number, or element by element."""
        return self._each(other, operator.truediv)

    def __neg__(self) -> Self:
        """Each element's opposite."""
        values: Iterable[Any] = self
        return type(self)(-value for value in values)

    def u_length(self) -> int:
        """How many elements."""
        return len(self)

    def u_append(self, value: Value) -> None:
        """Add `value` at the end."""
        self.append(value)

    def u_pop(self) -> Value:
        """Take the last element away."""
        return self.pop()

    def u_clear(self) -> None:
        """Take all elements away."""
        self.clear()


class ScriptPose(List):
    """Place in m and rotation vector in rad: p[x, y, z, rx, ry, rz]."""

    def __init__(self, values: Iterable[Value]) -> None:
        super().__init__(values)
        if len(self) != 6:
            raise TypeError(f"a pose of {len(self)} numbers")


class Struct:
    """Named members, made by struct(name = value, …)."""

    def __init__(self, **members: Value) -> None:
        for name, value in members.items():
            setattr(self, f"u_{name}", value)

    def members(self) -> dict[str, Value]:
        """The members by name."""
        return {name[2:]: value for name, value in vars(self).items()}


def own(value: Value) -> tuple[Value, int]:
    """A copy of a list or struct, anything else as it is, and how many values that are: an assignment or a call gives
    a variable a value of its own. `ValueError` for one that is too large."""
    return _copied(value, 0)


def _copied(value: Value, count: int) -> tuple[Value, int]:
    count += 1
    if count > MOST_ELEMENTS:
        raise ValueError(f"a list or struct of more than {MOST_ELEMENTS} values")
    if isinstance(value, str) and len(value) > MOST_CHARACTERS:
        raise ValueError(f"a text of {len(value)} characters, at most {MOST_CHARACTERS}")
    if isinstance(value, int) and abs(value) > MOST_INTEGER:
        raise ValueError(f"a whole number of {value.bit_length()} bits")
    if isinstance(value, Struct):
        members = {}
        for name, member in value.members().items():
            members[name], count = _copied(member, count)
        return Struct(**members), count
    if not isinstance(value, List):
        return value, count
    elements = []
    for element in value:
        one, count = _copied(element, count)
        elements.append(one)
    return type(value)(elements), count


def shown(value: Value) -> str:
    """`value` as textmsg and to_str write it."""
    if isinstance(value, bool) or value is None:
        return str(value)
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return ("p" if isinstance(value, ScriptPose) else "") + "[" + ", ".join(map(shown, value)) + "]"
    if isinstance(value, Struct):
        return "struct(" + ", ".join(f"{name}={shown(one)}" for name, one in value.members().items()) + ")"
    return str(value)


def _whole(index: Any) -> int:
    whole = int(index)
    if whole != index or whole < 0:
        raise IndexError(f"element {index}")
    return whole


Announce = Callable[[str, str], None]
"""Tells the clients of the primary port: the kind of message (text, popup) and its words."""
_BRAKE = 4.0
"""Deceleration in rad/s² of a motion whose thread was killed or whose stream dried up."""


_MOST_READS = 10
"""Readings of sockets in one cycle."""


class Environment:
    """Of one program run; `context` has the arm and its registers, and `pause` pauses the program."""

    def __init__(self, outputs: HeldOutputs, announce: Announce, pause: Callable[[], object]) -> None:
        self.context: Context
        self.outputs = outputs
        self.announce = announce
        self.pause = pause
        self.thread = 0
        self.force: ForceMode | None = None
        self.popup_open = False
        self.cycles = 0
        self.held_up = False
        """This cycle is made up for: the host did not let the controller run in time, and perhaps no client either."""
        self._reads = 0
        self.watches: list[InputWatchdog] = []
        self._numbers = itertools.count(1)
        self._mover: int | None = None
        self._stream_ends: int | None = None
        self._closers: list[Callable[[], None]] = []

    def next_thread(self) -> int:
        """A number for a new thread; 0 is the program itself."""
        return next(self._numbers)

    def may_read(self) -> bool:
        """Whether what has come in over a socket is taken in this cycle; a flood is taken in parts."""
        self._reads += 1
        return self._reads <= _MOST_READS

    def on_close(self, act: Callable[[], None]) -> None:
        """Have `act` done when the program ends."""
        self._closers.append(act)

    def close(self) -> None:
        """The program has ended."""
        for act in self._closers:
            act()
        self._closers.clear()
        self.force = None

    def move(self, motion: SimulatedMotion) -> Job:
        """Start `motion` and wait for its end. Raises `ProgramError` while another thread moves the arm."""
        model = self.context.model
        with self._moving():
            self._stream_ends = None
            model.start(motion)
            while model.pending(motion):
                yield

    def stream(self, motion: SimulatedMotion, seconds: float, lasting: bool = False) -> Job:
        """Have `motion` go on for `seconds`, one cycle at least; it dries up then, unless it is `lasting`."""
        model = self.context.model
        with self._moving():
            if model.motion is not motion:
                model.start(motion)
            cycles = max(1, round(seconds / CYCLE))
            self._stream_ends = None if lasting else self.cycles + cycles + 1
            for _ in range(cycles):
                yield

    def end_cycle(self) -> None:
        """After all threads: brake a stream that nobody has fed, be compliant while nothing moves, mind the watches."""
        self.cycles += 1
        self._reads = 0
        model = self.context.model
        if self._stream_ends is not None and self.cycles > self._stream_ends:
            self._stream_ends = None
            model.start(StopMotion(_BRAKE))
        if self.force is not None and model.idle:
            model.start(self.force)
        for watch in self.watches:
            watch.check(self.cycles)

    @contextmanager
    def _moving(self) -> Iterator[None]:
        thread = self.thread
        if self._mover not in (None, thread):
            raise ProgramError("another thread is already controlling the robot")
        self._mover = thread
        try:
            yield
        except GeneratorExit:
            self.context.model.start(StopMotion(_BRAKE))
            raise
        finally:
            self._mover = None


class InputWatchdog:
    """An input that a client has to write to at least every `seconds`, or `act` is done; `writes` counts."""

    def __init__(self, seconds: float, writes: Callable[[], int], act: Callable[[], object]) -> None:
        self._limit = seconds / CYCLE
        self._writes = writes
        self._act = act
        self._seen = writes()
        self._at: int | None = None

    def check(self, cycle: int) -> None:
        """Once in each cycle."""
        if self._at is None or self._writes() != self._seen:
            self._seen, self._at = self._writes(), cycle
        elif cycle - self._at > self._limit:
            self._at = cycle
            self._act()


def matrix(pose: List) -> Matrix:
    """A script's pose as (4, 4)."""
    return matrix_from_pose(np.array(pose, float))


def as_pose(base_from_tool: Matrix) -> ScriptPose:
    """(4, 4) as a script's pose."""
    return ScriptPose(pose_from_matrix(base_from_tool).tolist())


def numbers(values: ArrayLike) -> List:
    """An array as a script's list."""
    return List(np.asarray(values, float).tolist())


def _norm(value: float | list[float]) -> float:
    return math.hypot(*value) if isinstance(value, list) else abs(value)


def _distance(a: List, b: List) -> float:
    return math.dist(a[:3], b[:3])


def _inverse(pose: List) -> ScriptPose:
    return as_pose(invert(matrix(pose)))


def _turn_between(a: List, b: List) -> float:
    return math.hypot(*rotation_vector(matrix(a)[:3, :3].T.dot(matrix(b)[:3, :3])))


def _interpolate(a: List, b: List, share: float) -> ScriptPose:
    start, end = matrix(a), matrix(b)
    turn = rotation_vector(start[:3, :3].T.dot(end[:3, :3]))
    between = np.eye(4)
    between[:3, :3] = start[:3, :3].dot(rotation_matrix(turn * share))
    between[:3, 3] = (1 - share) * start[:3, 3] + share * end[:3, 3]
    return as_pose(between)


def _pose_add(a: List, b: List) -> ScriptPose:
    sum_ = np.eye(4)
    sum_[:3, :3] = matrix(a)[:3, :3].dot(matrix(b)[:3, :3])
    sum_[:3, 3] = matrix(a)[:3, 3] + matrix(b)[:3, 3]
    return as_pose(sum_)


def _rpy2rotvec(rpy: Sequence[float]) -> List:
    roll, pitch, yaw = (rotation_matrix(angle * axis) for angle, axis in zip(rpy, np.eye(3), strict=True))
    return numbers(rotation_vector(yaw.dot(pitch).dot(roll)))


def _rotvec2rpy(vector: Sequence[float]) -> List:
    r = rotation_matrix(np.array(vector, float))
    pitch = math.atan2(-r[2, 0], math.hypot(r[0, 0], r[1, 0]))
    return List([math.atan2(r[2, 1], r[2, 2]), pitch, math.atan2(r[1, 0], r[0, 0])])


def _twist(frame: List, twist: Sequence[float]) -> List:
    """A wrench, given in `frame`, in the frame that `frame` is given in."""
    place, force, torque = matrix(frame), np.array(twist[:3], float), np.array(twist[3:], float)
    turned = place[:3, :3].dot(force)
    return numbers([*turned, *(place[:3, :3].dot(torque) + np.cross(place[:3, 3], turned))])


def _to_number(text: str) -> float:
    return float(text) if any(mark in text for mark in ".eE") else int(text)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _integer_to_bits(value: int) -> List:
    return List(bool(value >> bit & 1) for bit in range(32))


def _bits_to_integer(bits: Sequence[object]) -> int:
    word = sum(bool(bit) << place for place, bit in enumerate(bits[:32]))
    return int(struct.unpack("i", struct.pack("I", word))[0])


def _make_list(length: int, value: Value, capacity: int = 0) -> List:
    if length > MOST_ELEMENTS:
        raise ValueError(f"a list of {length} elements, at most {MOST_ELEMENTS}")
    return List([value] * length)


def _size(values: List) -> List | int:
    """Rows and columns of a matrix, the length of a list."""
    return List([len(values), len(values[0])]) if values and isinstance(values[0], list) else len(values)


def _str_sub(text: str, index: int, length: int = -1) -> str:
    return text[index:] if length < 0 else text[index : index + length]


def commands(environment: Environment) -> Commands:
    """By name; they need nothing of `environment`."""
    return {
        "sin": math.sin, "cos": math.cos, "tan": math.tan, "asin": math.asin, "acos": math.acos, "atan": math.atan,
        "atan2": math.atan2, "sqrt": math.sqrt, "pow": math.pow, "exp": math.exp,
        "log": lambda base, x: math.log(x, base),
        "floor": math.floor, "ceil": math.ceil, "round": round, "norm": _norm, "random": random.random,
        "d2r": math.radians, "r2d": math.degrees, "inv": _inverse, "pose_inv": _inverse,
        "pose_trans": lambda a, b: as_pose(matrix(a).dot(matrix(b))),
        "pose_add": _pose_add,
        "pose_sub": lambda a, b: _pose_add(a, _inverse(b)),
        "pose_dist": _distance, "point_dist": _distance,
        "rotation_dist": _turn_between,
        "interpolate_pose": _interpolate,
        "wrench_trans": _twist,
        "rpy2rotvec": _rpy2rotvec, "rotvec2rpy": _rotvec2rpy,
        "str_cat": lambda a, b: shown(a) + shown(b),
        "str_len": len, "str_at": lambda text, index: text[index], "str_empty": lambda text: not text,
        "str_find": lambda text, part, start=0: text.find(part, start),
        "str_sub": _str_sub,
        "to_str": shown, "to_num": _to_number, "is_number": _is_number,
        "get_list_length": len, "length": len, "size": _size,
        "make_list": _make_list,
        "transpose": lambda m: List(List(row) for row in zip(*m, strict=True)),
        "struct": Struct,
        "binary_list_to_integer": _bits_to_integer, "integer_to_binary_list": _integer_to_bits,
    }  # fmt: skip
