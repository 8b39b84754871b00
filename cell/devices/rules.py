"""The interlocks as a table: which commands each is asked for, what has to hold, and how that is looked up.

`python -m cell.devices.rules` prints the table of docs/interlocks.md; a test keeps that current.
"""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from cell.devices.gated_laser import UNATTENDED_S
from cell.devices.interlocks import PURPOSES, Command, Rule, Situation

PATIENCE_S = 1.0
"""How old a reading may be that a rule rests on: what it asks about does not change by itself."""
STILL = 0.005
"""Speed in m/s and rad/s below which the vehicle stands: its feedback has steps of 0.001."""
POSTURE_RAD = math.radians(2.0)
LOOK_M, LOOK_RAD = 0.03, math.radians(3.0)
"""How near the arm has to be to a transport pose. A looking pose is reckoned from the camera's mounting as configured
or as calibrated, which differ."""

MOVES = ("arm.move_joints", "arm.move_linear", "arm.follow")


def _parked(now: Situation, command: Command) -> str | None:
    if now.vehicle is None:
        return "the vehicle is not connected, so nobody knows whether it is parked. Open the cell with it"
    state = now.vehicle.state(PATIENCE_S)
    if max(abs(state.speed), abs(state.yaw_rate)) > STILL:
        return f"the vehicle drives at {state.speed:.3f} m/s, {state.yaw_rate:.3f} rad/s. Call vehicle.brake() first"
    if not state.braked:
        brake = "open" if state.braked is False else "not known to be locked"
        return f"the vehicle's brake is {brake}. Call vehicle.brake() first"
    return None


def _stowed(now: Situation, command: Command) -> str | None:
    if not any(command.arguments.values()):
        return None
    if now.arm is None:
        return "the arm is not connected, so nobody knows how it stands. Open the cell with it"
    state = now.arm.state(PATIENCE_S)
    if state.moving:
        return "the arm moves. Wait for its motion first"
    off = {name: float(np.abs(state.joints - posture).max()) for name, posture in now.postures.items()}
    if min(off.values()) <= POSTURE_RAD:
        return None
    flange = now.forward(state.joints)
    for look in now.looks.values():
        apart = look.inverse() * flange
        if np.linalg.norm(apart.translation) <= LOOK_M and np.linalg.norm(pin.log3(apart.rotation)) <= LOOK_RAD:
            return None
    nearest = min(off, key=lambda name: off[name])
    poses = ", ".join([*now.postures, *now.looks])
    return (
        f"the arm stands in no transport pose ({poses}): {math.degrees(off[nearest]):.1f} deg from {nearest}, allowed "
        f"{math.degrees(POSTURE_RAD):.0f} deg. Bring it there, with `cell home arm`"
    )


def _dark(now: Situation, command: Command) -> str | None:
    if any(command.arguments.values()) and now.laser is not None and now.laser.is_on:
        return "the laser is on. Switch it off first"
    return None


def _purpose(now: Situation, command: Command) -> str | None:
    if now.purpose is None:
        return f"nobody said what the laser is lit for. Light it inside interlocks.purpose(…): {', '.join(PURPOSES)}"
    return None


def _contact(now: Situation, command: Command) -> str | None:
    if now.claw is not None and not now.claw.holding:
        return None
    motion = now.last
    if motion is not None and motion.done and motion.contact:
        return None
    return (
        "the claw holds a part, and the arm's last motion did not end at contact, so the part would fall. Set it down "
        'with a force limit first; a person who holds it lifts this with maintenance(reason, lift=["claw_at_contact"])'
    )


def _calibrated(now: Situation, command: Command) -> str | None:
    if str(command) == "arm.follow" and command.arguments["force_limit"] is None:
        return None
    if now.calibrated is None:
        return "no calibration is in use. Do it in a job, or calibrate the cell with `cell calibrate`"
    if now.calibrated != now.configuration:
        return (
            f"the calibration in use was made under configuration {now.calibrated}, this cell is {now.configuration}. "
            "Calibrate it with `cell calibrate`"
        )
    return None


def _clear(now: Situation, command: Command) -> str | None:
    if now.arm is None:
        return None
    pairs = now.clear(now.arm.state(PATIENCE_S).joints, command)
    if not pairs:
        return None
    return f"{', '.join(f'{a} and {b}' for a, b in pairs)} would collide on the way. Go another way, or plan it"


def _own_switch(now: Situation, command: Command) -> str | None:
    index, value = command.arguments["index"], command.arguments["value"]
    owner = now.outputs.get(index)
    if owner is None or (owner == "laser" and not value):
        return None
    return f"output {index} is the {owner}'s. Use the {owner} itself, which has its own interlocks"


RULES = (
    Rule("vehicle_parked", (*MOVES, "laser.lit"), "the vehicle stands and its brake is locked", _parked),
    Rule(
        "arm_stowed",
        ("vehicle.drive",),
        "the arm is at rest in a transport pose: HOME, or the looking pose of the job that is run or named",
        _stowed,
    ),
    Rule("laser_off_to_drive", ("vehicle.drive",), "the laser is off", _dark),
    Rule("laser_purpose", ("laser.lit",), f"it was said what for: {', '.join(PURPOSES)}", _purpose),
    Rule(
        "claw_at_contact",
        ("claw.release",),
        "the arm's last motion ended at contact, or the claw shows no part; else on a person's word",
        _contact,
    ),
    Rule(
        "calibration_fits",
        ("rail.sweep", "arm.follow"),
        "a calibration of this cell as configured is in use (of `arm.follow`: with a force limit)",
        _calibrated,
    ),
    Rule(
        "way_clear",
        MOVES,
        "arm, tool, vehicle and the boards on the deck stay apart all the way; what touches already may",
        _clear,
    ),
    Rule(
        "own_switch",
        ("arm.set_digital_output",),
        "the output belongs to no other device; the laser's may be switched off",
        _own_switch,
    ),
    Rule(
        "laser_attended",
        ("laser.lit",),
        f"its owner renews it at least every {UNATTENDED_S:.0f} s on the wall; else it goes off by itself",
        None,
        liftable=False,
    ),
    Rule(
        "after_a_stop",
        (*MOVES, "arm.recover", "rail.home", "rail.move_to", "rail.sweep", "vehicle.enable", "vehicle.recover",
         "vehicle.drive", "laser.lit", "claw.grip", "claw.release"),
        "a new run has begun, or a person has said `Cell.clear_stop(by)`; work that was going on begins nothing more",
        None,
        liftable=False,
    ),
)  # fmt: skip


def markdown() -> str:
    """The table for people."""
    lines = ["| interlock | commands | condition | liftable |", "|---|---|---|---|"]
    for rule in RULES:
        commands = ", ".join(f"`{name}`" for name in rule.commands)
        lines.append(f"| `{rule.name}` | {commands} | {rule.condition} | {'yes' if rule.liftable else 'no'} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(markdown())
