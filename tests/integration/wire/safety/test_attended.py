"""A motion that somebody attends ends within 250 ms of their silence, of a frozen and of a killed program: by what the
simulated arm and carriage themselves know."""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest

from drivers.clock import Clock
from sim_backends.clock import WorldClock
from sim_backends.models.rail import RailModel, RailParams
from sim_backends.peers.rail.tmcl import TmclPeer
from tests.support.wire.arm_bench import ArmBench

pytestmark = pytest.mark.wire

WITHIN_S = 0.25
ATTENDING = """
import sys, threading
import numpy as np
from drivers.arm.ur import UrArm
from drivers.rail.tmcl.make import TmclRailConfig
from drivers.rail.tmcl.rail import TmclRail
from drivers.clock import Clock
from drivers.common.units import KEPT
from drivers.errors import CellError
clock = Clock()
arm = UrArm("arm", sys.argv[1], clock=clock)
record = dict(url=sys.argv[2], lead=0.002, steps_per_turn=200, microsteps=256, travel=(0.0, 0.1), max_speed=0.04,
              acceleration=0.2)
rail = TmclRail("rail", TmclRailConfig.model_validate(record, context=KEPT), clock=clock)
rail.home().wait(60.0)
print("ready", flush=True)
for line in sys.stdin:
    beats = int(line)
    start = arm.state().joints
    goal = start + (0.5 if start[0] < 0.3 else -0.5) * np.eye(6)[0]
    far = 0.09 if rail.state().position < 0.05 else 0.01
    with arm.attended() as arm_beat, rail.attended() as rail_beat:
        if not beats:
            clock.sleep(0.4)
        motions = arm.move_joints(goal, 0.2, 1.0), rail.move_to(far, 0.008)
        for _ in range(beats):
            arm_beat()
            rail_beat()
            clock.sleep(0.08)
        print("silent", flush=True)
        clock.sleep(0.35)
        arm.stop()
        rail.stop()
        clock.sleep(0.1)
        print(*(motion.done for motion in motions), int(rail.state().homed), flush=True)"""


class Bench:
    """A program that attends motions of a simulated arm and rail, and what these know of themselves."""

    def __init__(self, arm: ArmBench, rail: RailModel, world: WorldClock, program: subprocess.Popen[str]) -> None:
        self.arm, self.rail, self.world, self.program = arm, rail, world, program

    def say(self, beats: int) -> None:
        """Have it begin both motions, and attend them for so many beats of 80 ms; for none after a silence."""
        assert self.program.stdin is not None
        self.program.stdin.write(f"{beats}\n")
        self.program.stdin.flush()

    def hear(self) -> str:
        """The next that it prints."""
        assert self.program.stdout is not None
        return self.program.stdout.readline().strip()

    def moving(self) -> tuple[bool, bool]:
        return bool(self.arm.ask("show")["moving"]), self.rail.velocity(self.world.now()) != 0

    def stands_after(self, since: float) -> tuple[float, float]:
        """Wall seconds from `since` until arm and carriage stand."""
        stood = [np.inf, np.inf]
        while time.monotonic() < since + 1.0 and not np.all(np.isfinite(stood)):
            for which, moves in enumerate(self.moving()):
                stood[which] = np.inf if moves else min(stood[which], time.monotonic() - since)
            Clock().sleep(0.002)
        return stood[0], stood[1]


@pytest.fixture
def bench() -> Iterator[Bench]:
    world = WorldClock(1.0)
    rail = RailModel(RailParams(), np.random.default_rng(0))
    peer = TmclPeer(rail, world, pty=True)
    peer.start()
    with ArmBench() as arm:
        program = subprocess.Popen(
            [sys.executable, "-c", ATTENDING, arm.address, peer.url],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            made = Bench(arm, rail, world, program)
            assert made.hear() == "ready"
            yield made
        finally:
            program.send_signal(signal.SIGCONT)
            program.kill()
            program.communicate()
            peer.stop()


def test_arm_and_rail_stand_soon_after_silence_and_after_the_program_froze(bench: Bench):
    bench.say(10)
    Clock().sleep(0.7)
    assert bench.moving() == (True, True)
    assert bench.hear() == "silent"
    # The last beat was 80 ms before.
    assert max(bench.stands_after(time.monotonic() - 0.08)) < WITHIN_S
    # The program is told, and the rail has kept its zero.
    assert bench.hear() == "True True 1"
    # What begins only after a silence ends as soon.
    bench.say(0)
    assert bench.hear() == "silent"
    assert max(bench.stands_after(time.monotonic())) < WITHIN_S
    assert bench.hear() == "True True 1"
    _end(bench, signal.SIGSTOP)


@pytest.mark.campaign
def test_arm_and_rail_stand_soon_after_the_program_was_killed(bench: Bench):
    _end(bench, signal.SIGKILL)


def _end(bench: Bench, by: signal.Signals) -> None:
    bench.say(1000)
    Clock().sleep(0.7)
    assert bench.moving() == (True, True)
    bench.program.send_signal(by)
    assert max(bench.stands_after(time.monotonic())) < WITHIN_S
