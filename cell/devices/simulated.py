"""Starts a simulated cell in a process of its own and ends it, whatever happens to this one.

The process serves the devices' real protocols on free loopback endpoints; the rest of the cell only gets their
addresses, as if they were hardware. It ends when its standard input closes, so it cannot outlive its owner.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection
from typing import Any, Protocol

from cell.config import DEVICES, CellConfig, default_toml
from cell.devices.truth_link import ask_truth, cause_fault
from drivers.errors import ConfigError, DeviceFault

START_TIMEOUT_S = 120.0  # the optics are compiled at the first start
COMPILED_START_S = 4.0  # a start that takes longer is most likely the first one


class Simulation(Protocol):
    """A simulated cell, through whichever door its devices are reached."""

    @property
    def facts(self) -> dict[str, Any]:
        """For journal and report: `simulated`, `seed`, `level` and `clock`, "wall" or "virtual"."""

    def truth(self) -> dict[str, Any]:
        """Everything true about the world now."""

    def require_fault(self, name: str) -> None:
        """`ConfigError` for a fault that it cannot have."""

    def fault(self, name: str) -> None:
        """Cause a fault by its name, one of `sim_backends.faults.FAULT_NAMES`."""

    def close(self) -> None:
        """End its world."""


class SimulatedCell:
    """A served simulated cell, the cameras in `gige` on GigE Vision; `endpoints` is the JSON object that it printed."""

    def __init__(self, *, seed: int, level: str, speed: float, surface: str, gige: Collection[str] = ()) -> None:
        command = [sys.executable, "-m", "sim_backends.serve", "--json", "--exit-with-stdin"]
        command += ["--seed", str(seed), "--level", level, "--speed", repr(speed), "--surface", surface]
        command += [word for name in gige for word in ("--gige", name.removesuffix("_camera"))]
        # A file, because a pipe that nobody reads would block the writer; closed with the process.
        self._messages = tempfile.TemporaryFile()  # noqa: SIM115
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._messages,
            start_new_session=True,  # Ctrl-C goes to the supervisor, which stops the devices before their world ends
        )
        try:
            self.endpoints: dict[str, Any] = self._read_endpoints()
        except BaseException:
            self.close()
            raise

    @property
    def facts(self) -> dict[str, Any]:
        """Which world it is, for journal and report."""
        return {"simulated": True, **{key: self.endpoints[key] for key in ("seed", "level")}, "clock": "wall"}

    def truth(self) -> dict[str, Any]:
        """Everything true about the world now; `CellError` when it does not answer."""
        return ask_truth(self.endpoints["truth"]["address"])

    def require_fault(self, name: str) -> None:
        """Over its wires it can have every fault."""

    def fault(self, name: str) -> None:
        """Cause a fault by its name; `CellError` when that was not taken."""
        cause_fault(self.endpoints["truth"]["address"], name)

    @property
    def pid(self) -> int:
        """Process id of the simulated cell."""
        return self._process.pid

    def _read_endpoints(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        deadline = time.monotonic() + START_TIMEOUT_S
        line = b""
        descriptor = self._process.stdout.fileno()
        if not select.select([descriptor], [], [], COMPILED_START_S)[0]:
            # While that process compiles its optics, this one has a core for what it reads their pictures with. Only
            # then is it loaded: a cell that starts at once may have no need of it.
            from cell.vision.stripe.rehearsal import rehearse_reading

            rehearse_reading()
        while not line.endswith(b"\n"):
            ready, _, _ = select.select([descriptor], [], [], max(0.0, deadline - time.monotonic()))
            chunk = os.read(descriptor, 65536) if ready else b""
            if not chunk:
                reason = self._failure(timed_out=not ready)
                if self._process.poll() == 2:
                    raise ConfigError(reason)
                raise DeviceFault(
                    "simulated cell",
                    "sim.start",
                    reason,
                    recoverable=False,
                    hint="Run `cell sim serve` to see its output.",
                )
            line += chunk
        endpoints: dict[str, Any] = json.loads(line)
        return endpoints

    def _failure(self, *, timed_out: bool) -> str:
        if timed_out:
            return f"it did not start within {START_TIMEOUT_S:.0f} s"
        self._process.wait(5)
        self._messages.seek(0)
        text = self._messages.read().decode(errors="replace").strip()
        return text.splitlines()[-1] if text else f"it ended with exit code {self._process.returncode}"

    def close(self) -> None:
        """End the process: first by closing its input, then by force."""
        if self._process.stdin is not None and not self._process.stdin.closed:
            self._process.stdin.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(5)
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._messages.close()


def on_gige(config: CellConfig) -> list[str]:
    """The cameras that the configuration wants on GigE Vision: so their peers are served."""
    return [name for name in DEVICES if DEVICES[name] == "camera" and config.make(name).name == "gige"]


def with_endpoints(config: CellConfig, endpoints: dict[str, Any]) -> CellConfig:
    """The configuration with every device's address replaced by that of its simulated peer.

    Raises `ConfigError` when a device is of a make that has none.
    """
    section = {"time_scale": float(endpoints["speed"]), "truth": endpoints["truth"]["address"]}
    changed: dict[str, Any] = {"cell": config.cell.model_copy(update=section)}
    for name in DEVICES:
        make = config.make(name)
        if make.simulated is None:
            raise ConfigError(
                f'{name}.driver = "{make.name}": nothing simulates this make; for a simulated cell name one that is '
                "simulated (the built-in ones are)"
            )
        changed[name] = make.simulated(config.device(name), endpoints.get(name, {}))
    return config.model_copy(update=changed)


def endpoint_toml(endpoints: dict[str, Any]) -> str:
    """The shipped configuration's text with the addresses of a served simulated cell in it."""
    values = {
        ("cell", "time_scale"): str(float(endpoints["speed"])),
        ("cell", "truth"): json.dumps(endpoints["truth"]["address"]),
        ("rail", "url"): json.dumps(endpoints["rail"]["url"]),
        ("arm", "address"): json.dumps(endpoints["arm"]["address"]),
        ("vehicle", "interface"): json.dumps(endpoints["vehicle"]["interface"]),
        ("vehicle", "channel"): json.dumps(endpoints["vehicle"]["channel"]),
    }
    for camera in ("scan_camera", "target_camera"):
        values |= {(camera, key): json.dumps(endpoints[camera][key]) for key in ("driver", "address")}
    table, lines = "", []
    for line in default_toml().splitlines():
        if line.startswith("["):
            table = line[1 : line.index("]")]
        value = values.get((table, line.split(" = ")[0]))
        lines.append(line if value is None else f"{line.split(' = ')[0]} = {value}")
    return "\n".join(lines) + "\n"
