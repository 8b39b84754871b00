"""A process that is killed or frozen leaves nothing moving and no light on: by the simulated world's truth."""

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from drivers.clock import Clock
from tests.support import until
from tests.support.wire import cells
from tests.support.wire.cells import ask

pytestmark = pytest.mark.wire

OPEN = """
import sys
from pathlib import Path
from cell.devices import assembly
from cell.config.cell_config import load_config
from drivers.clock import Clock
config = load_config(Path("sim.toml"))
clock = Clock(config.cell.time_scale)"""
DRIVE = """
vehicle = assembly.connect_one(config, "vehicle", clock)
vehicle.enable()
while True:
    vehicle.drive(0.3, 0.0)
    clock.sleep(0.05)"""
MOVE = """
rail = assembly.connect_one(config, "rail", clock)
rail.home().wait(60.0)
rail.move_to(0.09, 0.01).wait(60.0)
clock.sleep(1e6)"""
SEARCH = """
rail = assembly.connect_one(config, "rail", clock)
rail.home()
clock.sleep(1e6)"""
LIT_ARM = """
arm = assembly.connect_one(config, "arm", clock)
laser = assembly.connect_one(config, "laser", clock, arm=arm)
joints = arm.state().joints.copy()
joints[0] += 2.0
with laser.lit():
    arm.move_joints(joints, 0.2, 1.0).wait(60.0)"""
LIT = """
arm = assembly.connect_one(config, "arm", clock)
laser = assembly.connect_one(config, "laser", clock, arm=arm)
with laser.lit():
    clock.sleep(1e6)"""
ALL = """
rail = assembly.connect_one(config, "rail", clock)
vehicle = assembly.connect_one(config, "vehicle", clock)
arm = assembly.connect_one(config, "arm", clock)
laser = assembly.connect_one(config, "laser", clock, arm=arm)
rail.home().wait(60.0)
vehicle.enable()
joints = arm.state().joints.copy()
joints[0] += 2.0
with laser.lit():
    rail.move_to(0.09, 0.01)
    arm.move_joints(joints, 0.2, 1.0)
    while True:
        vehicle.drive(0.3, 0.0)
        clock.sleep(0.05)"""
FROZEN = {DRIVE: "vehicle.owner_frozen", MOVE: "rail.owner_frozen", LIT_ARM: "arm.owner_frozen"}
"""The fault that the process is told once it runs again."""
Truth = dict[str, Any]


def drives(truth: Truth) -> bool:
    return bool(truth["vehicle"]["speed"] > 0.2)


def rail_moves(truth: Truth) -> bool:
    return bool(truth["rail_moving"] and truth["rail"]["carriage"] > 0.001)


def lit_arm_moves(truth: Truth) -> bool:
    return bool(truth["arm"]["moving"] and truth["laser_on"])


serving = cells.serving("--seed", "3", "--speed", "1")
"""At the wall's speed: the vehicle's own watchdog would only begin to stop it after half a second."""


@pytest.mark.parametrize(
    ("how", "script", "moving"),
    [
        (signal.SIGKILL, ALL, lambda truth: drives(truth) and rail_moves(truth) and lit_arm_moves(truth)),
        (signal.SIGKILL, SEARCH, lambda truth: truth["rail_moving"]),
        # Of an arm at rest no program ends, with which the controller would switch the laser off by itself.
        (signal.SIGKILL, LIT, lambda truth: truth["laser_on"]),
        (signal.SIGSTOP, LIT, lambda truth: truth["laser_on"]),
        (signal.SIGSTOP, DRIVE, drives),
        (signal.SIGSTOP, MOVE, rail_moves),
        (signal.SIGSTOP, LIT_ARM, lit_arm_moves),
    ],
    ids=["all killed", "rail killed as it searches its switch", "laser alone killed", "laser alone frozen",
         "vehicle frozen", "rail frozen", "arm and laser frozen"],
)  # fmt: skip
def test_half_a_second_after_the_last_sign_of_life_all_is_safe(
    serving: tuple[Path, dict[str, Any]], how: signal.Signals, script: str, moving: Callable[[Truth], bool]
):
    folder, endpoints = serving
    # Someone may have been killed here before: nothing may be on its way already.
    assert not moving(ask(endpoints, op="truth")["truth"])
    owner = subprocess.Popen([sys.executable, "-c", OPEN + script], cwd=folder, stderr=subprocess.PIPE, text=True)
    try:
        assert until(lambda: owner.poll() is not None or moving(ask(endpoints, op="truth")["truth"]), 60.0)
        assert owner.poll() is None
        owner.send_signal(how)
        Clock().sleep(0.5)
        truth = ask(endpoints, op="truth")["truth"]
        if how == signal.SIGSTOP and script in FROZEN:
            owner.send_signal(signal.SIGCONT)
            assert FROZEN[script] in owner.communicate(timeout=20)[1].splitlines()[-1]
    finally:
        owner.kill()
        owner.communicate(timeout=10)
    assert truth["vehicle"]["stopped"]
    assert truth["vehicle"]["braked"] or script not in (ALL, DRIVE)
    assert not truth["rail_moving"] and not truth["arm"]["moving"] and not truth["laser_on"]
