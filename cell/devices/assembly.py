"""The composition root: from configuration to devices, each of the make that the configuration names."""

from collections.abc import Callable, Collection
from contextlib import ExitStack
from typing import Any

from cell.config.cell_config import DEVICES, CellConfig
from cell.devices.devices import Devices
from cell.devices.gate.gate import Gate
from cell.devices.gate.gated import GatedArm, GatedCamera, GatedClaw, GatedLaser, GatedRail, GatedVehicle
from cell.devices.gate.interlocks import Interlocks, Situation
from cell.devices.gate.rules import RULES, Ways
from cell.measure.geometry.poses import to_ur
from cell.motion.kinematics import HOME, MODELS, arm_kinematics
from drivers.clock import Clock
from drivers.errors import ConfigError
from drivers.interfaces import Arm, Camera, Claw, Device, Laser, LinkTable, Rail, Vector, Vehicle
from drivers.make import OnArm, Surroundings

INTERFACES: dict[str, type] = {
    "rail": Rail, "arm": Arm, "vehicle": Vehicle, "camera": Camera, "laser": Laser, "claw": Claw,
}  # fmt: skip
"""What each kind of device has to offer, whatever its make."""


def connect(
    config: CellConfig,
    only: Collection[str] = tuple(DEVICES),
    otherwise: Callable[[str, Clock], Device | None] = lambda name, clock: None,
) -> Devices:
    """Connect these devices, behind a gate; when one fails, those connected are closed and the error goes on. What
    `otherwise` gives for a device's name is taken instead, unless it is None."""
    clock = Clock(config.cell.time_scale)
    made: dict[str, Any] = {}
    needed = connected_for(config, only)
    refuse_replays(config, needed)
    with ExitStack() as opened:
        for name in needed:
            made[name] = otherwise(name, clock) or connect_one(config, name, clock, arm=made.get("arm"))
            if not config.make(name).on_arm:
                opened.callback(made[name].close)
        opened.pop_all()
    return behind_gate(config, clock, **made)


def refuse_replays(config: CellConfig, needed: Collection[str]) -> None:
    """`ConfigError` when something that moves would be connected beside a camera that shows another day."""
    replaying = [name for name in needed if config.make(name).replays]
    moving = [name for name in needed if DEVICES[name] in ("arm", "rail", "vehicle", "claw")]
    if replaying and moving:
        raise ConfigError(
            f'{replaying[0]}.driver = "{config.make(replaying[0]).name}" plays recorded pictures, by which nothing may '
            f"move: {', '.join(moving)} cannot be opened beside it. Name a camera that is there, or open it alone"
        )


def connected_for(config: CellConfig, wanted: Collection[str]) -> list[str]:
    """The devices that have to be connected for these ones: with one that hangs on the arm, the arm as well."""
    needed = {"arm" for name in wanted if config.make(name).on_arm} | set(wanted)
    return [name for name in DEVICES if name in needed]


def connect_one(config: CellConfig, name: str, clock: Clock, *, arm: Arm | None = None, look: bool = False) -> Any:
    """One device, not behind a gate; what hangs on the arm is given the `arm`. With `look` it is only looked at:
    nothing on it is set, started or ended, and what runs on it runs on."""
    around = Surroundings(clock, look, arm)
    if DEVICES[name] == "arm":
        # Its own process switches the laser off when this one dies.
        around = Surroundings(
            clock, look, safe_off_outputs=safe_off_outputs(config), reach=MODELS[config.arm.model].reach,
            forward_of=lambda table: _forward(config, table),
        )  # fmt: skip
    make = config.make(name)
    device = make.connect(name, config.device(name), around)
    if missing := [method for method in methods(INTERFACES[make.kind]) if not hasattr(device, method)]:
        if hasattr(device, "close"):
            device.close()
        raise ConfigError(
            f'{name}: the {make.kind} "{make.name}" has no {", ".join(missing)}, which every {make.kind} must have '
            "now; install a newer version of the package that brings it, or name another driver"
        )
    return device


def methods(interface: type) -> list[str]:
    """The methods that an interface asks for, by name; no properties, because to look for one may ask the device."""
    return [name for name in dir(interface) if not name.startswith("_") and callable(getattr(interface, name))]


def _forward(config: CellConfig, table: LinkTable | None) -> Callable[[Vector], Vector]:
    kinematics = arm_kinematics(config.arm.model, table)
    return lambda joints: to_ur(kinematics.fk(joints))


def safe_off_outputs(config: CellConfig) -> tuple[int, ...]:
    """The arm's outputs that have to go off when nobody watches them any more: the laser's, if it hangs on one."""
    return (config.laser.output,) if isinstance(config.laser, OnArm) else ()


def behind_gate(
    config: CellConfig, clock: Clock, arm: Arm | None = None, rail: Rail | None = None,
    vehicle: Vehicle | None = None, scan_camera: Camera | None = None, target_camera: Camera | None = None,
    laser: Laser | None = None, claw: Claw | None = None,
) -> Devices:  # fmt: skip
    """These devices, of whatever make, with everything that moves, shines or grips behind one gate."""
    ways = Ways(config, None if arm is None else arm.link_table())
    switched = (config.laser, "laser"), (config.claw, "claw")
    situation = Situation(
        arm, vehicle, laser, claw=claw,
        outputs={record.output: owner for record, owner in switched if isinstance(record, OnArm)}, clear=ways.clear,
        forward=ways.forward, postures={"HOME": HOME}, configuration=config.calibration_hash(), slowed=ways.slowed,
        clock=clock,
    )  # fmt: skip
    gate = Gate(Interlocks(situation, RULES))
    return Devices(
        clock, gate, arm=None if arm is None else GatedArm(arm, gate),
        rail=None if rail is None else GatedRail(rail, gate),
        vehicle=None if vehicle is None else GatedVehicle(vehicle, gate),
        scan_camera=None if scan_camera is None else GatedCamera(scan_camera, gate),
        target_camera=None if target_camera is None else GatedCamera(target_camera, gate),
        laser=None if laser is None else GatedLaser(laser, gate, clock),
        claw=None if claw is None else GatedClaw(claw, gate),
    )  # fmt: skip
