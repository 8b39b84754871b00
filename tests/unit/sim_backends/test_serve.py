"""The served simulated cell: one command, clean ends, and several at once. Drivers speak with its devices elsewhere."""

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from sim_backends import serve
from sim_backends.clock import SteppedClock
from sim_backends.serve import main
from sim_backends.world.world import World

pytestmark = pytest.mark.wire


class Served:
    """A simulated cell in a process of its own."""

    def __init__(self, *options: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "sim_backends.serve", "--json", "--exit-with-stdin", *options],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self.process.stdout is not None
        self.endpoints: dict[str, Any] = json.loads(self.process.stdout.readline())

    def ask_truth(self, **request: Any) -> dict[str, Any]:
        host, port = self.endpoints["truth"]["address"].split(":")
        with socket.create_connection((host, int(port)), 5.0) as connection:
            connection.sendall(json.dumps(request).encode() + b"\n")
            reply: dict[str, Any] = json.loads(connection.makefile().readline())
        return reply

    def end(self, number: signal.Signals | None = None) -> tuple[int, str]:
        """Send it a signal, or close its input; exit code and what it wrote to stderr."""
        if number is not None:
            self.process.send_signal(number)
            self.process.wait(15)
        _, error = self.process.communicate(timeout=15)
        return self.process.returncode, error


@pytest.fixture(scope="module")
def pair() -> Iterator[tuple[Served, Served]]:
    a = Served("--seed", "3")
    b = Served("--seed", "4", "--surface", "seat", "--level", "ideal", "--speed", "2")
    yield a, b
    for served in (a, b):
        served.process.kill()
        served.process.communicate(timeout=15)


@pytest.fixture
def served(pair: tuple[Served, Served]) -> Served:
    return pair[0]


def test_two_cells_share_no_endpoint_and_no_world(pair: tuple[Served, Served]):
    a, b = (served.endpoints for served in pair)
    for device in ("arm", "rail", "vehicle", "scan_camera", "target_camera", "truth"):
        assert set(a[device].values()) - {"slcan"} != set(b[device].values()) - {"slcan"}, device
    truths = [served.ask_truth(op="truth")["truth"] for served in pair]
    assert [t["seed"] for t in truths] == [3, 4]
    assert [t["surface"]["name"] for t in truths] == ["pot", "seat"]
    assert truths[0]["poses"]["world_from_surface"] != truths[1]["poses"]["world_from_surface"]


def test_faults_are_caused_and_taken_away_over_the_truth_endpoint(served: Served):
    assert served.ask_truth(op="fault", name="arm.protective_stop")["ok"]
    assert served.ask_truth(op="truth")["truth"]["arm"]["safety"] == "protective_stop"
    assert served.ask_truth(op="reset")["ok"]
    assert served.ask_truth(op="truth")["truth"]["arm"]["safety"] == "normal"
    refused = served.ask_truth(op="fault", name="arm.coffee")
    assert not refused["ok"]
    assert "arm.protective_stop" in refused["error"] and "can.bus_off" in refused["error"]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--level", "rough"], "ideal"),
        (["--surface", "vase"], "pot"),
        (["--arm", "UR11"], "UR10e"),
        (["--speed", "0"], "within 0.05 and 50"),
        (["--speed", "nan"], "within 0.05 and 50"),
        (["--speed", "fast"], "--speed"),
        (["--seed", "-3"], "0 or greater"),
    ],
)
def test_wrong_options_end_with_code_2_and_say_what_is_allowed(options: list[str], says: str, capsys):
    with pytest.raises(SystemExit) as ended:
        main(options)
    assert ended.value.code == 2
    assert says in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(("which", "number"), [(0, None), (1, signal.SIGTERM)], ids=["its input ends", "signal"])
def test_it_ends_cleanly(pair: tuple[Served, Served], which: int, number: signal.Signals | None):
    """It ends with its input so that it cannot outlive its owner. Those that were asked above end here."""
    assert pair[which].end(number) == (0, "")


class LaggingClock(SteppedClock):
    """World time that passes while somebody sleeps; the arm's model of `world` follows it by `lag` s."""

    world: World | None = None
    lag = 0.0

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        assert self.world is not None
        self.world.arm.tick(self.now() - self.lag)


def lagging(lag: float) -> World:
    clock = LaggingClock()
    world = World(seed=1, level="nominal", clock=clock)
    clock.world, clock.lag = world, lag
    clock.step_to(1.0)
    return world


def test_a_picture_waits_for_the_arm_to_come_to_its_exposure():
    world = lagging(0.015)
    assert serve.picture(world, "scan", 1.0, 0.002).shape == (480, 640)
    assert 1.0 <= world.arm.time < 1.0 + 2 * serve.PERIOD


def test_a_picture_does_not_wait_for_ever():
    world = lagging(5.0)
    assert serve.picture(world, "scan", 1.0, 0.002).shape == (480, 640)
    assert world.clock.now() == pytest.approx(1.0 + serve.ARM_LAG, abs=2 * serve.PERIOD)
