"""Stops: what moves or shines is stopped from each cause, and the time and the way until it rests are measured."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from cell.apps.commission.check import CommissionCheck, Result, refused
from cell.apps.commission.workplace import CommissionWorkplace
from cell.procedures.drive.way import Planar, RelativeOdometry, drive_line, driven
from cell.run.recorded_work import WorkContext
from drivers.errors import Aborted, InterlockError
from drivers.interfaces import ArmSafety, Motion

RAIL_SPEED = 0.020
ARM_SPEED, ARM_STEP = math.radians(5.0), math.radians(6.0)
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


def _stops(desk: CommissionWorkplace, result: Result) -> None:
    desk.fold()
    desk.home_rail()
    stood = RelativeOdometry(desk.devices.vehicle)
    for name, start in (("rail", _rail_moves), ("arm", _arm_moves), ("vehicle", _vehicle_moves)):
        if name == "vehicle" and not desk.config.vehicle.DRIVES:
            continue
        for sign, cause, stop in ((1.0, "Cell.stop()", _by_program), (-1.0, "`cell abort`", _by_request)):
            _measured(desk, result, name, cause=cause, start=partial(start, sign), stop=stop)
    _vehicle_unrenewed(desk, result)
    _laser(desk, result)
    _emergency(desk, result)
    _drive_back(desk, stood)


def _measured(
    desk: CommissionWorkplace, result: Result, name: str, cause: str, start: Callable[[CommissionWorkplace], object],
    stop: Callable[[CommissionWorkplace, Callable[[], None]], None],
) -> None:  # fmt: skip
    """Set the device in motion, stop it, and watch it until it rests."""
    _prepare(desk, name)
    marks: dict[str, float] = {}

    def begin() -> None:
        begun = desk.devices.clock.now()
        start(desk)
        while desk.devices.clock.now() - begun < BEFORE_S:
            if name == "vehicle":
                start(desk)
            desk.devices.clock.sleep(0.05)
        marks["at"], marks["from"] = desk.devices.clock.now(), _place(desk, name)

    stop(desk, begin)
    last, rested = _place(desk, name), desk.devices.clock.now()
    until = rested + WATCH_S
    while desk.devices.clock.now() < until:
        desk.devices.clock.sleep(PERIOD_S)
        here = _place(desk, name)
        if abs(here - last) > AT_REST[name]:
            last, rested = here, desk.devices.clock.now()
    way = abs(_place(desk, name) - marks["from"]) * (math.degrees(1.0) if name == "arm" else 1e3)
    hurry = max(1.0, desk.devices.clock.rate)
    result.measure(f"{name}, {cause}: time to rest, at most", rested - marks["at"], "s", most=MOST_S * hurry)
    result.measure(f"{name}, {cause}: way", way, UNITS[name], most=MOST_WAY[name] * hurry)


def _prepare(desk: CommissionWorkplace, name: str) -> None:
    """Where the motion to be stopped begins."""
    if name == "rail":
        low, high = desk.config.rail.travel
        desk.confirm("rail", "the carriage", "a part of its travel", f"{1e3 * RAIL_SPEED:.0f} mm/s")
        desk.devices.rail.move_to(0.5 * (low + high), min(RAIL_SPEED, desk.config.rail.max_speed)).wait(60.0)
    elif name == "arm":
        far, fast = f"up to {math.degrees(ARM_STEP):.0f} deg", f"{math.degrees(ARM_SPEED):.0f} deg/s"
        desk.confirm("joint 1", "this joint alone", far, fast)
        desk.fold()
    else:
        desk.fold()
        desk.confirm("vehicle", "its wheels, straight ahead", "about 100 mm", f"{1e3 * VEHICLE_SPEED:.0f} mm/s")
        desk.devices.vehicle.enable()


def _rail_moves(sign: float, desk: CommissionWorkplace) -> Motion:
    low, high = desk.config.rail.travel
    goal = 0.5 * (low + high) + sign * 0.4 * (high - low)
    return desk.devices.rail.move_to(goal, min(RAIL_SPEED, desk.config.rail.max_speed))


def _arm_moves(sign: float, desk: CommissionWorkplace) -> Motion:
    arm = desk.devices.arm
    desk.brake()
    goal = arm.state().joints.copy()
    goal[0] += sign * ARM_STEP
    return arm.move_joints(goal, ARM_SPEED, math.radians(40.0))


def _vehicle_moves(sign: float, desk: CommissionWorkplace) -> None:
    desk.devices.vehicle.drive(sign * VEHICLE_SPEED, 0.0)


def _drive_back(desk: CommissionWorkplace, stood: RelativeOdometry) -> None:
    """The vehicle to where it stood, by its wheels' counters."""
    if not desk.config.vehicle.DRIVES:
        return
    desk.fold()
    vehicle = desk.devices.vehicle
    with driven(vehicle):
        drive_line(vehicle, stood, Planar(0.0, 0.0, 0.0), VEHICLE_SPEED, desk.devices.clock, check=desk.look_around)


def _place(desk: CommissionWorkplace, name: str) -> float:
    devices = desk.devices
    if name == "rail":
        return devices.rail.state().position
    if name == "arm":
        return float(devices.arm.state().joints[0])
    state = devices.vehicle.state()
    return float(math.hypot(state.x, state.y))


def _by_program(desk: CommissionWorkplace, begin: Callable[[], None]) -> None:
    begin()
    desk.cell.stop()
    desk.cell.clear_stop(BY)


def _by_request(desk: CommissionWorkplace, begin: Callable[[], None]) -> None:
    """The run is asked to end, as `cell abort` asks from another shell."""

    def work(context: WorkContext) -> None:
        begin()
        run = desk.cell.current
        if run is not None:
            run.abort("the commissioning tries how a request to end ends it")
        context.check()

    try:
        desk.cell.perform("commission", work, info={"check": "stops"})
    except Aborted:
        desk.cell.clear_stop(BY)
        return
    raise InterlockError("cell", "a run that was asked to end did not end")


def _vehicle_unrenewed(desk: CommissionWorkplace, result: Result) -> None:
    """A vehicle that hears nothing any more stops by itself."""
    if not desk.config.vehicle.DRIVES:
        return
    desk.fold()
    vehicle, clock = desk.devices.vehicle, desk.devices.clock
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


def _laser(desk: CommissionWorkplace, result: Result) -> None:
    """The laser goes off with a stop, whoever holds it."""
    desk.confirm("laser", "laser goggles on, nobody looks into the beam", "half a second", "on and off")
    desk.brake()
    laser, clock = desk.devices.laser, desk.devices.clock
    with desk.devices.interlocks.purpose("test"), laser.lit():
        clock.sleep(0.2)
        begun = clock.now()
        desk.cell.stop()
        most = MOST_S * max(1.0, clock.rate)
        result.measure("laser, Cell.stop(): off after, at most", clock.now() - begun, "s", most=most)
        result.measure("laser on after a stop", float(laser.is_on), "", most=0.0)
    desk.cell.clear_stop(BY)


def _emergency(desk: CommissionWorkplace, result: Result) -> None:
    """A person stops the arm with the button while it turns; afterwards nothing goes on by itself."""
    arm, clock, simulated = desk.devices.arm, desk.devices.clock, desk.simulated
    desk.fold()
    desk.brake()
    _arm_moves(1.0, desk)
    clock.sleep(BEFORE_S)
    begun, before = clock.now(), _place(desk, "arm")
    cause = "emergency stop"
    if simulated:
        cause = "protective stop (simulated)"
        desk.cause("arm.protective_stop")
    elif not desk.person.does("Press the emergency stop now, while joint 1 turns."):
        desk.cell.stop()
        desk.cell.clear_stop(BY)
        result.notes.append("the emergency stop was not tried")
        return
    deadline = time.monotonic() + 5.0
    while arm.state().safety is ArmSafety.NORMAL and time.monotonic() < deadline:
        clock.sleep(PERIOD_S)
    stopped = arm.state().safety
    while float(np.abs(arm.state().joint_speeds).max()) > 1e-3 and time.monotonic() < deadline:
        clock.sleep(PERIOD_S)
    result.notes.append(f"after the {cause} the arm told: {stopped.value}")
    result.require(f"arm, {cause}: it told so", stopped is not ArmSafety.NORMAL)
    if simulated:
        most, way = MOST_S * max(1.0, clock.rate), math.degrees(abs(_place(desk, "arm") - before))
        result.measure(f"arm, {cause}: time to rest, at most", clock.now() - begun, "s", most=most)
        result.measure(f"arm, {cause}: way", way, "deg", most=MOST_WAY["arm"])
    result.require("a motion while it is stopped refused", refused(lambda: _arm_moves(1.0, desk).wait(1.0)))
    if desk.person.does("Release the button, look that all is well, and switch the arm on again at its pendant."):
        arm.recover(confirmed=True)
    desk.fold()


CHECKS = [
    CommissionCheck(
        "stops", "Stops: from each cause, time and way",
        "rail, joint 1 and wheels, one after the other, each stopped on its way; the laser",
        far="rail 20 mm, joint 1 6 deg, wheels 100 mm at most", fast="20 mm/s, 5 deg/s, 100 mm/s",
        limit=f"at rest within {MOST_S:g} s, {MOST_WAY['rail']:g} mm, {MOST_WAY['arm']:g} deg, "
        f"{MOST_WAY['vehicle']:g} mm",
        keys=("rail", "arm.model", "vehicle", "laser"), needs=("rail_limits", "vehicle", "outputs"), work=_stops,
        recorded=False,
    ),
]  # fmt: skip
