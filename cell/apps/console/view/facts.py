"""What a page asks once: which cell this is, what can be jogged and run, and what it looks like."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from cell.apps.console.host.manual import HOLD_SPEED, HOLD_TURN, rail_hold_speed
from cell.apps.console.view.scene import scene
from cell.config.cell_config import DEVICES
from cell.config.job import load_job, require_job_name, shipped_jobs
from cell.devices.gate.gate import Gated
from cell.devices.gate.rules import RULES
from cell.devices.simulated.process import is_whole
from cell.motion.arm_models import arm_kinematics
from cell.procedures.steps.kinds import find_kind
from cell.run.jogging import MAX_ANGLE_DEG, MAX_LENGTH_MM
from drivers.errors import CellError
from drivers.interfaces import Attended

if TYPE_CHECKING:
    from cell.run.session.supervisor import Cell

MM, DEG = 1e-3, 3.141592653589793 / 180
LENGTHS = [0.1 * MM, 1 * MM, 10 * MM, 50 * MM]
ANGLES = [0.1 * DEG, 1 * DEG, 5 * DEG]


def cell_facts(cell: Cell, job: str) -> dict[str, Any]:
    """The answer of `/api/cell` (docs/reference/console.md), with the station of `job`; `ConfigError` for one that is
    none."""
    config, simulated = cell.config, cell.simulated
    loaded, _ = load_job(job)
    facts = {} if simulated is None else simulated.facts
    which: bool | list[str] = False if simulated is None else True if is_whole(simulated) else [*simulated.simulated]
    there = [name for name in DEVICES if name in cell.devices]
    served = [] if simulated is None else simulated.simulated
    table = cell.devices.arm.link_table() if "arm" in cell.devices else None
    limits = arm_kinematics(config.arm.model, table).limits
    return {
        "version": 1, "name": config.cell.name, "simulated": which, "clock": facts.get("clock", "wall"),
        "speed": cell.devices.clock.rate, "seed": facts.get("seed"), "level": facts.get("level"),
        "devices": [
            {"name": name, "kind": DEVICES[name], "make": config.make(name).name, "simulated": name in served}
            for name in there
        ],
        "limits": {
            "joints": [[float(low), float(high)] for low, high in zip(limits.lower, limits.upper, strict=True)],
            "rail": [*config.rail.travel],
        },
        "jog": [entry for name in there for entry in _jogs(cell, name)],
        "job": job, "jobs": jobs(job), "steps": list(find_kind(loaded.job.kind).names),
        "interlocks": [rule.name for rule in RULES if rule.check is not None and rule.liftable],
        "scene": scene(config, job, table, cell.folder / config.cell.meshes if config.cell.meshes else None),
    }  # fmt: skip


def jobs(own: str) -> list[str]:
    """The console's own first, those of the present folder, and those that ship."""
    here = []
    for path in sorted(Path.cwd().glob("*.toml")):
        try:
            require_job_name(path.stem)
            load_job(path.stem)
            here.append(path.stem)
        except CellError:
            continue
    return list(dict.fromkeys((own, *here, *shipped_jobs())))


def _jogs(cell: Cell, name: str) -> list[dict[str, Any]]:
    device: Any = getattr(cell.devices, name)
    attended = isinstance(device.bare if isinstance(device, Gated) else device, Attended)
    length = {"device": name, "unit": "m", "most": MAX_LENGTH_MM * MM, "steps": LENGTHS}
    angle = {"device": name, "unit": "rad", "most": MAX_ANGLE_DEG * DEG, "steps": ANGLES}
    match name:
        case "rail":
            return [{**length, "axis": "", "hold": attended, "speed": rail_hold_speed(cell.config.rail)}]
        case "arm":
            lines = [{**length, "axis": axis, "hold": attended, "speed": HOLD_SPEED} for axis in "xyz"]
            turns = [{**angle, "axis": f"r{axis}", "hold": False, "speed": None} for axis in "xyz"]
            joints = [{**angle, "axis": f"j{k}", "hold": attended, "speed": HOLD_TURN} for k in range(1, 7)]
            return [*lines, *turns, *joints]
        case "vehicle" if cell.config.vehicle.DRIVES:
            return [
                {**length, "axis": "x", "hold": False, "speed": None},
                {**angle, "axis": "yaw", "hold": False, "speed": None},
            ]
    return []
