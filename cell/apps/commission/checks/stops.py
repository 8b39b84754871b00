"""Stops: what moves or shines is stopped from each cause, and the time and the way until it rests are measured."""

import math
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from cell.apps.commission.check import CommissionCheck, Result, refused
from cell.apps.commission.workplace import CommissionWorkplace
from cell.procedures.drive.driving import Planar, RelativeOdometry, drive_line, driven
from cell.run.recorded_work import WorkContext
from drivers.errors import Aborted, InterlockError, RefusedError
from drivers.interfaces import ArmSafety, Motion

RAIL_SPEED = 0.020
ARM_SPEED, ARM_STEP = math.radians(5.0), math.radians(6.0)
SLOW_SPEED, SLOW_STEP = math.radians(1.5), math.radians(12.0)
"""Of joint 1 while a person reaches for the emergency stop."""
VEHICLE_SPEED = 0.10
BEFORE_S, WATCH_S, PERIOD_S = 0.5, 1.0, 0.01
MOST_S = 1.0
MOST_WAY = {"rail": 10.0, "arm": 3.0, "vehicle": 120.0}
"""mm, deg, mm from the cause to rest."""
UNITS = {"rail": "mm", "arm": "deg", "vehicle": "mm"}
AT_REST = {"rail": 0.05e-3, "arm": math.radians(0.02), "vehicle": 1e-3}
"""Way within a period, m or rad, below which a device rests."""
KEPT_ALIVE_S = 0.5
BY = "the commissioning, which had stopped the cell itself"


def _stops(workplace: CommissionWorkplace, result: Result) -> None:
    workplace.fold()
    workplace.home_rail()
    stood = RelativeOdometry(workplace.devices.vehicle)
    for name, start in (("rail", _rail_moves), ("arm", _arm_moves), ("vehicle", _vehicle_moves)):
        if name == "vehicle" and not workplace.config.vehicle.DRIVES:
            continue
        for sign, cause, stop in ((1.0, "Cell.stop()", _by_program), (-1.0, "`cell abort`", _by_request)):
            _measured(workplace, result, name, cause=cause, start=partial(start, sign), stop=stop)
    _vehicle_unrenewed(workplace, result)
    _laser(workplace, result)
    _emergency(workplace, result)
    _drive_back(workplace, stood)


def _measured(
    workplace: CommissionWorkplace, result: Result, name: str, cause: str, start: Callable[[CommissionWorkplace],
    object], stop: Callable[[CommissionWorkplace, Callable[[], None]], None],
) -> None:  # fmt: skip
    """Set the device in motion, stop it, and watch it until it rests."""
    _prepare(workplace, name)
    marks: dict[str, float] = {}

    def begin() -> None:
        begun = workplace.devices.clock.now()
        start(workplace)
        while workplace.devices.clock.now() - begun < BEFORE_S:
            if name == "vehicle":
                start(workplace)
            workplace.devices.clock.sleep(0.05)
        marks["at"], marks["from"] = workplace.devices.clock.now(), _place(workplace, name)

    stop(workplace, begin)
    last, rested = _place(workplace, name), workplace.devices.clock.now()
    until = rested + WATCH_S
    while workplace.devices.clock.now() < until:
        workplace.devices.clock.sleep(PERIOD_S)
        here = _place(workplace, name)
        if abs(here - last) > AT_REST[name]:
            last, rested = here, workplace.devices.clock.now()
    way = abs(_place(workplace, name) - marks["from"]) * (math.degrees(1.0) if name == "arm" else 1e3)
    hurry = max(1.0, workplace.devices.clock.rate)
    result.measure(f"{name}, {cause}: time to rest, at most", rested - marks["at"], "s", most=MOST_S * hurry)
    result.measure(f"{name}, {cause}: way", way, UNITS[name], most=MOST_WAY[name] * hurry)


def _prepare(workplace: CommissionWorkplace, name: str) -> None:
    """Where the motion to be stopped begins."""
    if name == "rail":
        low, high = workplace.config.rail.travel
        workplace.confirm("rail", "the carriage", "a part of its travel", f"{1e3 * RAIL_SPEED:.0f} mm/s")
        workplace.devices.rail.move_to(0.5 * (low + high), min(RAIL_SPEED, workplace.config.rail.max_speed)).wait(60.0)
    elif name == "arm":
        far, fast = f"up to {math.degrees(ARM_STEP):.0f} deg", f"{math.degrees(ARM_SPEED):.0f} deg/s"
        workplace.confirm("joint 1", "this joint alone", far, fast)
        workplace.fold()
    else:
        workplace.fold()
        workplace.confirm("vehicle", "its wheels, straight ahead", "about 100 mm", f"{1e3 * VEHICLE_SPEED:.0f} mm/s")
        workplace.devices.vehicle.enable()


def _rail_moves(sign: float, workplace: CommissionWorkplace) -> Motion:
    low, high = workplace.config.rail.travel
    goal = 0.5 * (low + high) + sign * 0.4 * (high - low)
    return workplace.devices.rail.move_to(goal, min(RAIL_SPEED, workplace.config.rail.max_speed))


def _arm_moves(sign: float, workplace: CommissionWorkplace, step: float = ARM_STEP, speed: float = ARM_SPEED) -> Motion:
    arm = workplace.devices.arm
    workplace.brake()
    goal = arm.state().joints.copy()
    goal[0] += sign * step
    return arm.move_joints(goal, speed, math.radians(40.0))


def _vehicle_moves(sign: float, workplace: CommissionWorkplace) -> None:
    workplace.devices.vehicle.drive(sign * VEHICLE_SPEED, 0.0)


def _drive_back(workplace: CommissionWorkplace, stood: RelativeOdometry) -> None:
    """The vehicle to where it stood, by its wheels' counters."""
    if not workplace.config.vehicle.DRIVES:
        return
    workplace.fold()
    vehicle = workplace.devices.vehicle
    with driven(vehicle):
        drive_line(
            vehicle, stood, Planar(0.0, 0.0, 0.0), VEHICLE_SPEED, workplace.devices.clock, check=workplace.look_around
        )


def _place(workplace: CommissionWorkplace, name: str) -> float:
    devices = workplace.devices
    if name == "rail":
        return devices.rail.state().position
    if name == "arm":
        return float(devices.arm.state().joints[0])
    state = devices.vehicle.state()
    return float(math.hypot(state.x, state.y))


def _by_program(workplace: CommissionWorkplace, begin: Callable[[], None]) -> None:
    begin()
    workplace.cell.stop()
    workplace.cell.clear_stop(BY)


def _by_request(workplace: CommissionWorkplace, begin: Callable[[], None]) -> None:
    """The run is asked to end, as `cell abort` asks from another shell."""

    def work(context: WorkContext) -> None:
        begin()
        run = workplace.cell.current
        if run is not None:
            run.abort("the commissioning tries how a request to end ends it")
        context.check()

    try:
        workplace.cell.perform("commission", work, info={"check": "stops"})
    except Aborted:
        workplace.cell.clear_stop(BY)
        return
    raise InterlockError("cell", "a run that was asked to end did not end")


def _vehicle_unrenewed(workplace: CommissionWorkplace, result: Result) -> None:
    """A vehicle that hears nothing any more stops by itself."""
    if not workplace.config.vehicle.DRIVES:
        return
    workplace.fold()
    vehicle, clock = workplace.devices.vehicle, workplace.devices.clock
    with driven(vehicle):
        begun = clock.now()
        while clock.now() - begun < BEFORE_S:
            vehicle.drive(VEHICLE_SPEED, 0.0)
            clock.sleep(0.05)
        last = clock.now()
        while abs(vehicle.state().speed) > 0.005 and clock.now() - last < 5.0:
            clock.sleep(PERIOD_S)
        result.measure(
            "vehicle, commands not renewed: time to rest", clock.now() - last, "s",
            most=(KEPT_ALIVE_S + MOST_S) * max(1.0, clock.rate),
        )  # fmt: skip


def _laser(workplace: CommissionWorkplace, result: Result) -> None:
    """The laser goes off with a stop, whoever holds it."""
    workplace.confirm("laser", "laser goggles on, nobody looks into the beam", "half a second", "on and off")
    workplace.brake()
    laser, clock = workplace.devices.laser, workplace.devices.clock
    with workplace.devices.interlocks.purpose("test"), laser.lit():
        clock.sleep(0.2)
        begun = clock.now()
        workplace.cell.stop()
        most = MOST_S * max(1.0, clock.rate)
        result.measure("laser, Cell.stop(): off after, at most", clock.now() - begun, "s", most=most)
        result.measure("laser on after a stop", float(laser.is_on), "", most=0.0)
    workplace.cell.clear_stop(BY)


def _emergency(workplace: CommissionWorkplace, result: Result) -> None:
    """A person stops the arm with the button while it turns; afterwards nothing goes on by itself."""
    arm, clock, simulated = workplace.devices.arm, workplace.devices.clock, workplace.simulated
    workplace.fold()
    workplace.brake()
    if not simulated and not workplace.person.go_ahead(
        f"Joint 1 will turn by {math.degrees(SLOW_STEP):g} deg in {SLOW_STEP / SLOW_SPEED:.0f} s: press the emergency "
        "stop while it turns."
    ):
        raise RefusedError("the emergency stop was not tried")
    motion = _arm_moves(1.0, workplace) if simulated else _arm_moves(1.0, workplace, SLOW_STEP, SLOW_SPEED)
    clock.sleep(BEFORE_S)
    begun, before = clock.now(), _place(workplace, "arm")
    cause, remedy = "emergency stop", "Press it before joint 1 has turned to its end."
    if simulated:
        cause = "protective stop (simulated)"
        workplace.cause("arm.protective_stop")
    deadline = time.monotonic() + 20.0
    while arm.state().safety is ArmSafety.NORMAL and not motion.done and time.monotonic() < deadline:
        clock.sleep(PERIOD_S)
    if arm.state().safety is ArmSafety.NORMAL:
        # A motion that the button ended may be known before the button.
        clock.sleep(BEFORE_S)
    stopped = arm.state().safety
    while float(np.abs(arm.state().joint_speeds).max()) > 1e-3 and time.monotonic() < deadline:
        clock.sleep(PERIOD_S)
    result.notes.append(f"after the {cause} the arm told: {stopped.value}")
    result.require(f"arm, {cause}: it told so", stopped is not ArmSafety.NORMAL, remedy)
    if stopped is ArmSafety.NORMAL:
        return
    if simulated:
        most, way = MOST_S * max(1.0, clock.rate), math.degrees(abs(_place(workplace, "arm") - before))
        result.measure(f"arm, {cause}: time to rest, at most", clock.now() - begun, "s", most=most)
        result.measure(f"arm, {cause}: way", way, "deg", most=MOST_WAY["arm"])
    result.require("a motion while it is stopped refused", refused(lambda: _arm_moves(1.0, workplace).wait(1.0)))
    if workplace.person.does("Release the button, look that all is well, and switch the arm on again at its pendant."):
        arm.recover(confirmed=True)
    workplace.fold()


CHECKS = [
    CommissionCheck(
        "stops", "Stops: from each cause, time and way",
        "rail, joint 1 and wheels, one after the other, each stopped on its way; the laser",
        far="rail 20 mm, joint 1 12 deg, wheels 100 mm at most", fast="20 mm/s, 5 deg/s, 100 mm/s",
        limit=f"at rest within {MOST_S:g} s, {MOST_WAY['rail']:g} mm, {MOST_WAY['arm']:g} deg, "
        f"{MOST_WAY['vehicle']:g} mm",
        keys=("rail", "arm.model", "vehicle", "laser"), needs=("rail_limits", "vehicle", "outputs"), work=_stops,
        recorded=False,
    ),
]  # fmt: skip
