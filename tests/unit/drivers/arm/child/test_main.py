"""Promises of `drivers.arm.child.main`."""

import json
import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from drivers.arm.child.outputs import Packets
from drivers.arm.ur import UrArm
from drivers.clock import Clock
from drivers.errors import NotConnectedError
from tests.support import running
from tests.support.wire.arm_bench import joints_away, keep_outputs, soon

pytestmark = pytest.mark.wire

LASER = 0


OWNER = """
import json, sys, threading
from drivers.arm.ur import UrArm
from drivers.clock import Clock
arm = UrArm("arm", sys.argv[1], safe_off_outputs=(0,), clock=Clock())
arm.set_digital_output(0, True)
with arm.trying(1):
    pass
arm.set_digital_output(1, True)
trial = arm.trying(2)
trial.__enter__()
arm.set_digital_output(2, True)
joints = arm.state().joints
joints[0] += 2.0
arm.move_joints(joints, 0.5, 2.0)
print(json.dumps({"child": arm._session.link.pid}), flush=True)
threading.Event().wait(60)"""


@pytest.mark.parametrize("way", [signal.SIGKILL, signal.SIGTERM])
def test_when_the_owner_dies_the_laser_goes_off_the_arm_stops_and_the_child_ends(bench, way):
    with owned(bench) as (owner, child):
        keep_outputs(bench)
        owner.send_signal(way)
        assert soon(lambda: not bench.ask("show")["moving"])
        laser_and_tried_off_claw_closed(bench)
        assert soon(lambda: not running(child))


def test_when_the_owner_and_its_child_die_the_controller_switches_off_what_was_tried(bench):
    with owned(bench) as (owner, child):
        owner.send_signal(signal.SIGSTOP)
        os.kill(child, signal.SIGKILL)
        owner.kill()
        laser_and_tried_off_claw_closed(bench)


def laser_and_tried_off_claw_closed(bench):
    assert soon(lambda: bench.ask("show")["outputs"] & 0b111 == 0b010), "the trial of the claw's output is over"


@contextmanager
def owned(bench):
    """A process that moves the arm with its laser on, its claw closed and a third output tried; and its child's id."""
    owner = subprocess.Popen(
        [sys.executable, "-c", OWNER, bench.address],
        stdout=subprocess.PIPE,
        env=dict(os.environ, PYTHONPATH=os.pathsep.join(path or "." for path in sys.path)),
    )
    assert owner.stdout is not None
    child = json.loads(owner.stdout.readline())["child"]
    assert bench.ask("show")["outputs"] & 0b111 == 0b111
    assert soon(lambda: bench.ask("show")["moving"])
    yield owner, child
    owner.communicate(timeout=10)


def test_close_leaves_the_laser_off_and_no_process_and_may_be_repeated(bench):
    arm = UrArm("arm", bench.address, safe_off_outputs=(LASER,), clock=Clock())
    arm.set_digital_output(LASER, True)
    keep_outputs(bench)
    child = arm._session.link.pid
    arm.close()
    arm.close()
    assert not bench.ask("show")["outputs"] & 1 << LASER
    assert not running(child)
    with pytest.raises(NotConnectedError, match="was closed"):
        arm.state()
    with pytest.raises(NotConnectedError, match="was closed"):
        arm.move_joints(np.zeros(6), 1.0, 1.0)


def test_a_child_that_waits_is_woken_by_packets_and_not_ten_thousand_times_a_second(arm):
    before = woken(arm._session.link.pid)
    Clock().sleep(0.4)
    assert 200 < woken(arm._session.link.pid) - before < 0.4 * 4500


def test_a_child_starts_without_numpy_which_would_take_as_long_as_all_else(arm):
    assert "numpy" not in Path(f"/proc/{arm._session.link.pid}/maps").read_text()


def test_of_states_that_have_piled_up_the_newest_counts(bench):
    packets = Packets(bench.address, switches=False)
    Clock().sleep(0.1)
    before = bench.ask("show")["time"]
    assert packets.read().device_time > before - 0.01


def woken(process):
    """How often threads of the process have waited so far."""
    told = (path.read_text() for path in Path(f"/proc/{process}/task").glob("*/status"))
    return sum(int(text.rpartition("\nvoluntary_ctxt_switches:")[2].split()[0]) for text in told)


# Last: it takes the arm for the shared driver.
def test_ctrl_c_does_not_reach_the_child(arm):
    os.kill(arm._session.link.pid, signal.SIGINT)
    arm.move_joints(joints_away(arm, -0.02), 1.0, 2.0).wait(5.0)
