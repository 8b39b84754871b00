"""Manual mode: one recorded run of kind jog, in which steps and held buttons move one device at a time.

It ends with a stop, with the hold of the cell, or when it is switched off; nothing else can be begun meanwhile.

A press that has ended, for whatever reason, moves nothing any more: its later beats are thrown away, so that what comes
late or again after a pause begins no motion. Two watch over it: the thread that began the motion, and beside this
process the one that `drivers.interfaces.Attended` tells of."""

import logging
import math
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeGuard

import numpy as np

from cell.config.cell_config import RailConfig
from cell.config.job import Job
from cell.devices.gate.gate import Gated
from cell.run.jogging import MAX_ANGLE_DEG, MAX_LENGTH_MM, Jog, begin_program, moved
from cell.run.recorded_work import CONFIRMED_BY_A_PERSON, WorkContext
from cell.run.session.supervisor import Cell
from drivers.errors import Aborted, CellError, ConfigError, DeviceError, DeviceFault, InterlockError, LimitError
from drivers.interfaces import ATTENDED_S, Arm, Attended, Motion, Rail

LATE_S = 0.25
"""A beat that was longer under way than the quickest of its page by more than this is none: the button may be up."""
CLOCKS_PART = 2e-4
"""Seconds a second that the clocks of page and cell come apart at most: without it an hour makes all beats late."""


@dataclass(eq=False)
class Press:
    """One press of a button: which client, its number, and what it moves (`sign` +1 or -1)."""

    client: str
    number: int
    device: str
    axis: str
    sign: int
    heard: float = field(default_factory=time.monotonic)
    ended: str | None = None
    beat: Callable[[], None] | None = None
    """Tells the watch beside the device, once that stands."""
    _end: threading.Event = field(default_factory=threading.Event)

    def renew(self) -> None:
        """A beat has come."""
        if self.over() is not None:
            return
        self.heard = time.monotonic()
        if self.beat is not None:
            try:
                self.beat()
            except DeviceError as error:
                self.end(str(error))

    def end(self, why: str) -> None:
        """It is over."""
        if self.ended is None:
            self.ended = why
        self._end.set()

    def over(self) -> str | None:
        """Why it is over, or None while the button is held."""
        if self.ended is None and (silent := time.monotonic() - self.heard) > ATTENDED_S:
            self.end(f"no beat came for {1e3 * silent:.0f} ms (at most {1e3 * ATTENDED_S:.0f}); let go and press again")
        return self.ended

    def wait(self, seconds: float) -> None:
        """Wait a moment, or until it is over."""
        self._end.wait(seconds)


class Presses:
    """The presses of all clients: which one is held now, and which numbers are used up."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last: dict[str, int] = {}
        self._quickest: dict[str, tuple[float, float]] = {}
        self.present: Press | None = None

    def beat(
        self, client: str, number: int, device: str, axis: str, sign: int, at_ms: float | None = None
    ) -> Press | None:
        """A beat has come: a new press, which is to begin a motion, or None.

        `at_ms` is when the page sent it, on the page's own clock: one that was long under way counts for nothing. A
        beat of another button ends what is held, and begins nothing.
        """
        with self._lock:
            if at_ms is not None and self._late(client, at_ms):
                return None
            held = self.present
            if held is not None and held.over() is None:
                if (held.client, held.number, held.device, held.axis, held.sign) == (
                    client, number, device, axis, sign,
                ):  # fmt: skip
                    held.renew()
                    return None
                held.end("another button was pressed")
                self._last[client] = max(number, self._last.get(client, 0))
                return None
            if number <= self._last.get(client, 0):
                return None
            self._last[client] = number
            self.present = Press(client, number, device, axis, sign)
            return self.present

    def end(self, client: str, why: str) -> None:
        """This client's button is up, or the client is gone."""
        with self._lock:
            if self.present is not None and self.present.client == client:
                self.present.end(why)

    def end_all(self, why: str) -> None:
        """Whoever holds a button: it counts no more."""
        with self._lock:
            if self.present is not None:
                self.present.end(why)

    def left(self, client: str) -> None:
        """A client is gone."""
        self.end(client, "the page is gone")
        with self._lock:
            self._last.pop(client, None)
            self._quickest.pop(client, None)

    def _late(self, client: str, at_ms: float) -> bool:
        now = time.monotonic()
        behind = now - 1e-3 * at_ms
        quickest, since = self._quickest.get(client, (behind, now))
        quickest = min(behind, quickest + CLOCKS_PART * (now - since))
        self._quickest[client] = quickest, now
        return behind - quickest > LATE_S


LOOK_S = 0.005
HOLD_SPEED = 0.05
"""m/s of the flange."""
HOLD_TURN = 0.15
"""rad/s of a joint."""
TURN_ACCELERATION, LINE_ACCELERATION = 1.0, 0.4
RAIL_BRAKING_S = 0.03
"""A held rail goes as fast as it can brake within this time."""
LINES_M = (0.2, 0.1, 0.05, 0.02, 0.01)
TURNS_RAD = (0.6, 0.3, 0.1, 0.05)
"""How far one press moves at most: the first of these ways that is clear from end to end."""

NOT_DONE = "the arm had stopped before; it was not done"

log = logging.getLogger(__name__)

Told = Callable[[Press, str, str], None]
"""A press and what has become of it: moving, ended or refused, and why."""


@dataclass(frozen=True, eq=False)
class _Step:
    wish: Jog
    answer: Future[dict[str, str]] = field(default_factory=Future)


class Manual:
    """Manual mode of one cell, with the part of `job` out of the way. `notify` hears what becomes of presses."""

    def __init__(self, cell: Cell, job: Job, notify: Told) -> None:
        self.speed = 1.0
        self._cell = cell
        self._job = job
        self._notify = notify
        self._wanted: queue.SimpleQueue[_Step | Press] = queue.SimpleQueue()
        self._off = threading.Event()
        self._on = threading.Event()
        self._stepping = threading.Event()
        self._busy = threading.Lock()
        self._thread: threading.Thread | None = None
        self._failure: BaseException | None = None

    @property
    def on(self) -> bool:
        """Whether the cell is in manual mode."""
        return self._thread is not None and self._thread.is_alive() and self._on.is_set()

    def begin(self, by: str, timeout: float = 10.0) -> str:
        """Switch it on; raises what keeps it from being on, such as a run that is going on."""
        with self._busy:
            if self.on:
                return "manual mode is on"
            self._off.clear()
            self._on.clear()
            self._failure = None
            self._wanted = queue.SimpleQueue()
            work = partial(self._perform, by, self._cell.stops)
            self._thread = threading.Thread(target=work, name="manual mode", daemon=True)
            self._thread.start()
            while not self._on.wait(0.02) and self._thread.is_alive() and timeout > 0:
                timeout -= 0.02
            if self._failure is not None:
                raise self._failure
            if not self._on.is_set():
                self._off.set()
                raise InterlockError("cell", "manual mode could not be begun; see the log")
            return "manual mode is on"

    def end(self) -> str:
        """Switch it off: what moves is stopped."""
        self._off.set()
        # Nothing looks at `_off` during a step.
        if self._stepping.is_set() and (run := self._cell.current) is not None:
            run.abort("manual mode was switched off")
        return "manual mode is off"

    def join(self, timeout: float) -> None:
        """Wait until it is off."""
        if self._thread is not None:
            self._thread.join(timeout)

    def step(self, wish: Jog) -> dict[str, str]:
        """One step, to its end; where the device is then, in words. Raises what refuses it."""
        _require_small(wish)
        self._require_on()
        step = _Step(wish)
        self._wanted.put(step)
        while not wait([step.answer], 0.05).done:
            if not self.on:
                raise Aborted("manual mode has ended; the step was not done")
        return step.answer.result()

    def press(self, press: Press) -> None:
        """A button is held: move until it is not."""
        try:
            self._require_on()
        except InterlockError as error:
            press.end(str(error))
            self._notify(press, "refused", str(error))
            return
        self._wanted.put(press)

    def _perform(self, by: str, stops: int) -> None:
        try:
            self._cell.perform("jog", self._work, info={"moved": "manual mode", "by": by}, stops=stops)
        except (Aborted, CellError) as error:
            self._failure = error
            log.log(logging.INFO if isinstance(error, Aborted) else logging.WARNING, "manual mode: %s", error)
        finally:
            self._on.clear()

    def _work(self, context: WorkContext) -> None:
        # Begun anew after a fault that a person has confirmed: what was asked for meanwhile is not done now.
        while not self._wanted.empty():
            self._drop(self._wanted.get())
        self._on.set()
        while not self._off.is_set():
            context.check()
            with suppress(queue.Empty):
                wanted = self._wanted.get(timeout=LOOK_S)
                if isinstance(wanted, Press):
                    self._hold(wanted, context)
                else:
                    self._do_step(wanted, context)

    def _drop(self, wanted: _Step | Press) -> None:
        if isinstance(wanted, Press):
            wanted.end(NOT_DONE)
            self._notify(wanted, "refused", NOT_DONE)
        else:
            wanted.answer.set_exception(Aborted(NOT_DONE))

    def _do_step(self, step: _Step, context: WorkContext) -> None:
        wish = step.wish
        self._stepping.set()
        try:
            if self._off.is_set():
                raise Aborted("manual mode was switched off; the step was not done")
            step.answer.set_result(moved(self._cell, wish, self._job, context))
        except (Aborted, CellError) as error:
            step.answer.set_exception(error)
        finally:
            self._stepping.clear()
        failure = step.answer.exception()
        log.info("jog step: %s %s %+g: %s", wish.device, wish.axis, wish.amount, failure or step.answer.result())
        context.check()
        if _needs_person(failure):
            raise failure

    def _hold(self, press: Press, context: WorkContext) -> None:
        if press.over() is not None:
            self._notify(press, "ended", str(press.ended))
            return
        try:
            why = self._move(press, context)
        except CellError as error:
            press.end(str(error))
            context.check()
            self._notify(press, "refused", str(error))
            log.info("hold %s %s: %s", press.device, press.axis, error)
            if _needs_person(error):
                raise
            return
        press.end(why)
        self._notify(press, "ended", why)
        log.info("hold %s %s%s: %s", press.device, press.axis, "+" if press.sign > 0 else "-", why)

    def _move(self, press: Press, context: WorkContext) -> str:
        """Move until the press is over or the way ends; why it ended. The device stands then."""
        device: Any = getattr(self._cell.devices, press.device)
        bare = device.bare if isinstance(device, Gated) else device
        if not isinstance(bare, Attended):
            raise InterlockError(press.device, "nothing beside this program would stop it; move it by steps")
        if press.device == "arm":
            begin_program(device)
        with bare.attended() as beat:
            press.beat = beat
            motion = self._begin(press, device)
            try:
                self._notify(press, "moving", "")
                while (why := press.over()) is None and not motion.done and not self._off.is_set():
                    context.check()
                    press.wait(LOOK_S)
            finally:
                press.beat = None
                if not motion.done:
                    device.stop()
        # What switching off has stopped is done, too, short of its end.
        if why is None and not self._off.is_set():
            motion.wait(1.0)
            return "the way of one press ends here; press again"
        return why or "manual mode was switched off"

    def _begin(self, press: Press, device: Any) -> Motion:
        if press.device == "rail":
            return self._begin_rail(press.sign, device)
        if press.device == "arm":
            return self._begin_arm(press, device)
        raise InterlockError(press.device, "is moved by steps only")

    def _begin_rail(self, sign: int, rail: Rail) -> Motion:
        if not rail.state().homed:
            raise InterlockError("rail", "is not homed, so its limits are not known; home it first")
        speed = self.speed * rail_hold_speed(self._cell.config.rail)
        return rail.move_to(rail.travel[1] if sign > 0 else rail.travel[0], speed)

    def _begin_arm(self, press: Press, arm: Arm) -> Motion:
        if "vehicle" in self._cell.devices and self._cell.devices.vehicle.state().braked is not True:
            self._cell.devices.vehicle.recover()
        turning = press.axis.startswith("j")
        if press.axis not in ("x", "y", "z", "j1", "j2", "j3", "j4", "j5", "j6"):
            raise InterlockError("arm", f"axis {press.axis!r} is moved by steps only")
        refused: CellError | None = None
        for way in TURNS_RAD if turning else LINES_M:
            if press.over() is not None:
                break
            try:
                return self._turn(press, arm, way) if turning else self._line(press, arm, way)
            except (InterlockError, LimitError, ConfigError) as error:
                refused = error
        raise refused or InterlockError("arm", str(press.ended))

    def _turn(self, press: Press, arm: Arm, way: float) -> Motion:
        goal = arm.state().joints.copy()
        goal[int(press.axis[1]) - 1] += press.sign * way
        return arm.move_joints(goal, self.speed * HOLD_TURN, TURN_ACCELERATION)

    def _line(self, press: Press, arm: Arm, way: float) -> Motion:
        goal = arm.state().flange.copy()
        goal["xyz".index(press.axis)] += press.sign * way
        return arm.move_linear(np.asarray(goal), self.speed * HOLD_SPEED, LINE_ACCELERATION)

    def _require_on(self) -> None:
        if not self.on:
            raise InterlockError("cell", "is not in manual mode, in which alone something is jogged; switch it on")
        if (run := self._cell.current) is not None and run.control.question is not None:
            raise InterlockError("cell", "waits for a person; answer the question first, then jog again")


def _needs_person(ended: object) -> TypeGuard[DeviceFault]:
    """Whether the run has to ask a person before anything moves again."""
    return isinstance(ended, DeviceFault) and ended.code in CONFIRMED_BY_A_PERSON


def rail_hold_speed(config: RailConfig) -> float:
    """How fast a rail moves at most by holding, m/s."""
    return min(0.25 * config.max_speed, RAIL_BRAKING_S * config.acceleration)


def _require_small(wish: Jog) -> None:
    turning = wish.axis.startswith(("r", "j")) or wish.axis == "yaw"
    most, unit = (math.radians(MAX_ANGLE_DEG), "rad") if turning else (1e-3 * MAX_LENGTH_MM, "m")
    known = {"rail": ("",), "vehicle": ("x", "yaw"), "arm": ("x", "y", "z", "rx", "ry", "rz")}
    axes = (*known.get(wish.device, ()), *(f"j{k}" for k in range(1, 7) if wish.device == "arm"))
    if wish.axis not in axes:
        raise ConfigError(f"there is no {wish.device} {wish.axis} to jog")
    if not abs(wish.amount) <= most:
        raise LimitError(wish.device, f"a step of {wish.amount:g} {unit} is too large, allowed up to {most:g} {unit}")
