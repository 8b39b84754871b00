"""Where the devices are and how they are, in lines of at most 80 columns, for `cell watch`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drivers.interfaces import ArmState, RailState, VehicleState

LABEL = 9
NEAR_DEG = 5.0
"""A joint that is nearer to its limit is marked."""


def arm_lines(state: ArmState | None, limits: tuple[Sequence[float], Sequence[float]], why: str = "") -> list[str]:
    """The arm's safety state, its flange (mm, deg of the rotation vector, arm base), joints beside `limits` in rad."""
    if state is None:
        return [f"{'arm':<{LABEL}}{why or 'tells nothing'}"]
    moves = "moves" if state.moving else "stands"
    control = "" if state.controlled else ", no control program"
    position = "  ".join(f"{axis} {1e3 * v:.1f}" for axis, v in zip("xyz", state.flange[:3], strict=True))
    turn = "  ".join(f"{np.degrees(v):.1f}" for v in state.flange[3:])
    joints, low, high = (np.degrees(np.asarray(v)) for v in (state.joints, *limits))
    near = np.minimum(joints - low, high - joints) < NEAR_DEG
    values = "".join(f"{v:>10.2f}{'!' if n else ' '}" for v, n in zip(joints, near, strict=True))
    return [
        f"{'arm':<{LABEL}}safety {state.safety.value}, {moves}{control}",
        f"{'':<{LABEL}}flange {position} mm  rotation {turn} deg",
        f"{'  joint':<{LABEL}}" + "".join(f"{f'j{k}':>10} " for k in range(1, 7)),
        f"{'  deg':<{LABEL}}{values}",
        f"{'  limits':<{LABEL}}" + "".join(f"{f'{a:.0f}…{b:.0f}':>10} " for a, b in zip(low, high, strict=True)),
        f"{'  pins':<{LABEL}}inputs {state.digital_inputs:#06x}   outputs {state.digital_outputs:#06x}",
    ]


def rail_lines(state: RailState | None, travel: tuple[float, float], why: str = "") -> list[str]:
    """The rail's place in its travel (m) and its switches."""
    low, high = (1e3 * v for v in travel)
    if state is None:
        return [f"{'rail':<{LABEL}}{why or 'tells nothing'}"]
    homed = "homed" if state.homed else "NOT HOMED"
    left, right = ("pressed" if pressed else "free" for pressed in (state.left_switch, state.right_switch))
    return [
        f"{'rail':<{LABEL}}{homed}, {'moves' if state.moving else 'stands'} at {1e3 * state.position:.3f} mm, "
        f"travel {low:.0f} to {high:.0f} mm",
        f"{'':<{LABEL}}switches: left {left}, right {right}",
    ]


def vehicle_lines(state: VehicleState | None, why: str = "") -> list[str]:
    """The vehicle's brake, speed, emergency stop and what troubles it."""
    if state is None:
        return [f"{'vehicle':<{LABEL}}{why or 'tells nothing'}"]
    brake = {None: "brake not known", True: "braked", False: "brake open"}[state.braked]
    stop = "EMERGENCY STOP" if state.emergency_stop else "no emergency stop"
    volts = "" if state.battery_volts is None else f", {state.battery_volts:.1f} V"
    speed = f"{1e3 * state.speed:.0f} mm/s, {np.degrees(state.yaw_rate):.1f} deg/s"
    first = f"{'vehicle':<{LABEL}}{brake}, {stop}, {speed}{volts}"
    return [first, *(f"{'':<{LABEL}}{trouble}" for trouble in (*state.trouble, *state.warnings))]
