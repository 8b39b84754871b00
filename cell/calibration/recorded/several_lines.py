"""Poses that go over several lines each: a title, a line for the position, one for the rotation, the picture's name.

The lines of all poses have one pattern; what does not repeat is not read here.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cell.calibration.recorded.listing import PICTURES
from cell.calibration.recorded.records import COUNTS, Content, Record, file_like

LONGEST = 8
"""Lines of one pose."""
LEAST_POSES = 2
Line = tuple[list[str], list[float]]
"""The words and the numbers of a line."""


def read_several_lines(path: Path, lines: Sequence[Line], content: Content) -> bool:
    """Add the poses of lines that repeat; False where they do not, or where a line by itself may be a pose."""
    if any(len(numbers) >= min(COUNTS) for _, numbers in lines) or not any(words for words, _ in lines):
        return False
    patterns = [(len(numbers), *map(_pattern, words)) for words, numbers in lines]
    for length in range(2, min(LONGEST, len(lines) // LEAST_POSES) + 1):
        count = len(lines) // length
        if len(lines) % length or patterns != patterns[:length] * count:
            continue
        blocks = [lines[k * length : (k + 1) * length] for k in range(count)]
        if len(_numbers(blocks[0])) in COUNTS:
            content.records += [
                Record(path, "row", _label(block, k), np.array(_numbers(block)), time=_time(block))
                for k, block in enumerate(blocks)
            ]
            return True
    return False


def _pattern(word: str) -> str:
    return "a file" if file_like(word) else re.sub(r"\d+", "N", word)


def _numbers(block: Sequence[Line]) -> list[float]:
    """The numbers of a pose: no time, and no angles that only say again what a quaternion says."""
    parts = [(" ".join(words).lower(), numbers) for words, numbers in block if len(numbers) > 1]
    if any(len(numbers) == 4 for _, numbers in parts):
        parts = [(words, numbers) for words, numbers in parts if not re.search(r"\brpy\b|euler", words)]
    return [value for _, numbers in parts for value in numbers]


def _time(block: Sequence[Line]) -> float | None:
    """What a line of one number beside the word time says."""
    return next((n[0] for words, n in block if len(n) == 1 and "time" in " ".join(words).lower()), None)


def _label(block: Sequence[Line], k: int) -> str:
    """The picture that a pose names, else its first word with a number in it, else its place."""
    words = [word for words, _ in block for word in words]
    pictures = [w for w in words if Path(w).suffix.lower() in PICTURES]
    numbered = [w.strip(":=#") for w in words if re.search(r"\d", w)]
    return next(iter([*pictures, *numbered]), f"[{k}]")
