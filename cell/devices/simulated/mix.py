"""Which devices of one cell are simulated beside real ones, and whether that makes sense.

A simulated camera sees a simulated world, which follows the real devices. A real camera sees the real one, in which
nothing follows a simulated device: what it would need of those is refused, not made up.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

from cell.config.cell_config import DEVICES, CellConfig, find_config, load_config
from drivers.errors import ConfigError

Sim = str | Sequence[str] | None
"""What may be asked for: "all", "none", names of devices in one text or in a list, or None for what `cell.sim` has."""

NEEDS = {
    "scan_camera": ("arm", "rail", "vehicle", "laser", "target_camera"),
    "target_camera": ("arm", "vehicle"),
}
"""What has to be real where a camera is real: it carries the camera, lights its picture or finds its station."""


def named(sim: Sim) -> tuple[str, ...] | None:
    """The devices that `sim` asks to simulate, in the cell's order; None where it leaves that to the configuration.

    Raises `ConfigError` for a name that is none.
    """
    if sim is None:
        return None
    names = [word.strip() for word in sim.split(",") if word.strip()] if isinstance(sim, str) else list(sim)
    if names == ["all"]:
        return tuple(DEVICES)
    if names == ["none"]:
        return ()
    if unknown := [name for name in names if name not in DEVICES]:
        raise ConfigError(
            f'sim: there is no device {", ".join(map(repr, unknown))}; write "all", "none", or some of '
            f"{', '.join(DEVICES)}"
        )
    return tuple(name for name in DEVICES if name in names)


def simulated_of(sim: Sim, config: Path | None) -> tuple[str, ...]:
    """As `named`, else what `cell.sim` of this configuration's file names. Raises `ConfigError`."""
    if (names := named(sim)) is not None:
        return names
    return named(load_config(find_config(config)).cell.sim) or ()


def require_possible(config: CellConfig, simulated: Collection[str], needed: Collection[str]) -> None:
    """Raise `ConfigError`, a line each, for what physics does not allow: these devices simulated, the others that
    are `needed` real."""
    problems = []
    for name in needed:
        if name in simulated:
            continue
        if config.make(name).on_arm and "arm" in simulated:
            problems.append(f"{name} is real and hangs on the arm's output, and the arm is simulated")
        if missing := [other for other in NEEDS.get(name, ()) if other in simulated]:
            problems.append(
                f"{name} is real: its pictures show nothing of what {_and(missing)} only simulated would do"
            )
    if problems:
        raise ConfigError(
            f"these devices cannot be simulated beside the others: {_and(simulated)}\n  "
            + "\n  ".join(problems)
            + "\nSimulate the first named of each line as well, or have the others real"
        )


def followed(config: CellConfig, simulated: Collection[str], needed: Collection[str]) -> tuple[str, ...]:
    """The real devices that the simulated world follows: those that move or light its pictures."""
    kinds = ("arm", "rail", "vehicle", "laser", "claw")
    return tuple(name for name in needed if name in kinds and name not in simulated and not config.make(name).on_arm)


def beware(simulated: Collection[str], needed: Collection[str]) -> list[str]:
    """What a person has to know before real devices move beside simulated ones; one sentence each."""
    real = [name for name in needed if name not in simulated]
    told = [f"simulated: {', '.join(simulated)}; real: {', '.join(real)}"]
    if "arm" in real and "scan_camera" in simulated:
        told.append(
            "the real arm moves by simulated pictures and puts down where the simulated surface is: keep the place "
            "clear. Touch is what it feels and what the simulated part would"
        )
    if "arm" in real and "vehicle" in simulated:
        told.append("the vehicle's brake is simulated: see that what the real arm stands on cannot roll")
    if "vehicle" in real and "arm" in simulated:
        told.append("the arm's posture is simulated: see that a real one on the vehicle is folded, or not there")
    if "claw" in simulated and "arm" in real:
        told.append("the claw is simulated: what a real one holds, it keeps")
    if "target_camera" in simulated and "vehicle" in real:
        told.append(
            "the real vehicle drives by a simulated board: it was taken to stand at the job's start when the cell was "
            "opened"
        )
    return told


def _and(names: Collection[str]) -> str:
    return ", ".join(names)
