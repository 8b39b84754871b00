"""Records a run: listens at the gate, on the wires, to the frames, the log and the run's events, for `record.mcap`.

Whoever is listened to only puts what it has into a queue. On the wall's clock times are nanoseconds since the epoch; on
the virtual clock they are the cell's own, so that the same seed gives the same record. In JSON numbers keep every
digit, and what is no number becomes null.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.config.calibrations.store import CellCalibration
from cell.config.cell_config import DEVICES, CellConfig, deck_plates, mounted
from cell.devices.devices import Devices
from cell.devices.gate.interlocks import DeviceCommand
from cell.motion.collision import Body, arm_bodies, tool_bodies, vehicle_bodies
from cell.procedures.frame_store import FrameFile
from cell.procedures.steps.reconstruct import TimedCloud
from cell.procedures.sweep.swath import RailPath
from cell.run.record.file import CAMERAS, COMMANDED, FILE, RecordFile, missing
from cell.run.runs import Run
from drivers.clock import Clock
from drivers.interfaces import ArmState, Frame, RailState
from statemachine.step import Event
from statemachine.waiting import WaitableClock

if TYPE_CHECKING:
    from cell.run.record.drawing import RecordDrawing

MOST_NUMBERS = 2000
"""Of an array that goes into a message; of a larger one its shape is told."""


def as_json(data: object) -> bytes:
    """Strict JSON."""
    try:
        return _ENCODER.encode(data).encode()
    except (ValueError, TypeError):
        # A number that is none, or a key that is no text.
        return _ENCODER.encode(plain(data)).encode()


def plain(value: object) -> Any:
    """What JSON has words for."""
    if isinstance(value, bool | str | int) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(each) for each in value]
    return plain(_simpler(value))


def _simpler(value: object) -> object:
    """The same as numbers, lists or text."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist() if value.size <= MOST_NUMBERS else f"{'×'.join(map(str, value.shape))} numbers"
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, pin.SE3):
        return value.homogeneous
    return value.hex() if isinstance(value, bytes | bytearray) else str(value)


_ENCODER = json.JSONEncoder(allow_nan=False, separators=(",", ":"), default=plain)
_WORDS = (b"false", b"true")


def wire(sent: bool, what: object) -> bytes:
    """A CAN frame, or bytes, as JSON. Written out, because hundreds come in a second."""
    import can  # takes long to load, which only cells with a bus need

    if isinstance(what, can.Message):
        flags = (what.is_extended_id, what.is_remote_frame, what.is_error_frame, what.is_fd)
        extended, remote, error, fd = (_WORDS[flag] for flag in flags)
        return (
            b'{"sent":%s,"id":%d,"extended":%s,"remote":%s,"error":%s,"fd":%s,"dlc":%d,"data":"%s"}'
            % (_WORDS[sent], what.arbitration_id, extended, remote, error, fd, what.dlc, what.data.hex().encode())
        )  # fmt: skip
    data = what.hex() if isinstance(what, bytes | bytearray) else str(what)
    return as_json({"sent": sent, "data": data})


def rtde(sent: bool, what: object) -> bytes:
    """What passes between arm and driver, as JSON: packets as bytes, lines of the dashboard, values, requests."""
    match what:
        case bytes() | bytearray():
            return as_json({"sent": sent, "data": what.hex()})
        case str():
            return as_json({"sent": sent, "text": what})
        case (str() as name, tuple() as arguments):
            return as_json({"sent": sent, "request": name, "arguments": arguments})
    return as_json({"sent": sent, "state": vars(what)})


class Times:
    """Turns the times that others tell into those of a record; all in ns."""

    def __init__(self, clock: Clock) -> None:
        self.virtual = isinstance(clock, WaitableClock)
        self.name = "virtual" if self.virtual else "wall"
        self._clock = clock
        self._begun, self._epoch = clock.now(), time.time_ns()

    def now(self) -> int:
        """Now."""
        return self.of(self._clock.now())

    def of(self, host_time: float) -> int:
        """A time of the cell's clock, in s; one that nobody knows is now."""
        if not math.isfinite(host_time):
            host_time = self._clock.now()
        if self.virtual:
            return max(0, round(1e9 * host_time))
        return self._epoch + round(1e9 * self._clock.wall(host_time - self._begun))

    def of_wall(self, seconds: float) -> int:
        """A time since the epoch, in s, that was taken just now."""
        return self.now() if self.virtual else round(1e9 * seconds)


LOGGERS = ("cell", "drivers", "statemachine")
READINGS_S, PROGRESS_S, PICTURES_S = 1 / 30, 0.2, 0.5
"""Seconds on the wall, or of the virtual clock, between two readings of a device, two words of progress and two
pictures of a camera."""

log = logging.getLogger(__name__)
_said: set[str] = set()


@contextmanager
def recorded(
    folder: Path, run: Run[object], config: CellConfig, devices: Devices, calibration: CellCalibration | None = None
) -> Iterator[Recorder | None]:
    """While the context is open, all that happens goes to `record.mcap` in `folder`; None where nothing does."""
    record = begin_record(folder, run, config, devices, calibration)
    try:
        yield record
    finally:
        if record is not None:
            record.close()


def begin_record(
    folder: Path, run: Run[object], config: CellConfig, devices: Devices, calibration: CellCalibration | None = None
) -> Recorder | None:
    """Begin to record; None where the configuration says so or, said once in a process, packages are not installed."""
    if not config.cell.record:
        return None
    if absent := missing():
        if "packages" not in _said:
            _said.add("packages")
            names = " ".join(name.replace("_", "-") for name in absent)
            log.warning("runs leave no %s, all else works: %s not installed; pip install %s", FILE, names, names)
        return None
    try:
        return Recorder(folder, run, config, devices, calibration)
    # Whatever keeps it from being recorded keeps no run from going on.
    except Exception as error:
        log.warning("this run leaves no %s: %s: %s", FILE, type(error).__name__, error)
        return None


class Recorder(logging.Handler):
    """A record that is going on; `close` ends it."""

    def __init__(
        self, folder: Path, run: Run[object], config: CellConfig, devices: Devices, calibration: CellCalibration | None
    ) -> None:
        super().__init__(logging.INFO)
        self._run, self._devices = run, devices
        self._times = Times(devices.clock)
        self._config, self._calibration = config, calibration
        facts = {"run": folder.name, "cell": config.cell.name, "clock": self._times.name}
        self.file = RecordFile(folder / FILE, facts, lossless=self._times.virtual)
        self._due: dict[str, float] = {}
        self._pictured: dict[str, int] = {}
        self._begun = self._times.now()
        self._bodies: dict[str, Body] = {}
        self._fixed = (
            *arm_bodies(config.arm.model), *tool_bodies(mounted=mounted(config)), *vehicle_bodies(deck_plates(config)),
        )  # fmt: skip
        self._about: tuple[object, object] = (None, None)
        self._listen()

    def close(self) -> None:
        """Listen no more, and end the file. A failure is told in the log; the run has ended as it has all the same."""
        for device in self._devices:
            device.statistics.traffic.listener = None
        for name in LOGGERS:
            logging.getLogger(name).removeHandler(self)
        self._run.record = None
        self._devices.gate.listener = None
        self.file.close()
        if self.file.failure is not None:
            log.warning("%s is not whole: %s", self.file.path, self.file.failure)
        elif self.file.dropped:
            what = ", ".join(f"{count} of {topic}" for topic, count in sorted(self.file.dropped.items()))
            log.warning("%s does not hold all, too much came at once: %s are missing", self.file.path, what)
        super().close()

    def _listen(self) -> None:
        at = self._times.now()
        self._put("/tf", at, lambda draw: draw.arm(at))
        self._put("/tf", at, lambda draw: draw.scan_camera(at, 0.0))
        self._look_around()
        self._devices.gate.listener = self
        self._run.record = self.event
        for name in LOGGERS:
            logging.getLogger(name).addHandler(self)
        for device in self._devices:
            if device.name in DEVICES:
                device.statistics.traffic.listener = self._wire(device.name)

    def event(self, event: Event) -> None:
        """The run tells something."""
        if event.kind == "progress" and not self._is_due("progress", PROGRESS_S):
            return
        at, data = self._times.of_wall(event.at), dict(event.data)
        if event.kind == "state":
            self._json("/sequence/state", at, data)
        self._json("/sequence/event", at, {"kind": event.kind, "step": event.step or "", "data": data})

    def command(self, command: DeviceCommand, refused: str | None) -> None:
        if command.device in COMMANDED:
            told = {"name": command.name, "arguments": dict(command.arguments), "refused": refused or ""}
            self._json(f"/{command.device}/command", self._times.now(), told)

    def reading(self, device: str, reading: object) -> None:
        if isinstance(reading, RailPath):
            for stamp, position in reading.samples.tolist():
                at = self._times.of(stamp)
                self._json("/rail/state", at, {"stamp": stamp, "position": position})
                self._rail_at(at, position)
        elif isinstance(reading, TimedCloud):
            self._lines(reading)
        elif self._is_due(device, READINGS_S):
            stamp = getattr(reading, "stamp", None)
            at = self._times.now() if stamp is None else self._times.of(stamp)
            self._json(f"/{device}/state", at, reading)
            if isinstance(reading, ArmState):
                self._put("/tf", at, lambda draw: draw.arm(at, reading))
                self._put("/joints", at, lambda draw: draw.arm_joints(at, reading.joint_speeds))
                self._look_around()
            elif isinstance(reading, RailState):
                self._rail_at(at, reading.position)

    def frame(self, what: str, frame: Frame, picture: FrameFile) -> None:
        """A frame is kept, see `cell.procedures.frame_store.FrameStore`."""
        # Which camera took it, by its size; where both have the same, by what it is kept as.
        there = {name: getattr(self._devices, name).shape for name in CAMERAS if name in self._devices}
        fits = [name for name, shape in there.items() if shape == frame.image.shape]
        named = "target_camera" if what.startswith(("board", "target")) else "scan_camera"
        camera = fits[0] if len(fits) == 1 else named
        # What the run before has photographed is shown as this one begins.
        at = max(self._begun, self._times.of(frame.mid_exposure))
        told = {
            "file": picture.name, "frame_id": frame.frame_id, "exposure": frame.exposure,
            "device_time": frame.device_time, "host_time": frame.host_time, "received": frame.received,
            "lost_before": frame.lost_before,
        }  # fmt: skip
        self._json(f"/{camera}/frame", at, told)
        self._put(f"/{camera}/calibration", at, lambda draw: draw.lens(at, camera))
        # A person looks at them; all are in frames/.
        if not 0 <= at - self._pictured.get(camera, -math.inf) < 1e9 * PICTURES_S:
            self._pictured[camera] = at
            self._put(f"/{camera}/image", at, lambda draw: draw.image(at, camera, picture))

    def emit(self, record: logging.LogRecord) -> None:
        at = self._times.of_wall(record.created)
        text = record.getMessage()
        self._put("/log", at, lambda draw: draw.log_line(at, record, text))

    def _wire(self, device: str) -> Callable[[bool, object], None]:
        topic = {"arm": "/arm/rtde", "vehicle": "/vehicle/can"}.get(device, f"/{device}/serial")
        put, notify = self.file.put, rtde if device == "arm" else wire

        def listen(sent: bool, what: object) -> None:
            put(topic, time.time_ns(), partial(notify, sent, what))

        return listen

    def _rail_at(self, at: int, position: float) -> None:
        self._put("/tf", at, lambda draw: draw.scan_camera(at, position))
        self._put("/joints", at, lambda draw: draw.rail_joint(at))

    def _lines(self, lines: TimedCloud) -> None:
        """Each line of the cloud as it was taken, and all of them with the last; a place in it that is empty is NaN."""
        points, times, seen = lines.cloud.points.astype(np.float32), lines.times, lines.cloud.valid
        for k in np.argsort(times, kind="stable").tolist():
            self._cloud("/cloud/line", self._times.of(float(times[k])), points[k][seen[k]])
        self._cloud("/cloud/whole", self._times.of(float(times.max())), points[seen])

    def _cloud(self, topic: str, at: int, points: NDArray[np.float32]) -> None:
        self._put(topic, at, lambda draw: draw.cloud(at, points))

    def _look_around(self) -> None:
        """Draw the bodies again where the part or the station changed."""
        situation = self._devices.interlocks.situation
        about = situation.part, situation.station
        if about[0] is self._about[0] and about[1] is self._about[1]:
            return
        self._about = about
        bodies = {body.name: body for body in (*self._fixed, *situation.part, *situation.station)}
        gone = [name for name in self._bodies if name not in bodies]
        new = [body for name, body in bodies.items() if self._bodies.get(name) is not body]
        self._bodies = bodies
        at = self._times.now()
        self._put("/scene", at, lambda draw: draw.scene(at, new, gone))

    def _is_due(self, what: str, period: float) -> bool:
        now = self._devices.clock.now()
        if now < self._due.get(what, -1.0):
            return False
        self._due[what] = now + period * self._devices.clock.rate
        return True

    def _json(self, topic: str, at: int, told: object) -> None:
        self.file.put(topic, at, partial(as_json, told))

    @cached_property
    def _drawing(self) -> RecordDrawing:
        """Made by the writer's thread: a job's start does not wait for the packages that it needs."""
        from cell.run.record.drawing import RecordDrawing

        return RecordDrawing(self._config, self._devices, self._calibration)

    def _put(self, topic: str, at: int, make: Callable[[RecordDrawing], bytes | None]) -> None:
        self.file.put(topic, at, lambda: make(self._drawing))
