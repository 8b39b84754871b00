"""Simulated cells and the command line for tests that use the whole as an engineer would."""

import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from cell.config.cell_config import default_toml
from drivers.clock import Clock
from statemachine.journal import JournalError, read

SPEED = "3"


@dataclass(frozen=True)
class Supervised:
    """What the README's script printed in `folder`, where it placed in the simulated cell of seed 3."""

    folder: Path
    printed: str
    report: dict[str, Any]


def command(*arguments: str) -> list[str]:
    """A `cell` command line that runs this checkout."""
    return [sys.executable, "-c", "from cell.apps.cli import main; main()", *arguments]


def cell(*arguments: str, folder: Path, timeout: float = 240.0) -> subprocess.CompletedProcess[str]:
    """Run a `cell` command to its end in `folder`."""
    return subprocess.run(command(*arguments), cwd=folder, capture_output=True, text=True, timeout=timeout)


def _heard() -> None:
    """Signals that whoever started the tests ignores (`nohup`, a background job) end a command all the same."""
    for number in (signal.SIGHUP, signal.SIGINT):
        signal.signal(number, signal.SIG_DFL)


@contextmanager
def started(*arguments: str, folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A `cell` command that is going on; killed at the end if it still is."""
    # In the tests' own session: Linux shares a machine among sessions first, whatever is nice within one.
    process = subprocess.Popen(
        command(*arguments), cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=_heard
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


@contextmanager
def served(folder: Path, *arguments: str) -> Iterator[dict[str, Any]]:
    """A simulated cell and `sim.toml` in `folder` that names it; yields its endpoints."""
    toml = folder / "sim.toml"
    toml.unlink(missing_ok=True)
    with started(
        "sim", "serve", "--json", "--speed", SPEED, "--config-out", str(toml), *arguments, folder=folder
    ) as sim:
        assert sim.stdout is not None
        yield json.loads(sim.stdout.readline())
        if sim.poll() is None:
            sim.send_signal(signal.SIGINT)
            assert sim.wait(10) == 0


def serving(*arguments: str) -> Any:
    """A fixture for a test file: a folder with the configuration of a cell served for it, `sim.toml`; its endpoints."""

    @pytest.fixture(scope="module")
    def made(tmp_path_factory) -> Iterator[tuple[Path, dict[str, Any]]]:
        folder = tmp_path_factory.mktemp("cell")
        with served(folder, *arguments) as endpoints:
            yield folder, endpoints

    return made


BRAKE_FRAME_S = 0.25
"""Longest way of a frame to the simulated vehicle on a busy machine, wall seconds."""


def ask(endpoints: dict[str, Any], **request: str) -> dict[str, Any]:
    """A request to the truth endpoint."""
    host, port = endpoints["truth"]["address"].rsplit(":", 1)
    with socket.create_connection((host, int(port)), timeout=10) as link, link.makefile("rwb") as file:
        file.write(json.dumps(request).encode() + b"\n")
        file.flush()
        answer: dict[str, Any] = json.loads(file.readline())
    assert answer["ok"], answer
    return answer


def assert_safe(endpoints: dict[str, Any]) -> None:
    """Laser off, vehicle stopped and braked, rail and arm at rest, by the world's truth. The vehicle's bus has no
    answer to the brake's frame: who has sent it cannot know when the vehicle has read it."""
    until = time.monotonic() + BRAKE_FRAME_S
    while not (truth := ask(endpoints, op="truth")["truth"])["vehicle"]["braked"] and time.monotonic() < until:
        Clock().sleep(0.01)
    assert not truth["laser_on"] and truth["vehicle"]["stopped"] and truth["vehicle"]["braked"]
    assert not truth["rail_moving"] and not truth["arm"]["moving"]


def wait_for_step(folder: Path, step: str, process: subprocess.Popen[str], timeout: float = 120.0) -> Path:
    """Wait until the newest run in `folder`, which `process` does, is in `step`; gives the run's folder."""
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline and process.poll() is None:
        for run in sorted((folder / "runs").glob("*")):
            try:
                record = read(run)
            except JournalError:
                continue
            if not record.finished and any(row.name == step and row.state == "running" for row in record.steps):
                return run
        Clock().sleep(0.05)
    raise AssertionError(f"no run came to {step} within {timeout} s, or before its process ended: {process.poll()}")


def named(tmp_path: Path, driver: str, address: str) -> Path:
    """The shipped configuration with another scan camera."""
    before, camera, after = default_toml().partition("[scan_camera]")
    after = after.replace('driver = "stream"', f'driver = "{driver}"', 1)
    after = after.replace('address = "192.0.2.20:5000"', address, 1)
    path = tmp_path / "cell.toml"
    path.write_text(before + camera + after, encoding="utf-8")
    return path
