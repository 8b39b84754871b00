"""A simulated arm in a process of its own for the tests of the arm driver, above a stiff table if asked.

Commands come on standard input, one a line, and are answered by one JSON line each: the name of a fault or
`late_states`, `clear` (its cause is gone), `reset` (as after switching on), `input INDEX 0|1`, `output INDEX 0|1`, or
`show` for what the arm itself knows.
"""

import json
import os
import signal
import socket
import struct
import subprocess
import sys
from contextlib import contextmanager

import numpy as np

from drivers.arm.feed import Snapshot
from drivers.clock import Clock
from sim_backends.clock import WorldClock
from sim_backends.models.arm import ArmModel, ArmParams
from sim_backends.models.arm_kinematics import TABLES
from sim_backends.peers.arm.rtde.server import RtdePeer
from tests.support import until

STIFFNESS = 2e4
HOME = np.radians([0.0, -90.0, -90.0, -90.0, 90.0, 0.0])


class ArmBench:
    """Starts the process; `address` is where the arm answers. To be used as a context."""

    def __init__(
        self, *, speed: float = 1.0, table: float | None = None, model: str = "UR10e",
        factory: np.ndarray | None = None, unlock_delay: float = 0.3,
    ) -> None:  # fmt: skip
        """`factory` (6, 4) is what the controller's table is off the maker's: a, d, alpha, joint offset."""
        given = (speed, table, model, None if factory is None else factory.tolist(), unlock_delay)
        arguments = [json.dumps(value) for value in given]
        self.process = subprocess.Popen(
            [sys.executable, __file__, *arguments],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env=dict(os.environ, PYTHONPATH=os.pathsep.join(path or "." for path in sys.path)),
        )  # fmt: skip
        self.address = self._line()["address"]

    def __enter__(self) -> "ArmBench":
        return self

    def __exit__(self, *error: object) -> None:
        self.process.send_signal(signal.SIGCONT)
        self.process.kill()
        self.process.communicate(timeout=10)

    def ask(self, command: str) -> dict:
        """Send one command and return its answer."""
        assert self.process.stdin is not None
        self.process.stdin.write(command + "\n")
        self.process.stdin.flush()
        return self._line()

    def kill(self) -> None:
        """End the arm as a power loss would."""
        self.process.kill()
        self.process.wait(10)

    def _line(self) -> dict:
        assert self.process.stdout is not None
        return json.loads(self.process.stdout.readline())


def soon(condition, seconds=3.0):
    """Whether something happens within so many seconds."""
    return until(condition, seconds)


def stand_at_home(arm):
    assert soon(lambda: np.abs(arm.state().joints - HOME).max() < 1e-9)
    arm.move_joints(HOME, 1.0, 1.0).wait(5.0)


def dashboard(address, *commands):
    """The answers of the arm's dashboard, or its greeting where nothing is asked."""
    with socket.create_connection((address, 29999), timeout=5.0) as connection:
        lines = connection.makefile("r")
        answers = [lines.readline().strip()]
        for command in commands:
            connection.sendall(command.encode() + b"\n")
            answers.append(lines.readline().strip())
    return answers[1:] if commands else answers


@contextmanager
def held_input(address, name):
    """Another client that has taken this input of the controller for itself."""
    with socket.create_connection((address, 30004), timeout=5.0) as link:
        link.sendall(struct.pack(">HBH", 5, ord("V"), 2) + struct.pack(">HB", 3 + len(name), ord("I")) + name)
        # The reply to V, and the head of that to I.
        got = b""
        while len(got) < 4 + 4:
            got += link.recv(64)
        yield


def _table(height: float):
    def contact(base_from_flange):
        depth = height - base_from_flange[2, 3]
        return np.array([0.0, 0.0, max(0.0, STIFFNESS * depth), 0.0, 0.0, 0.0])

    return contact


def _main(speed: float, table: float | None, name: str, factory: list[list[float]] | None, unlock_delay: float) -> None:
    clock = WorldClock(speed)
    dh = TABLES[name] + (0.0 if factory is None else np.array(factory))
    params = ArmParams.of(name, dh=dh, unlock_delay=unlock_delay, force_noise=(0.2, 0.02))
    model = ArmModel(params, np.random.default_rng(0), clock)
    if table is not None:
        model.contact = _table(table)
    peer = RtdePeer(model, clock)
    peer.start()
    print(json.dumps({"address": peer.address}), flush=True)
    for line in sys.stdin:
        answer: dict[str, object] = {}
        match line.split():
            case ["reset"]:
                model.clear()
                model.halt()
                model.drive.q, model.drive.qd = model.params.initial_q.copy(), np.zeros(6)
                model.write_digital_outputs(-1, 0)
            case ["input", index, value]:
                model.set_digital_input(int(index), value == "1")
            case ["output", index, value]:
                model.write_digital_outputs(1 << int(index), int(value) << int(index))
            case ["clear"]:
                model.clear()
                peer.clear()
            case ["show"]:
                answer = {
                    "outputs": model.digital_outputs, "moving": model.moving, "q": model.drive.q.tolist(),
                    "time": model.time, "fault": model.fault_text, "payload": model.payload[0],
                    "speed": model.drive.speed_fraction, "tcp": model.drive.flange_from_tcp.tolist(),
                }  # fmt: skip
            case ["late_states"]:
                peer.fault("arm.late_states")
            case [fault]:
                model.fault(fault)
        print(json.dumps(answer), flush=True)
    peer.stop()


def joints_away(arm, radians):
    return arm.state().joints + np.array([radians, 0, 0, 0, 0, 0])


def swing(arm, radians, seconds):
    """Times and joints of a smooth turn of the first joint from where the arm stands."""
    times = np.linspace(0.0, seconds, int(seconds / 0.008) + 2)
    part = 0.5 * (1.0 - np.cos(np.pi * times / seconds))
    return times, arm.state().joints + part[:, None] * np.array([radians, 0, 0, 0, 0, 0])


def snapshot(stamp, **shown):
    """A state packet of an arm that stands, at `stamp`, but for what is `shown`."""
    still = (0.0,) * 6
    usual = {"safety_bits": 1, "mode": 7, "runtime": 2, "inputs": 0, "outputs": 0}
    return Snapshot(stamp, still, still, still, still, **usual | shown)


def keep_outputs(bench):
    """Have the controller keep the laser's output when no program runs, so that only the driver can switch it off."""
    with socket.create_connection((bench.address, 30002), timeout=5.0) as connection:
        connection.sendall(
            b"sec keep():\n"
            + b"".join(b"  set_runstate_standard_digital_output_to_value(%d, 0)\n" % k for k in (0, 2))
            + b"end\n"
        )
        connection.recv(4096)
        Clock().sleep(0.05)


if __name__ == "__main__":
    _main(*map(json.loads, sys.argv[1:]))
