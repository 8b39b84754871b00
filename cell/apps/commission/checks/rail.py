"""The rail: which way and how far it goes, seen by its camera; then its zero, its ends and its limits."""

import math
from functools import partial

import numpy as np

from cell.apps.commission.check import CommissionCheck, Result, refused
from cell.apps.commission.measuring import centred_view, eye_of, see
from cell.apps.commission.workplace import CommissionWorkplace
from drivers.errors import DeviceFault, LimitError, RefusedError
from drivers.interfaces import Nudged, Vector
from drivers.make import RailConfig

STEP, FIRST_STEP = 0.005, 0.001
SPEED = 0.005
MOST_SIDEWAYS = math.radians(15.0)
LEAD_OFF = 0.05
"""By how much, relative, the way may differ from what was commanded: a rough view tells no more."""
SCREWS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0, 25.0, 40.0, 50.0)
"""Leads that are sold, mm."""
SLOW = 0.020
BEYOND = 0.006
"""How far beyond an end of the travel its limit switch is looked for, m."""


def _direction(workplace: CommissionWorkplace, result: Result) -> None:
    rail = workplace.devices.rail
    eye = eye_of(workplace, "scan_camera")
    if not _nudged(workplace) and not rail.state().homed_here:
        workplace.fold()
        # The zero of a rail whose direction nobody has seen: a person watches it.
        workplace.confirm(
            "rail", "it searches its home switch; watch whether it goes towards that, and stop it if not",
            "its whole travel at most", "half its configured speed",
        )  # fmt: skip
        workplace.devices.rail.home().wait(120.0)
        if not workplace.person.sees("Did the carriage go to its home switch and stop there?"):
            raise RefusedError("the rail did not go to its home switch: have its drive turn the motor the other way")
    first = centred_view(workplace, result, eye)
    workplace.keep(result, "rail-before", first.frame, first.view.pixels)
    state = rail.state()
    step = -1.0 if state.right_switch and not state.left_switch else 1.0
    workplace.confirm(
        "rail", "the carriage, away from its switches", "1 mm, then 5 mm, and back", f"{1e3 * SPEED:.0f} mm/s"
    )
    told, moved = 0.0, np.zeros(3)
    for way in (FIRST_STEP, STEP):
        _nudge(workplace, step * (way - abs(told)))
        told = step * way
        try:
            then = see(workplace, eye)
        except RefusedError:
            break
        workplace.keep(result, "rail-after", then.frame, then.view.pixels)
        # The board stands, so the camera has gone the other way.
        moved = first.camera_from_board.translation - then.camera_from_board.translation
        reached = told
    _nudge(workplace, -told)
    if not moved.any():
        raise RefusedError(
            f"after 1 mm of the rail the camera does not see the board any more: the carriage goes much farther than "
            f"it is told. Look at rail.lead {1e3 * workplace.config.rail.lead:g} mm and at the motor's steps per turn"
        )
    way, along = float(np.linalg.norm(moved)), float(moved[0])
    result.measure("commanded", 1e3 * reached, "mm")
    result.measure("the camera went, along its x axis", 1e3 * along, "mm")
    result.measure("the camera went, in all", 1e3 * way, "mm")
    judge(workplace.config.rail, result, reached, moved)


def judge(rail: RailConfig, result: Result, told: float, moved: Vector) -> None:
    """What the camera's way (3,) in its own axes says of a rail that was told to go `told`, both in m. Raises
    `RefusedError` when it did not move."""
    way = float(np.linalg.norm(moved))
    if way < 0.05 * abs(told):
        raise RefusedError(
            f"the rail counted {1e3 * told:.2f} mm and the camera moved {1e3 * way:.2f} mm: see that the motor has "
            "current, that the coupling holds, and that the camera rides on the carriage"
        )
    ahead = moved[0] * np.sign(told) > 0.0
    aslant = math.acos(min(1.0, abs(moved[0]) / way))
    result.measure(
        "way against the camera's x axis", math.degrees(aslant), "deg", most=math.degrees(MOST_SIDEWAYS),
        remedy="The camera is turned on the carriage: turn it so that its rows lie along the rail.",
    )  # fmt: skip
    if not ahead and aslant < MOST_SIDEWAYS:
        now = bool(getattr(rail, "reversed", False))
        result.find(
            "rail.reversed", "the carriage goes the other way than it is told: the rail's direction is reversed",
            f"+{1e3 * abs(told):.1f} mm", f"{1e3 * moved[0] * np.sign(told):+.1f} mm along the camera's x axis",
            "Have the module turn the motor the other way, or swap the two wires of one of its coils. If it was "
            "seen by eye to go away from its home switch, the camera sits upside down on the carriage instead.",
            write={"rail.reversed": str(not now).lower()} if hasattr(rail, "reversed") else {},
        )  # fmt: skip
    ratio = way / abs(told)
    if abs(ratio - 1.0) > LEAD_OFF:
        lead = rail.lead * ratio
        sold = min(SCREWS, key=lambda mm: abs(math.log(1e-3 * mm / lead)))
        value = 1e-3 * sold if abs(1e-3 * sold / lead - 1.0) < 0.04 else lead
        result.find(
            "rail.lead", f"the carriage goes {ratio:.2f} times as far as it is told",
            f"{1e3 * rail.lead:g} mm a turn", found=f"{1e3 * lead:.2f} mm a turn",
            remedy="Read the lead on the screw; steps per turn (motor) and microsteps (module) count as well.",
            write={"rail.lead": f'"{1e3 * value:.4g} mm"'},
        )  # fmt: skip


def _nudged(workplace: CommissionWorkplace) -> bool:
    """Whether this make of rail moves by a little before it is homed."""
    rail = workplace.devices.rail
    return isinstance(getattr(rail, "bare", rail), Nudged)


def _nudge(workplace: CommissionWorkplace, way: float) -> None:
    """By a little; a make that moves only when it is homed has been homed."""
    rail, speed = workplace.devices.rail, min(SPEED, workplace.config.rail.max_speed)
    if abs(way) < 1e-6:
        return
    if _nudged(workplace):
        assert isinstance(rail, Nudged)
        rail.nudge(way, speed).wait(30.0)
    else:
        rail.move_to(rail.state().position + way, speed).wait(30.0)


def _limits(workplace: CommissionWorkplace, result: Result) -> None:
    rail, config, clock = workplace.devices.rail, workplace.config.rail, workplace.devices.clock
    low, high = config.travel
    workplace.fold()
    workplace.confirm("rail", "it searches its home switch", "its whole travel at most", "half its configured speed")
    begun = clock.now()
    rail.home().wait(120.0)
    result.measure("home switch found after", clock.now() - begun, "s")
    state = rail.state()
    result.measure("position after homing", 1e3 * state.position, "mm", least=-0.5, most=0.5)
    speed = min(SLOW, config.max_speed)
    for name, end in (("low", low), ("high", high)):
        rail.move_to(end, speed).wait(3.0 * (high - low) / speed + 20.0)
        state = rail.state()
        here, mm = 1e3 * state.position, 1e3 * end
        result.measure(f"{name} end of the travel reached at", here, "mm", least=mm - 0.05, most=mm + 0.05)
        hit = state.left_switch or state.right_switch
        remedy = "Shorten rail.travel, so that its ends keep off the switches."
        result.measure(f"limit switches active at the {name} end", float(hit), "", most=0.0, remedy=remedy)

    def go(place: float) -> None:
        rail.move_to(place, speed).wait(10.0)

    kept = sum(refused(partial(go, beyond), LimitError) for beyond in (low - 0.001, high + 0.001))
    result.measure("commands 1 mm beyond an end refused", kept, "of 2", least=2.0)
    _switches(workplace, result, speed)
    rail.move_to(0.5 * (low + high), speed).wait(60.0)


def _switches(workplace: CommissionWorkplace, result: Result, speed: float) -> None:
    """Slowly beyond each end of the travel, until its limit switch stops the carriage; then the zero is found anew."""
    rail, (low, high) = workplace.devices.rail, workplace.config.rail.travel
    if not _nudged(workplace):
        result.notes.append("this rail moves only within its travel: press its limit switches by hand")
        return
    registers = getattr(workplace.config.rail, "registers", None)
    if registers is not None and None in (registers.left_switch, registers.right_switch):
        result.notes.append("rail.registers does not say where the drive tells its limit switches: press them by hand")
        return
    workplace.confirm(
        "rail, beyond its travel", "the carriage, until a limit switch stops it", f"at most {1e3 * BEYOND:.0f} mm",
        f"{1e3 * SPEED:.0f} mm/s",
    )  # fmt: skip
    for name, end, way in (("left", low, -BEYOND), ("right", high, BEYOND)):
        if not rail.state().homed_here:
            rail.home().wait(120.0)
        rail.move_to(end, speed).wait(3.0 * (high - low) / speed + 20.0)
        code = ""
        try:
            _nudge(workplace, way)
        except DeviceFault as fault:
            code = fault.code
            if code == "rail.switches":
                result.find(
                    code, fault.message, f"the {name} limit switch at the {name} end", "that of the other end",
                    "Swap the wires of the two limit switches at the module: as they are, neither stops the "
                    "carriage before the end of the rail.",
                )  # fmt: skip
                _nudge(workplace, -way)
                return
        state = rail.state()
        hit = state.left_switch if name == "left" else state.right_switch
        result.require(
            f"{name} limit switch stops the carriage", hit and code == "rail.limit_switch",
            f"No switch stopped it within {1e3 * BEYOND:.0f} mm: see the switch, its wire, and that it is on.",
        )  # fmt: skip
        _nudge(workplace, -way)
    rail.home().wait(120.0)


CHECKS = [
    CommissionCheck(
        "rail_direction", "Rail: which way and how far it goes, seen by its camera",
        "the carriage, before it was ever homed", far="1 mm, then 5 mm, and back", fast="5 mm/s",
        limit="along the camera's x axis within 15 deg, and as far as told within 5 %",
        keys=("rail", "scan_camera", "calibration.fine"), needs=("scan_mounting",), work=_direction,
    ),
    CommissionCheck(
        "rail_limits", "Rail: home switch, ends of the travel, limits",
        "the carriage", far="its whole travel, and 6 mm beyond each end",
        fast="half of rail.max_speed to its switch, then 20 and 5 mm/s",
        limit="home found; both ends reached without a switch; commands beyond refused; limit switches stop it",
        keys=("rail",), needs=("rail_direction",), work=_limits,
    ),
]  # fmt: skip
