"""What the devices tell of themselves, for the page: only what is there already, so that no line is kept busy.

The rail is asked while nothing goes on; in a run it is where its own motion has read it. The simulated devices on the
virtual clock have no time of the wall and are not read here. What a page asks once stands below: which cell this is,
what can be jogged and run, and what it looks like.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from cell.apps.console.host.manual import HOLD_SPEED, HOLD_TURN, rail_hold_speed
from cell.apps.console.view.scene import scene
from cell.config.cell_config import DEVICES, CellConfig
from cell.config.job import item_names, load_job, require_job_name, shipped_jobs
from cell.devices.devices import Devices
from cell.devices.gate.gate import Gated
from cell.devices.gate.rules import RULES
from cell.devices.simulated.process import is_whole
from cell.motion.kinematics import arm_kinematics
from cell.procedures.steps.kinds import kind_of
from cell.run.jogging import MAX_ANGLE_DEG, MAX_LENGTH_MM
from cell.run.session.supervisor import Cell
from drivers.errors import CellError, DeviceFault
from drivers.interfaces import ArmSafety, ArmState, Attended, RailState, VehicleState

OLD_S = 1.0
REST_S = 1.0
"""Wall seconds between two questions to a rail that rests."""

Told = TypeVar("Told")


class Readings:
    """The newest of each device; `look` takes them, called by one thread."""

    def __init__(self, config: CellConfig, devices: Devices, simulated: tuple[str, ...]) -> None:
        self.arm: ArmState | None = None
        self.vehicle: VehicleState | None = None
        self.rail: float | None = None
        self.laser: bool | None = None
        self._config = config
        self._devices = devices
        self._simulated = simulated
        self._rail_state: RailState | None = None
        self._rail_motion: object = None
        self._asked = 0.0
        self._held: bool | None = None
        self._faults: dict[str, dict[str, str] | None] = {}

    def look(self, idle: bool) -> None:
        """Take the newest readings; with `idle`, when nothing goes on, those with a line of their own are asked too."""
        devices, rate = self._devices, self._devices.clock.rate
        self.arm = self._of("arm", lambda: devices.arm.state(OLD_S * rate))
        self.vehicle = self._of("vehicle", lambda: devices.vehicle.state(OLD_S * rate))
        resting = idle and time.monotonic() - self._asked > REST_S
        if self._read_at_once("laser", resting):
            self.laser = self._of("laser", lambda: devices.laser.is_on)
        if self._read_at_once("claw", resting):
            self._held = self._of("claw", lambda: devices.claw.holding)
        self._look_at_rail(resting)

    def _read_at_once(self, name: str, resting: bool) -> bool:
        """Whether it is read now: what hangs on the arm is in the arm's state; another one has a line of its own."""
        return name in self._devices and (resting or self._config.make(name).on_arm)

    def _look_at_rail(self, resting: bool) -> None:
        if resting:
            self._asked = time.monotonic()
        if "rail" not in self._devices:
            return
        rail = self._devices.rail
        motion = rail.motion
        readings: Sequence[Any] = getattr(motion, "readings", ())
        if motion is not None and len(readings) and (not motion.done or motion is not self._rail_motion):
            self.rail = float(readings[-1][1])
        if resting and (motion is None or motion.done):
            self._rail_state = self._of("rail", rail.state)
            if self._rail_state is not None:
                self.rail = self._rail_state.position
                self._rail_motion = motion

    def _of(self, name: str, read: Callable[[], Told]) -> Told | None:
        if name not in self._devices:
            return None
        try:
            told = read()
        except CellError as error:
            hint = error.hint if isinstance(error, DeviceFault) else ""
            code = error.code if isinstance(error, DeviceFault) else type(error).__name__
            self._faults[name] = {"code": code, "text": str(error), "remedy": hint}
            return None
        self._faults[name] = None
        return told

    def motion(self) -> dict[str, object]:
        """Joints, flange, rail, vehicle, laser, for the state."""
        vehicle = self.vehicle
        return {
            "joints": None if self.arm is None else [round(float(q), 5) for q in self.arm.joints],
            "flange": None if self.arm is None else [round(float(v), 6) for v in self.arm.flange],
            "rail": None if self.rail is None else round(self.rail, 6),
            "vehicle": None if vehicle is None else _vehicle(vehicle), "laser": self.laser, "holding": self._held,
        }  # fmt: skip

    def safety(self) -> dict[str, object]:
        """The arm's safety state, the vehicle's emergency stop, and whether a stop holds direct commands."""
        return {
            "arm": None if self.arm is None else self.arm.safety.value,
            "vehicle_stop": None if self.vehicle is None else self.vehicle.emergency_stop,
            "stopped": not self._devices.gate.is_open,
        }

    def devices(self, held_by: str) -> dict[str, object]:
        """Each device's row: state in words, whether it is well, link, last error."""
        rows: dict[str, object] = {}
        for device in self._devices:
            name = device.name
            fault = self._faults.get(name) or self._ailing(name)
            trips = device.statistics.round_trips_s[-50:]
            rows[name] = {
                "state": self._words(name), "ok": fault is None, "simulated": name in self._simulated,
                "held_by": held_by, "rtt_ms": round(1e3 * float(np.median(trips)), 2) if trips else None,
                "errors": dict(device.statistics.errors), "fault": fault,
            }  # fmt: skip
        return {name: rows[name] for name in DEVICES if name in rows}

    def _ailing(self, name: str) -> dict[str, str] | None:
        if name == "arm" and self.arm is not None and self.arm.safety is not ArmSafety.NORMAL:
            state = self.arm.safety
            remedy = "Look for the reason and clear the way."
            text = ": ".join(filter(None, (f"the arm is in {state.value}", self.arm.reason)))
            return {"code": f"arm.{state.name.lower()}", "text": text, "remedy": remedy}
        if name == "vehicle" and self.vehicle is not None and self.vehicle.trouble:
            told = "; ".join(self.vehicle.trouble)
            return {"code": "vehicle.trouble", "text": told, "remedy": "Look at the vehicle, then recover it."}
        return None

    def _words(self, name: str) -> str:
        match name:
            case "arm" if self.arm is not None:
                return "moves" if self.arm.moving else "stands" if self.arm.controlled else "stands, no control program"
            case "vehicle" if self.vehicle is not None:
                brake = {None: "brake unknown", True: "braked", False: "brake open"}[self.vehicle.braked]
                return brake if abs(self.vehicle.speed) + abs(self.vehicle.yaw_rate) < 1e-3 else "drives"
            case "rail":
                motion = self._devices.rail.motion
                if motion is not None and not motion.done:
                    return "moves"
                if self._rail_state is None:
                    return "stands"
                return "homed" if self._rail_state.homed else "not homed"
            case "laser" if self.laser is not None:
                return "on" if self.laser else "off"
            case "claw" if self._held is not None:
                return "holds a part" if self._held else "empty"
        return ""


def _vehicle(state: VehicleState) -> dict[str, object]:
    digits = {"x": 5, "y": 5, "yaw": 6, "speed": 4, "yaw_rate": 5}
    return {**{key: round(getattr(state, key), n) for key, n in digits.items()}, "braked": state.braked}


MM, DEG = 1e-3, 3.141592653589793 / 180
LENGTHS = [0.1 * MM, 1 * MM, 10 * MM, 50 * MM]
ANGLES = [0.1 * DEG, 1 * DEG, 5 * DEG]


def cell_facts(cell: Cell, job: str) -> dict[str, object]:
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
        "job": job, "jobs": jobs(job), "steps": list(kind_of(loaded).names),
        "interlocks": [rule.name for rule in RULES if rule.check is not None and rule.liftable],
        "scene": scene(config, job, table, cell.folder / config.cell.meshes if config.cell.meshes else None),
    }  # fmt: skip


def jobs(own: str) -> list[str]:
    """The console's own first, those of the present folder, and those that ship; of several items each one, too."""
    here: list[str] = []
    for path in sorted(Path.cwd().glob("*.toml")):
        try:
            require_job_name(path.stem)
            load_job(path.stem)
            here += path.stem, *item_names(path.stem)
        except CellError:
            continue
    shipped = [each for name in shipped_jobs() for each in (name, *item_names(name))]
    return list(dict.fromkeys((own, *here, *shipped)))


def _jogs(cell: Cell, name: str) -> list[dict[str, object]]:
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
                {**way, "axis": axis, "hold": False, "speed": None} for way, axis in ((length, "x"), (angle, "yaw"))
            ]
    return []
