"""A simulated cell in a process of its own: its start and end, the truth that it tells, the faults that it is given.

The process serves the devices' real protocols on free loopback endpoints; the rest of the cell only gets their
addresses, as if they were hardware. It ends when its standard input closes, so it cannot outlive its owner.
"""

from __future__ import annotations

import json
import os
import re
import select
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

from cell.config.cell_config import DEVICES, CellConfig
from drivers.errors import CellError, ConfigError, DeviceFault
from drivers.interfaces import Identity
from sim_backends.faults import FAULT_NAMES
from statemachine.step import Event

if TYPE_CHECKING:
    from cell.devices.simulated.described import Described


TIMEOUT_S = 5.0


def ask_truth(address: str) -> dict[str, Any]:
    """The whole truth of a simulated cell; raises `CellError` when its endpoint does not answer."""
    truth: dict[str, Any] = _asked(address, {"op": "truth"}, "does not tell its truth")["truth"]
    return truth


def cause_fault(address: str, name: str) -> None:
    """Cause a fault by its name; raises `CellError` when that was not taken."""
    _asked(address, {"op": "fault", "name": name}, f"did not take the fault {name}")


def make_ready(address: str, drawing: str) -> None:
    """Have the station of a drawing set up and its part put into the claw; raises `CellError` when that was not
    taken."""
    _asked(address, {"op": "make_ready", "drawing": drawing}, "was not made ready for the job")


def clear_faults(address: str) -> None:
    """Take away all causes of faults; raises `CellError` when that was not taken."""
    _asked(address, {"op": "reset"}, "did not take its faults away")


def _asked(address: str, request: dict[str, str], failed: str) -> dict[str, Any]:
    host, port = address.rsplit(":", 1)
    try:
        with socket.create_connection((host, int(port)), timeout=TIMEOUT_S) as link, link.makefile("rwb") as file:
            file.write(json.dumps(request).encode() + b"\n")
            file.flush()
            answer: dict[str, Any] = json.loads(file.readline())
    except (OSError, ValueError) as error:
        raise CellError(f"the simulated cell at {address} {failed}: {error}") from error
    if not answer.get("ok"):
        raise CellError(f"the simulated cell at {address} {failed}: {answer.get('error')}")
    return answer


class WorldLink:
    """A connection to the endpoint at `address`; safe between threads."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._asking = threading.Lock()
        host, port = address.rsplit(":", 1)
        try:
            self._socket = socket.create_connection((host, int(port)), timeout=TIMEOUT_S)
        except OSError as error:
            raise self._lost(error) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._file = self._socket.makefile("rwb")

    def ask(self, **request: object) -> dict[str, Any]:
        """The answer to a request; `DeviceFault` (sim.lost) when none comes, or when it was refused."""
        with self._asking:
            try:
                self._file.write(json.dumps(request).encode() + b"\n")
                self._file.flush()
                answer: dict[str, Any] = json.loads(self._file.readline())
            except (OSError, ValueError) as error:
                # An answer that comes after all would be taken for the next request's.
                self.close()
                raise self._lost(error) from error
        if not answer.get("ok"):
            raise self._lost(answer.get("error"))
        return answer

    def close(self) -> None:
        """End the connection; idempotent."""
        with suppress(OSError):
            self._file.close()
        self._socket.close()

    def _lost(self, why: object) -> DeviceFault:
        return DeviceFault(
            "simulated world", "sim.lost", f"it does not take what the real devices do: {why}", recoverable=False,
            hint="Its process has ended or hangs; open the cell again.",
        )  # fmt: skip


@dataclass(frozen=True)
class _Outputs:
    """What a connector shows; see `drivers.switches.Shown`."""

    digital_outputs: int


class WorldConnector:
    """Where a simulated laser or claw hangs while the arm is real; see `drivers.switches.Connector`."""

    def __init__(self, link: WorldLink) -> None:
        self._link = link

    def identity(self) -> Identity:
        """That it is simulated."""
        return Identity("simulated world", "", "", self._link.address)

    def ping(self) -> float:
        """One round trip, wall seconds."""
        begun = time.monotonic()
        self._link.ask(op="time")
        return time.monotonic() - begun

    def state(self) -> _Outputs:
        """The outputs as they are in the simulated world."""
        return _Outputs(int(self._link.ask(op="connector")["outputs"]))

    def set_digital_output(self, index: int, value: bool) -> None:
        """Set an output of the simulated world."""
        self._link.ask(op="switch", output=index, on=value)

    def digital_input(self, index: int) -> bool:
        """Read an input of the simulated world."""
        return bool(int(self._link.ask(op="connector")["inputs"]) >> index & 1)


START_TIMEOUT_S = 120.0  # the optics are compiled at the first start


class Simulation(Protocol):
    """A simulated cell, through whichever door its devices are reached."""

    simulated: tuple[str, ...]
    """The devices that it has; all of the cell's unless some are real beside it."""

    @property
    def facts(self) -> dict[str, Any]:
        """For journal and report: `simulated` (true, or which devices beside real ones), `seed`, `level` and `clock`,
        "wall" or "virtual"."""

    def truth(self) -> dict[str, object]:
        """Everything true about the world now."""

    def require_fault(self, name: str) -> None:
        """`ConfigError` for a fault that it cannot have."""

    def fault(self, name: str) -> None:
        """Cause a fault by its name, one of `sim_backends.faults.FAULT_NAMES`."""

    def make_ready(self, described: Described) -> None:
        """As a person does: set up the job's station, with its part in the claw; nothing where that is so already.
        `ConfigError` for a job that cannot be simulated as it is described."""

    def close(self) -> None:
        """End its world."""


class SimulatedCell:
    """A served simulated cell, the cameras in `gige` on GigE Vision; `endpoints` is the JSON object that it printed.

    `simulated` are the devices that it is used for, beside real ones where these are not all; it follows the real ones
    in `follow`.
    """

    def __init__(
        self, config: CellConfig, described: Described, *, seed: int, level: str, speed: float,
        gige: Collection[str] = (), simulated: tuple[str, ...] = tuple(DEVICES), follow: Collection[str] = (),
        meanwhile: Callable[[], None] | None = None,
    ) -> None:  # fmt: skip
        """Serve the cell as configuration and job describe it; `ConfigError` for what cannot be simulated so.

        `meanwhile` is done while the world starts, which takes as long, and waited for. Not by this thread: a signal
        that came inside the compiler would be lost.
        """
        self._config, self.simulated = config, simulated
        command = [sys.executable, "-m", "sim_backends.serve", "--json", "--exit-with-stdin"]
        command += ["--seed", str(seed), "--level", level, "--speed", repr(speed)]
        command += ["--drawing", described.drawing(config, simulated).as_json()]
        command += [word for name in follow for word in ("--follow", name)]
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
        beside = threading.Thread(target=meanwhile, name="meanwhile")
        beside.start()
        try:
            self.endpoints: dict[str, Any] = self._read_endpoints()
            beside.join()
        except BaseException:
            self.close()
            raise

    @property
    def facts(self) -> dict[str, Any]:
        """Which world it is, for journal and report."""
        which: bool | list[str] = True if is_whole(self) else list(self.simulated)
        return {"simulated": which, **{key: self.endpoints[key] for key in ("seed", "level")}, "clock": "wall"}

    def truth(self) -> dict[str, object]:
        """Everything true about the world now; `CellError` when it does not answer."""
        return ask_truth(self.endpoints["truth"]["address"])

    def require_fault(self, name: str) -> None:
        """Over its wires it can have every fault of the devices that it has; `ConfigError` for those of a real one."""
        of = next((device for start, device in FAULTS_OF.items() if name.startswith(start)), "")
        if of not in self.simulated:
            raise ConfigError(f'"{name}": the {of or "device"} is real here, nobody causes its faults')

    def fault(self, name: str) -> None:
        """Cause a fault by its name; `CellError` when that was not taken."""
        cause_fault(self.endpoints["truth"]["address"], name)

    def make_ready(self, described: Described) -> None:
        """See `Simulation`; `CellError` when that was not taken."""
        make_ready(self.endpoints["truth"]["address"], described.drawing(self._config, self.simulated).as_json())

    @cached_property
    def link(self) -> WorldLink | None:
        """The line at which its world is told of real devices; None where it follows none."""
        told: dict[str, Any] | None = self.endpoints.get("following")
        return None if told is None else WorldLink(told["address"])

    def _read_endpoints(self) -> dict[str, object]:
        assert self._process.stdout is not None
        deadline = time.monotonic() + START_TIMEOUT_S
        line = b""
        descriptor = self._process.stdout.fileno()
        while not line.endswith(b"\n"):
            ready, _, _ = select.select([descriptor], [], [], max(0.0, deadline - time.monotonic()))
            chunk = os.read(descriptor, 65536) if ready else b""
            if not chunk:
                reason = self._failure(timed_out=not ready)
                if self._process.poll() == 2:
                    raise ConfigError(reason)
                raise DeviceFault(
                    "simulated cell", "sim.start", reason, recoverable=False,
                    hint="Run `cell sim serve` to see its output.",
                )  # fmt: skip
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
        if (link := self.__dict__.get("link")) is not None:
            link.close()
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


FAULTS_OF = {
    "arm.": "arm", "rail.": "rail", "vehicle.": "vehicle", "can.": "vehicle", "camera.": "scan_camera",
    "target_camera.": "target_camera",
}  # fmt: skip
"""Whose fault it is, by how its name begins."""


def is_whole(simulation: Simulation | None) -> bool:
    """Whether every device of the cell is simulated: nothing real moves, shines or is looked at."""
    return simulation is not None and set(simulation.simulated) == set(DEVICES)


def on_gige(config: CellConfig) -> list[str]:
    """The cameras that the configuration wants on GigE Vision: so their peers are served."""
    return [name for name in DEVICES if DEVICES[name] == "camera" and config.make(name).name == "gige"]


def with_endpoints(
    config: CellConfig, endpoints: dict[str, Any], simulated: Collection[str] = tuple(DEVICES)
) -> CellConfig:
    """The configuration with the addresses of these devices replaced by those of their simulated peers. Raises
    `ConfigError` when one of them is of a make that has none."""
    changed: dict[str, Any] = {}
    if set(simulated) == set(DEVICES):
        section = {"time_scale": float(endpoints["speed"]), "truth": endpoints["truth"]["address"]}
        changed["cell"] = config.cell.model_copy(update=section)
    for name in simulated:
        make = config.make(name)
        if make.simulated is None:
            raise ConfigError(
                f'{name}.driver = "{make.name}": nothing simulates this make; for a simulated cell name one that is '
                "simulated (the built-in ones are)"
            )
        changed[name] = make.simulated(config.device(name), endpoints.get(name, {}))
    return config.model_copy(update=changed)


def endpoint_toml(config: dict[str, Any], endpoints: dict[str, Any]) -> str:
    """A configuration's tables as TOML, with the addresses of a served simulated cell in it."""
    import tomlkit

    tables: dict[str, Any] = {name: table if isinstance(table, list) else dict(table) for name, table in config.items()}
    tables["cell"] |= {"time_scale": float(endpoints["speed"]), "truth": endpoints["truth"]["address"]}
    for name in DEVICES:
        tables[name] |= endpoints.get(name, {})
    return "# A simulated cell that is served: the configuration with its addresses.\n\n" + tomlkit.dumps(tables)


_FORM = re.compile(r"(?P<fault>[a-z_.]+)@(?P<step>[a-z_]+)(:(?P<percent>\d+(\.\d+)?)\s*%)?")


@dataclass(frozen=True)
class Injection:
    """A fault by name, and the step and the fraction (0 to 1) of it at which it happens."""

    fault: str
    step: str
    fraction: float

    @classmethod
    def parse(cls, text: str, steps: Sequence[str]) -> Injection:
        """From `fault@step:percent%`, or `fault@step` for its start; `ConfigError` lists what is known. `steps` are the
        names of the job's steps."""
        match = _FORM.fullmatch(text.strip())
        if match is None:
            raise ConfigError(
                f'"{text}" is no scheduled fault: write it as "arm.protective_stop@laser_sweep:40%"; the faults are '
                f"{', '.join(FAULT_NAMES)}"
            )
        fault, step, percent = match["fault"], match["step"], float(match["percent"] or 0.0)
        if fault not in FAULT_NAMES:
            raise ConfigError(f'"{text}": the simulated cell has no fault "{fault}"; known: {", ".join(FAULT_NAMES)}')
        if step not in steps:
            raise ConfigError(f'"{text}": there is no step "{step}"; the steps are {", ".join(steps)}')
        if percent > 100.0:
            raise ConfigError(f'"{text}": {percent:g} % is outside 0 % to 100 %')
        return cls(fault, step, percent / 100.0)

    def __str__(self) -> str:
        return f"{self.fault}@{self.step}:{100 * self.fraction:g}%"


class Injector:
    """An observer of a run that causes each fault once, by `cause(name)`. `missed` has what was scheduled and did not
    happen: not reached, or not to be caused, and why."""

    def __init__(self, cause: Callable[[str], None], injections: Sequence[Injection]) -> None:
        self.injections = tuple(injections)
        self._cause = cause
        self._waiting = list(injections)
        self._failed: dict[Injection, str] = {}

    @classmethod
    def scheduled(cls, texts: Sequence[str], steps: Sequence[str], simulated: Simulation | None) -> Injector:
        """For texts that `Injection.parse` takes; `ConfigError` also for a fault that this cell cannot have."""
        injections = [Injection.parse(text, steps) for text in texts]
        if simulated is None:
            raise ConfigError(f"{', '.join(map(str, injections))} can only happen to a simulated cell")
        for injection in injections:
            simulated.require_fault(injection.fault)
        return cls(simulated.fault, injections)

    def __call__(self, event: Event) -> None:
        """Take an event of the runner."""
        match event.kind:
            case "step_started":
                fraction = 0.0
            case "progress":
                fraction = float(str(event.data["fraction"]))
            case "step_done":
                fraction = 1.0
            case _:
                return
        for injection in list(self._waiting):
            if injection.step == event.step and fraction >= injection.fraction:
                self._waiting.remove(injection)
                try:
                    self._cause(injection.fault)
                # The others are still to happen, and the report tells of this one.
                except Exception as error:
                    self._failed[injection] = f"could not be caused: {error}"

    @property
    def missed(self) -> dict[str, str]:
        """Why each fault that did not happen did not."""
        early = {str(injection): "the run did not come that far" for injection in self._waiting}
        return early | {str(injection): why for injection, why in self._failed.items()}
