"""Tells a simulated world what the real devices of the same cell do, as they measure themselves.

One thread a device, each reading only. A row is the host time at which a reading held, s, and the device's numbers. The
world waits with a picture until it has them: a late reading delays pictures and does not spoil them.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import numpy as np
import pinocchio as pin

from cell.config.cell_config import CellConfig
from cell.devices.devices import Devices
from cell.devices.gate.gated import GatedArm
from cell.devices.simulated.process import WorldLink
from drivers.errors import CellError, DeviceFault
from drivers.interfaces import ArmState, Vector
from drivers.make import OnArm

Rows = list[list[float]]
Feed = Callable[[], AbstractContextManager[Callable[[], Rows]]]
"""The readings of one device; inside the context a function gives the rows since it was called last, oldest first."""

PERIOD_S, AT_REST_S = 0.008, 0.02
"""Wall seconds between two looks for readings, of what moves and of what stands; the world waits for them with its
pictures."""
FINEST_S = 0.0039
"""Of an arm's states, which come each 2 ms, so many are told while it moves."""
DRIFT_S = 0.2e-6
"""What an arm's clock may drift from one state to the next: 100 ppm of 2 ms."""


class ArmFeed:
    """Joints, whether it moves, outputs; by the arm's own clock, which the way over the wire does not jolt."""

    def __init__(self, devices: Devices) -> None:
        arm = devices.arm
        # Its own force alone: what the simulated part touches is what comes back from the world.
        self._arm = arm.bare if isinstance(arm, GatedArm) else arm
        self._ahead: float | None = None
        self._newest, self._outputs = 0.0, -1

    @contextmanager
    def open(self) -> Iterator[Callable[[], Rows]]:
        with self._arm.record() as states:
            yield lambda: self._rows(states)

    def time(self, state: ArmState) -> float:
        """Host time at which a state held: the one that came fastest tells how far the arm's clock is ahead."""
        if state.device_time <= 0.0:
            return state.stamp
        ahead = state.stamp - state.device_time
        if self._ahead is None or abs(ahead - self._ahead) > 1.0:
            self._ahead = ahead
        return state.device_time + self._ahead

    def _rows(self, states: list[ArmState]) -> Rows:
        batch = list(states)
        del states[: len(batch)]
        rows: Rows = []
        for k, state in enumerate(batch):
            t = self.time(state)
            if self._ahead is not None and state.device_time > 0.0:
                self._ahead = min(self._ahead + DRIFT_S, state.stamp - state.device_time)
            told = k == len(batch) - 1 or (state.moving and t - self._newest >= FINEST_S)
            if told or state.digital_outputs != self._outputs:
                self._newest, self._outputs = t, state.digital_outputs
                rows.append([t, *map(float, state.joints), float(state.moving), float(state.digital_outputs)])
        return rows


class RailFeed:
    """Position: a sweep's readings as they come; at rest, where the last motion has brought it, for nothing else does.
    It is not asked while it rests, nor while it moves without being recorded: that would take its line's time."""

    def __init__(self, devices: Devices) -> None:
        self._rail, self._clock = devices.rail, devices.clock

    @contextmanager
    def open(self) -> Iterator[Callable[[], Rows]]:
        self._arrived = self._seen = self._rail.motion
        self._told, self._position = 0, self._rail.state().position
        self._looked = self._clock.now()
        yield self._rows

    def _rows(self) -> Rows:
        before, self._looked = self._looked, self._clock.now()
        motion, rows = self._rail.motion, []
        if motion is not self._seen:
            self._seen, self._told = motion, 0
        if motion is not None and (samples := getattr(motion, "samples", None)) is not None:
            rows = [[float(t), float(position)] for t, position in samples[self._told :]]
            self._told += len(rows)
        if motion is not None and not motion.done:
            return rows
        if motion is not self._arrived:
            state = self._rail.state()
            if state.moving:
                return rows
            self._arrived, self._position = motion, state.position
            # It has ended since the last look, with the carriage at rest: whoever waited for it may expose at once.
            rows.append([before, self._position])
        return [*rows, [self._clock.now(), self._position]]


class VehicleFeed:
    """Odometry, speeds, and whether it is braked."""

    def __init__(self, devices: Devices) -> None:
        self._vehicle = devices.vehicle
        self._newest = float("-inf")

    @contextmanager
    def open(self) -> Iterator[Callable[[], Rows]]:
        yield self._rows

    def _rows(self) -> Rows:
        state = self._vehicle.state()
        if state.stamp <= self._newest:
            return []
        self._newest = state.stamp
        numbers = (state.stamp, state.x, state.y, state.yaw, state.speed, state.yaw_rate, bool(state.braked))
        return [[float(number) for number in numbers]]


LATEST_S = 0.25
"""Wall seconds after which, at the 99th percentile, a reading is in the world: pictures wait that long."""
TRIAL_S = 1.0
LOOK_S = 0.5
"""Wall seconds between two looks whether the world made all its pictures."""
MOST_SCATTER = 3.0
"""Times a rail position's stated deviation that the readings of a sweep, which its pictures follow, may scatter."""
_KEPT = 30_000

log = logging.getLogger(__name__)


class DeviceFollowing:
    """The real devices `followed` of a cell, told to the world that has the devices `simulated`."""

    def __init__(
        self, link: WorldLink, devices: Devices, config: CellConfig, followed: Collection[str],
        simulated: tuple[str, ...],
    ) -> None:  # fmt: skip
        """Begin. Raises `DeviceFault` when the world does not answer, or when readings reach it too late."""
        self.simulated = simulated
        self._link, self._devices, self._clock = link, devices, devices.clock
        self._closed = threading.Event()
        self._ahead = self._compare_clocks()
        self._wrenches: deque[tuple[float, Vector]] = deque(maxlen=_KEPT)
        self._felt = threading.Condition()
        feeds: dict[str, Callable[[], Feed]] = {
            "arm": lambda: self._arm.open,
            "rail": lambda: RailFeed(devices).open,
            "vehicle": lambda: VehicleFeed(devices).open,
            "laser": lambda: self._switch(lambda: devices.laser.is_on),
            "claw": lambda: self._switch(lambda: devices.claw.holding),
        }
        if "arm" in followed:
            self._arm = ArmFeed(devices)
            table = devices.arm.link_table()
            columns = () if table is None else (table.a, table.d, table.alpha, table.theta)
            rows = [list(row) for row in zip(*columns, strict=True)] or None
            real = [
                record for record, name in ((config.laser, "laser"), (config.claw, "claw")) if name not in simulated
            ]
            outputs = sum(1 << record.output for record in real if isinstance(record, OnArm))
            self._link.ask(op="begin", table=rows, outputs=outputs)
        self._threads = [
            threading.Thread(target=self._feed, args=(name, feeds[name]()), name=f"following {name}", daemon=True)
            for name in followed
        ]
        self._threads.append(threading.Thread(target=self._say_why_not, name="following pictures", daemon=True))
        for thread in self._threads:
            thread.start()
        try:
            self._require_in_time()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Tell no more; idempotent. Before the devices are closed."""
        self._closed.set()
        for thread in self._threads:
            thread.join(2.0)

    def figures(self) -> dict[str, Any]:
        """How late readings reach the world, for report and screen: see docs/reference/report.md."""
        told: dict[str, object] = self._link.ask(op="figures")["figures"]
        return {**told, "clocks_known_ms": round(1e3 * self._clocks_known, 4)}

    def board_seen(self, base_from_board: pin.SE3) -> None:
        """A real target camera has measured the station's board: the world's station is put there. Nothing is done
        while the target camera, or the vehicle, is simulated: it sees that world's board already."""
        if "target_camera" not in self.simulated and "vehicle" not in self.simulated:
            self._link.ask(op="board", base_from_board=base_from_board.homogeneous.tolist())

    def require_paired(self, scatter: float, allowed: float) -> None:
        """The pictures of a sweep were made at the rail's readings, each of which is off by `scatter` m (95 %).

        Raises `DeviceFault` (sim.scattered) when that is more than `allowed`. Where rail and scan camera are both real,
        or both simulated, nothing is followed.
        """
        if "rail" not in self.simulated and "scan_camera" in self.simulated and scatter > allowed:
            raise DeviceFault(
                "rail",
                "sim.scattered",
                f"the pictures of the simulated scan camera follow the rail's readings, which lie {1e3 * scatter:.3f} "
                f"mm off its motion (95 %; allowed {1e3 * allowed:.3f} mm): the pictures would show another surface",
                recoverable=True,
                hint="Sweep more slowly, use a faster line to the rail, or end programs that keep this computer busy.",
            )

    def wrench(self) -> Vector:
        """The newest wrench (6,) on the flange, base axes, of the simulated part on the simulated surface."""
        with self._felt:
            return self._wrenches[-1][1] if self._wrenches else np.zeros(6)

    def wrenches_at(self, states: list[ArmState]) -> list[Vector]:
        """The same at each of these states, once it is known; DeviceFault (sim.late) when it does not come."""
        if not states:
            return []
        times = [self._arm.time(state) for state in states]
        with self._felt:
            if not self._felt.wait_for(lambda: self._wrenches and self._wrenches[-1][0] >= times[-1] - 1e-3, 2.0):
                raise self._late("what the simulated part touches is not told any more")
            rows = list(self._wrenches)
        known = np.array([row[0] for row in rows])
        columns = np.array([row[1] for row in rows]).T
        return list(np.column_stack([np.interp(times, known, column) for column in columns]))

    def next_wrench(self) -> Vector:
        """Wait a little for the next one."""
        with self._felt:
            self._felt.wait(0.05)
        return self.wrench()

    def _compare_clocks(self) -> float:
        """World time less host time, s: both run on this computer's clock, so once is enough."""
        trips: list[tuple[float, float]] = []
        for _ in range(30):
            before = self._clock.now()
            world = float(self._link.ask(op="time")["time"])
            after = self._clock.now()
            trips.append((after - before, world - 0.5 * (before + after)))
        shortest, ahead = min(trips, key=lambda trip: trip[0])
        self._clocks_known = self._clock.wall(0.5 * shortest)
        return ahead

    def _require_in_time(self) -> None:
        """Watch for a moment; `DeviceFault` (sim.late) when a device is not told of, or too late."""
        self._closed.wait(TRIAL_S)
        for name, row in self.figures()["devices"].items():
            if row["latency_ms"] is None:
                raise self._late(f"nothing is told of the {name} for {TRIAL_S:g} s")
            if row["latency_ms"]["p99"] > 1e3 * LATEST_S:
                raise self._late(
                    f"what the {name} does reaches the simulated world after {row['latency_ms']['p99']:.0f} ms (99 %; "
                    f"allowed {1e3 * LATEST_S:.0f} ms)"
                )

    def _late(self, text: str) -> DeviceFault:
        return DeviceFault(
            "simulated world", "sim.late", text, recoverable=True,
            hint="End programs that keep this computer busy, then open the cell again.",
        )  # fmt: skip

    def _feed(self, name: str, feed: Feed) -> None:
        """Until closed; a device that does not answer for a while leaves a gap, in which there are no pictures."""
        said = ""
        try:
            link = WorldLink(self._link.address)
        except CellError as error:
            log.warning("%s", error)
            return
        try:
            while not self._closed.wait(0.05):
                try:
                    self._tell_all(link, name, feed)
                except CellError as error:
                    if getattr(error, "code", "") == "sim.lost":
                        log.warning("%s", error)
                        return
                    if str(error) != said:
                        log.info("following waits: %s", error)
                    said = str(error)
        finally:
            link.close()

    def _switch(self, is_on: Callable[[], bool]) -> Feed:
        """Of a laser or claw that does not hang on the arm: whether it is on."""
        return lambda: nullcontext(lambda: [[self._clock.now(), float(is_on())]])

    def _tell_all(self, link: WorldLink, name: str, feed: Feed) -> None:
        period = AT_REST_S if name == "vehicle" else PERIOD_S
        with feed() as newest:
            while not self._closed.wait(period):
                if not (rows := newest()):
                    continue
                told = [[row[0] + self._ahead, *row[1:]] for row in rows]
                wrenches = link.ask(op="tell", device=name, rows=told)["wrenches"]
                if name == "arm":
                    with self._felt:
                        self._wrenches.extend((row[0], np.array(w)) for row, w in zip(rows, wrenches, strict=True))
                        self._felt.notify_all()
                if name == "rail" and len(rows) == 1:
                    # It rests.
                    self._closed.wait(AT_REST_S - PERIOD_S)

    def _say_why_not(self) -> None:
        """A picture that was not made is a frame that does not come: the log says why."""
        told = 0
        while not self._closed.wait(LOOK_S):
            try:
                figures = self._link.ask(op="figures")["figures"]
            except CellError:
                return
            if figures["not_made"] > told:
                log.warning("the simulated world made no picture: %s", figures["why_not"])
            told = figures["not_made"]
