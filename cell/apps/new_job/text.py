"""A job as the text of its file: every value with its unit, each section with what it means.

The unit of a mesh: files such as STL do not say it. It is asked, or told by the size, never assumed in silence."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cell.config.job import Job
from cell.run.report.page import render
from drivers.errors import ConfigError
from drivers.make import Pose

METRES = {"mm": 1e-3, "m": 1.0, "inch": 0.0254}
LIKELY = (0.015, 0.45)
"""How long, m, the longer side of a surface is that one cell can sweep."""


def possible_units(longest: float) -> list[str]:
    """The units in which a mesh of this longest side is of a size that can be swept."""
    return [unit for unit, scale in METRES.items() if LIKELY[0] <= longest * scale <= LIKELY[1]]


def told_by_size(longest: float) -> tuple[str, str]:
    """The one unit that makes sense, and why, in words. Raises `ConfigError` where that is none, or several."""
    found = possible_units(longest)
    sizes = size_words(longest)
    if len(found) == 1:
        return found[0], f"taken as {found[0]}: of {sizes}, that alone can be swept"
    if not found:
        raise ConfigError(
            f"the mesh's longest side is {longest:.4g}: {sizes} (allowed: {1e3 * LIKELY[0]:g} to {1e3 * LIKELY[1]:g} "
            "mm), so no unit makes it a surface that one cell sweeps; cut it to what the part is placed onto, or name "
            "its unit with --unit"
        )
    raise ConfigError(
        f"the mesh's longest side is {longest:.4g}: {sizes}; which it is cannot be told: name it with --unit "
        f"{'|'.join(METRES)}"
    )


def size_words(longest: float) -> str:
    """What that side is in each unit."""
    return ", ".join(f"{1e3 * longest * scale:.4g} mm if in {unit}" for unit, scale in METRES.items())


def job_text(job: Job, heading: Sequence[str]) -> str:
    """The file of a job, as `job.toml.jinja` has it. `heading` are the lines of comment at its top: where it comes
    from, what was decided."""
    return render(
        __package__, "job.toml.jinja", job=job, heading=heading, mm=mm, deg=deg, pose=pose_text,
        mms=lambda lengths: ", ".join(map(mm, lengths)),
    )  # fmt: skip


def mm(metres: float) -> str:
    """A length, quoted."""
    return f'"{_plain(1e3 * metres)} mm"'


def deg(radians: float) -> str:
    """An angle, quoted."""
    return f'"{_plain(math.degrees(radians))} deg"'


def pose_text(pose: Pose) -> str:
    """A pose as an inline table."""
    there, turn = ", ".join(map(mm, pose.translation)), ", ".join(map(deg, pose.rotation))
    return f"{{ translation = [{there}], rotation = [{turn}] }}"


def _plain(value: float) -> str:
    """No more digits than were meant: what arithmetic added in the last place is not."""
    return f"{round(value, 6):.10g}".replace("-0", "0") if round(value, 6) == 0 else f"{round(value, 6):.10g}"
