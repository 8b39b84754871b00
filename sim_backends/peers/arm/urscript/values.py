"""URScript's values beside numbers, texts and truth values: lists, poses and structs, with their arithmetic.

Lists are added and scaled element by element; a pose is a list of six that prints with a `p`. Members that scripts
can reach begin with `u_`, so that a script reaches nothing else of an object.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable
from typing import Any

MOST_ELEMENTS, MOST_CHARACTERS, MOST_INTEGER = 100_000, 1_000_000, 2**63
"""What a variable may hold; a controller's own limits are lower, and a program that exceeds them ends."""


class List(list[Any]):
    """A list or, as a list of lists, a matrix."""

    def __getitem__(self, index: Any) -> Any:
        """The element at a whole number, counted from 0; negative ones do not exist."""
        return list.__getitem__(self, index if isinstance(index, slice) else _whole(index))

    def __setitem__(self, index: Any, value: Any) -> None:
        """Change the element at a whole number."""
        list.__setitem__(self, _whole(index), value)

    def _each(self, other: Any, act: Callable[[Any, Any], Any]) -> List:
        if isinstance(other, list):
            if len(other) != len(self):
                raise TypeError(f"lists of {len(self)} and {len(other)} elements")
            return type(self)(map(act, self, other))
        return type(self)(act(mine, other) for mine in self)

    def __add__(self, other: Any) -> List:
        """Element by element."""
        return self._each(other, operator.add)

    def __sub__(self, other: Any) -> List:
        """Element by element."""
        return self._each(other, operator.sub)

    def __mul__(self, other: Any) -> List:
        """By a number, or element by element."""
        return self._each(other, operator.mul)

    __rmul__ = __mul__
    __radd__ = __add__

    def __truediv__(self, other: Any) -> List:
        """By a number, or element by element."""
        return self._each(other, operator.truediv)

    def __neg__(self) -> List:
        """Each element's opposite."""
        return type(self)(-value for value in self)

    def u_length(self) -> int:
        """How many elements."""
        return len(self)

    def u_append(self, value: Any) -> None:
        """Add `value` at the end."""
        self.append(value)

    def u_pop(self) -> Any:
        """Take the last element away."""
        return self.pop()

    def u_clear(self) -> None:
        """Take all elements away."""
        self.clear()


class ScriptPose(List):
    """Place in m and rotation vector in rad: p[x, y, z, rx, ry, rz]."""

    def __init__(self, values: Iterable[Any]) -> None:
        super().__init__(values)
        if len(self) != 6:
            raise TypeError(f"a pose of {len(self)} numbers")


class Struct:
    """Named members, made by struct(name = value, …)."""

    def __init__(self, **members: Any) -> None:
        for name, value in members.items():
            setattr(self, f"u_{name}", value)

    def members(self) -> dict[str, Any]:
        """The members by name."""
        return {name[2:]: value for name, value in vars(self).items()}


def own(value: Any) -> tuple[Any, int]:
    """A copy of a list or struct, anything else as it is, and how many values that are: an assignment or a call gives
    a variable a value of its own. `ValueError` for one that is too large.
    """
    return _copied(value, 0)


def _copied(value: Any, count: int) -> tuple[Any, int]:
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


def shown(value: Any) -> str:
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
