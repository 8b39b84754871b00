"""The arm driver's connection over its life: begun, lost, made safe, recovered, stopped as it recovers, closed."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace

from drivers.arm.dashboard import Dashboard
from drivers.arm.factory import Forward, flange_agrees, require_same_flange, require_same_payload, same_payload
from drivers.arm.faults import fault, require_named, require_remote, unlock
from drivers.arm.feed import MODE_RUNNING, PLAYING, ChildSetup, Ended, Snapshot, StateFeed, safety_code
from drivers.arm.link import ArmLink, probe, see_safe
from drivers.clock import Clock
from drivers.errors import Aborted, DeadlineError, DeviceError, DeviceFault, InterlockError, NotConnectedError, shown
from drivers.interfaces import LinkStatistics

_DASHBOARD_S, _SEEN_S, _LEAST_S = 0.7, 1.9, 0.3
"""Seconds on the wall for ending the program and for switching off, and the least that another try is worth."""
_JUST_S = 0.2
"""So soon after an attempt that failed an output alone begins no other one: who closes a cell has stopped it."""


class Safing:
    """One attempt at a time, shared by all who ask for it; each ends within 2.6 s, whatever the arm does."""

    def __init__(
        self, name: str, address: str, outputs: Callable[[], tuple[int, ...]], statistics: LinkStatistics
    ) -> None:
        self._name = name
        self._address = address
        self._outputs = outputs
        self._statistics = statistics
        self._lock = threading.Lock()
        self._attempt: threading.Thread | None = None
        self._problem, self._ended = "", 0.0

    def begin(self) -> threading.Thread:
        """The attempt that is under way, or a new one."""
        with self._lock:
            if self._attempt is None or not self._attempt.is_alive():
                self._attempt = threading.Thread(target=self._make_safe, name=f"{self._name} make safe", daemon=True)
                self._attempt.start()
            return self._attempt

    def confirm(self, just: float = 0.0) -> str:
        """Wait for an attempt, where none has failed within the last `just` s: what could not be confirmed, empty once
        the arm itself has shown that it is safe."""
        if not self._problem or time.monotonic() - self._ended > just:
            self.begin().join()
        return self._problem

    def join(self) -> None:
        """Wait for the attempt that is under way, if there is one."""
        if self._attempt is not None:
            self._attempt.join()

    def _make_safe(self) -> None:
        problems = []
        try:
            Dashboard(self._name, self._address, timeout=_DASHBOARD_S).ask("stop")
        except DeviceError as error:
            self._statistics.count("emergency stop of the program failed")
            problems.append(f"its program was not ended: {error.message}")
        safe_off = self._outputs()
        if not self._seen_safe(safe_off):
            outputs = f" and outputs {', '.join(map(str, safe_off))} off" if safe_off else ""
            problems.append(f"the arm was not seen at rest{outputs}")
        self._problem, self._ended = "; ".join(problems), time.monotonic()

    def _seen_safe(self, outputs: tuple[int, ...]) -> bool:
        end = time.monotonic() + _SEEN_S
        while (left := end - time.monotonic()) > _LEAST_S:
            if see_safe(self._address, outputs, deadline=left):
                return True
            self._statistics.count("emergency switching of outputs failed")
        return False


CALL_S = 5.0
_STOP_S = 2.0
"""What the child has for a stop. The other way takes 2.6 s more; together they fit the 5 s of a cell's safe stop."""
_OUTPUT_S = 1.0
_CLOSE_S = 4.0
_TOOL_S = 0.5
_STARTING_S = 0.5
"""After connecting; a program that is ended later was not ended by the watchdog because the new child came late."""


class ArmSession:
    """One arm as `setup` says, through one child process after the other; `link` is the present one. `on_ended` is told
    how each motion ended, `on_broken` why none can go on. Times are wall seconds."""

    def __init__(
        self, name: str, setup: ChildSetup, clock: Clock, connect_timeout: float, forward: Forward | None,
        unknown: str, on_ended: Callable[[Ended], None], on_broken: Callable[[Exception], None],
    ) -> None:  # fmt: skip
        """Connect. Raises `NotConnectedError`; `DeviceFault` in local control, and for another arm than it has to be.
        `unknown` says why the controller's own table is not known, if it is not."""
        self.setup = setup
        self.statistics = LinkStatistics()
        self.dashboard = Dashboard(name, setup.address, traffic=self.statistics.traffic)
        self.feed = StateFeed(name, clock, lambda: self.link.lost is not None, self.require_link, self.statistics)
        self._name = name
        self._clock = clock
        self._connect_timeout = connect_timeout
        self._forward, self._unknown = forward, unknown
        self._on_ended, self._on_broken = on_ended, on_broken
        self._safing = Safing(name, setup.address, lambda: self.setup.safe_off, self.statistics)
        self._closed = False
        self._stops = 0
        self._counting, self._recovering, self._comparing = threading.Lock(), threading.Lock(), threading.Lock()
        probe(name, setup.address, clock, connect_timeout)
        if setup.control:
            self.require_remote()
            # One that does not answer is left to the connection, which says more.
            with suppress(DeadlineError, NotConnectedError):
                require_named(name, self.dashboard, setup.model)
        self.link = self._connect(lambda: True)
        try:
            self._require_model()
        except BaseException:
            self.close()
            raise

    def require_link(self) -> None:
        """Raise the error that says why nothing can be asked of the arm, if any."""
        self._require_open()
        if self.link.lost is not None:
            raise self.link.lost

    def require_control(self) -> None:
        """Raise `InterlockError` when the arm is only looked at."""
        if not self.setup.control:
            raise InterlockError(
                self._name, "is connected only to be looked at; nothing was sent. Connect with control=True first."
            )

    def require_remote(self) -> None:
        """Raise the `DeviceFault` of an arm in local control; one whose dashboard is silent is left to its link."""
        with suppress(DeadlineError, NotConnectedError):
            require_remote(self._name, self.dashboard)

    def require_ready(self) -> None:
        """Raise the `DeviceFault` that keeps the arm from moving, if any."""
        snapshot, _ = self.feed.fresh(0.1)
        if code := safety_code(snapshot.safety_bits):
            raise fault(self._name, code)
        if snapshot.mode != MODE_RUNNING:
            raise fault(self._name, "arm.not_powered")
        if not snapshot.program_running:
            raise fault(self._name, "arm.program_stopped")

    def require_same_arm(self) -> None:
        """Raise `DeviceFault` unless flange and payload are what the caller's model and this driver have them for."""
        if self._forward is not None:
            with self._comparing:
                require_same_flange(self._name, self._forward, self.feed.fresh(0.1)[0], self._unknown)
        # What was just set may not be shown yet.
        if not self.feed.wait_for(lambda snapshot: same_payload(snapshot, self.setup.payload), _TOOL_S):
            require_same_payload(self._name, self.feed.fresh(0.1)[0], self.setup.payload)

    def ask(self, name: str, *arguments: object, deadline: float = CALL_S) -> None:
        """Have the child do something; see `ArmLink.call`. `Aborted` when a stop overtook it."""
        self.require_control()
        self.require_link()
        self.statistics.traffic.sent((name, arguments))
        problem = self.link.call(name, *arguments, deadline=deadline)
        if problem is not None:
            if problem[0] == "arm.stopped":
                raise Aborted(f"{self._name}: {name} was dropped because the arm was stopped")
            raise fault(self._name, *problem)

    def set_output(self, index: int, value: bool) -> None:
        """Set a digital output and return once the arm shows it; a safe one goes off without the link as well."""
        self.require_control()
        try:
            self._set_output(index, value)
        except DeviceFault as error:
            if value or index not in self.setup.safe_off:
                raise
            self._require_safe_without(error, _JUST_S)

    @contextmanager
    def trying(self, index: int) -> Iterator[None]:
        """Inside the context this output counts as one of those that are switched off for safety."""
        before = self.setup.safe_off
        if index in before:
            yield
            return
        self._keep_off((*before, index))
        try:
            yield
        finally:
            self._keep_off(before)

    def _keep_off(self, outputs: tuple[int, ...]) -> None:
        # Known here first: should the child be lost meanwhile, the other way takes them from here.
        self.setup = replace(self.setup, safe_off=outputs)
        self.ask("safe_off", outputs, deadline=_OUTPUT_S)

    def stop(self) -> None:
        """Bring the arm to rest, and a recovery to its end; without the link by the other way."""
        self.require_control()
        with self._counting:
            self._stops += 1
        try:
            self.ask("stop", deadline=_STOP_S)
        except DeviceFault as error:
            self._require_safe_without(error)

    def recover(self, confirmed: bool) -> None:
        self.require_control()
        with self._counting:
            stops = self._stops
        with self._recovering:
            self._require_open()
            require_remote(self._name, self.dashboard)
            self.dashboard.ask("stop")
            unlock(self._name, self.dashboard, self._clock, confirmed, lambda: self._require_no_stop_since(stops))
            if self._begin_anew(stops):
                # On a busy machine the new child may come too late for the controller's watchdog: once more.
                self.statistics.count("started again")
                self._begin_anew(stops)
            self.require_ready()
            self._require_model()

    def _begin_anew(self, stops: int) -> bool:
        """Whether the new program has ended at once, and not because a person has paused or ended it at the pendant."""
        self.link.close(_CLOSE_S)
        self._on_broken(fault(self._name, "arm.program_stopped", "the arm was recovered"))
        self._safing.join()
        self.feed.forget()
        seen: list[int] = []
        with self.feed.listening(lambda snapshot: seen.append(snapshot.runtime)):
            self._reconnect(stops)
            connected = time.monotonic()
            running = self.feed.fresh(0.1)[0].program_running
        at_once = time.monotonic() - connected < _STARTING_S
        return not running and at_once and all(runtime <= PLAYING for runtime in seen)

    def _reconnect(self, stops: int) -> None:
        try:
            self._require_no_stop_since(stops)
            try:
                link = self._connect(lambda: self._stops == stops)
            except Aborted:
                # Its script may have been on the way already.
                self.dashboard.ask("stop")
                raise
            with self._counting:
                if self._stops == stops:
                    self.link = link
                    return
            link.close(_CLOSE_S)
            self._require_no_stop_since(stops)
        except BaseException as error:
            # No longer one that is closed to be opened again, which others wait for.
            self.link.lost = fault(self._name, "arm.link_lost", f"not connected again: {error}")
            raise

    def _require_no_stop_since(self, stops: int) -> None:
        if self._stops != stops:
            raise Aborted(f"{self._name}: recover was ended by a stop; it has to be called anew")

    def close(self) -> None:
        """End a recovery, stop the arm, switch the safe outputs off and end the child; idempotent, bounded in time."""
        if self._closed:
            return
        self._closed = True
        with self._counting:
            self._stops += 1
        with self._recovering:
            self.link.close(_CLOSE_S)
        self._on_broken(NotConnectedError(self._name, "the driver was closed"))
        self._safing.join()
        self.dashboard.close()

    def _connect(self, wanted: Callable[[], bool]) -> ArmLink:
        return ArmLink(
            self._name, self.setup, self._connect_timeout, on_snapshot=self._take, on_ended=self._on_ended,
            on_lost=self._on_lost, wanted=wanted,
        )  # fmt: skip

    def _take(self, snapshot: Snapshot) -> None:
        self.statistics.traffic.received(snapshot)
        self.feed.take(snapshot)

    def _on_lost(self, error: DeviceFault) -> None:
        self.statistics.count("link lost")
        if self.setup.control:
            self._safing.begin()
        self._on_broken(error)
        self.feed.wake()

    def _require_open(self) -> None:
        if self._closed:
            raise NotConnectedError(self._name, "the driver was closed. Open a new one.")

    def _require_model(self) -> None:
        """As `require_same_arm`, but the first states may still be with another tool than the zero one just set.
        Without the control program the tool may be any, so nothing is compared, but nothing moves then either."""
        forward = self._forward
        if forward is None or not self.setup.control or not self.feed.fresh(0.1)[0].program_running:
            return
        with self._comparing:
            self.feed.wait_for(lambda snapshot: flange_agrees(forward, snapshot), _TOOL_S)
        self.require_same_arm()

    def _require_safe_without(self, error: DeviceFault, just: float = 0.0) -> None:
        """After a call that failed: return once the arm is safe by the other way, else say that it is not known to be.
        A fault of anything but the link is raised as it is."""
        if error.code not in ("arm.link_lost", "arm.link_closed", "arm.not_stopped"):
            raise error
        if problem := self._safing.confirm(just):
            raise fault(self._name, "arm.not_safe", f"{error.message} Without it: {problem}") from error

    def _set_output(self, index: int, value: bool) -> None:
        called = time.monotonic()
        self.ask("output", index, value, deadline=_OUTPUT_S)

        def shows(snapshot: Snapshot) -> bool:
            return snapshot.stamp >= called and bool(snapshot.outputs >> index & 1) == value

        if not self.feed.wait_for(shows, _OUTPUT_S):
            self.statistics.count("output not shown")
            raise DeadlineError(
                self._name,
                f"output {index} was set to {value}, but the arm did not show it within {shown(_OUTPUT_S, 's')}. "
                "See that no other program sets this output, and that the control program runs: without it those that "
                "are switched off for safety are kept low.",
            )
