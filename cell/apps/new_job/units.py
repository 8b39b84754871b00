"""The unit of a mesh: files such as STL do not say it. It is asked, or told by the size, never assumed in silence."""

from __future__ import annotations

from drivers.errors import ConfigError

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
