"""`cell jog` without words: a person moves one axis at a time from the terminal, in steps or while a key is held.

A held key moves as long as the terminal answers quickly and has not reported the key's release; what stops the motion
when this program hangs or is killed stands beside the device (`drivers.interfaces.Attended`).
"""

from __future__ import annotations

import getpass
import math
import threading
import time
from typing import TYPE_CHECKING

from cell.console.holding import Press
from cell.console.manual import Manual
from cell.devices.jogging import Jog
from cell.job import Job
from cell.motion.arm_models import arm_kinematics
from cell.report.figures import simulated_words
from cell.terminal.keys import Focus, Heard, Key, Status
from cell.terminal.positions import LABEL, arm_lines, rail_lines, vehicle_lines
from cell.terminal.screen import Screen, TerminalGone, quits
from drivers.errors import Aborted, CellError
from drivers.interfaces import ATTENDED_S, RailState

if TYPE_CHECKING:
    from cell.supervisor import Cell

MOST_TRIP_S = 0.06
"""A terminal whose answers take longer is too far away to hold a key: its release would come late."""
LOOK_S, SHOW_S, RAIL_S = 0.01, 0.1, 0.5
IDLE_ASK_S = 0.3
AXES: tuple[tuple[str, str], ...] = (
    ("rail", ""), *(("arm", axis) for axis in ("x", "y", "z", "rx", "ry", "rz")),
    *(("arm", f"j{k}") for k in range(1, 7)), ("vehicle", "x"), ("vehicle", "yaw"),
)  # fmt: skip
HELD = frozenset((("rail", ""), *(("arm", axis) for axis in ("x", "y", "z", "j1", "j2", "j3", "j4", "j5", "j6"))))
"""What moves while a key is held; the others move by steps only."""
STEPS = {"mm": (0.1, 1.0, 5.0, 10.0, 50.0), "deg": (0.1, 0.5, 1.0, 5.0, 10.0)}
DRIVES = {"mm": (10.0, 20.0, 50.0, 100.0, 200.0), "deg": (1.0, 2.0, 5.0, 10.0, 20.0)}
SPEEDS = (0.1, 0.25, 0.5, 1.0)


class JogScreen:
    """The screen of one cell; `run` lasts until somebody leaves it."""

    def __init__(self, cell: Cell, job: Job, screen: Screen) -> None:
        self._cell, self._screen = cell, screen
        self._manual = Manual(cell, job, self._told)
        self._axis, self._size, self._speed = 0, 1, 2
        self._holding = screen.releases
        self._press: Press | None = None
        self._presses = 0
        self._step: threading.Thread | None = None
        self._said = "nothing has moved yet"
        self._rail: RailState | None = None
        self._looked = self._shown = self._asked = 0.0
        self._here = True
        limits = arm_kinematics(cell.config.arm.model, None).limits
        self._limits = limits.lower, limits.upper

    def run(self) -> None:
        """Jog until q, escape or Ctrl-C, or until the terminal is gone: then the cell is stopped."""
        try:
            while self._here:
                for heard in self._screen.read(LOOK_S):
                    self._take(heard)
                self._attend()
                self._show()
        except TerminalGone as error:
            self._said = str(error)
        finally:
            self._stop("the jog screen was left")
            self._manual.end()
            self._manual.join(5.0)

    # --- what is heard ---

    def _take(self, heard: Heard) -> None:
        if isinstance(heard, Status):
            if self._press is not None and self._near:
                self._press.renew()
        elif isinstance(heard, Focus):
            if not heard.here:
                self._stop("the terminal has lost the keyboard")
        elif quits(heard):
            self._here = False
        elif isinstance(heard, Key):
            self._key(heard)

    def _key(self, key: Key) -> None:
        if key.event == "release":
            if self._press is not None and key.name in ("left", "right"):
                self._press.end("the key was let go of")
            return
        if key.event == "repeat":
            return
        if self._press is not None and self._press.over() is None:
            # A second key is as good as a slip of the hand.
            self._press.end("another key was pressed")
            return
        match key.name:
            case "space":
                self._stop("stopped at the terminal")
            case "left" | "right":
                self._move(1 if key.name == "right" else -1)
            case "up" | "down":
                self._axis = (self._axis + (1 if key.name == "down" else -1)) % len(AXES)
            case "[" | "]":
                self._size = min(max(self._size + (1 if key.name == "]" else -1), 0), 4)
            case "," | ".":
                self._speed = min(max(self._speed + (1 if key.name == "." else -1), 0), len(SPEEDS) - 1)
            case "y" if self._question is not None and (run := self._cell.current) is not None:
                run.confirm(getpass.getuser(), self._question[0])
            case "tab":
                self._holding = not self._holding and self._screen.releases

    @property
    def _question(self) -> tuple[int, str] | None:
        run = self._cell.current
        return None if run is None else run.control.question

    @property
    def _near(self) -> bool:
        return self._screen.trip_s is not None and self._screen.trip_s <= MOST_TRIP_S

    def _attend(self) -> None:
        """Ask the terminal for a sign of life, and end a step that nobody is there to see."""
        stepping = self._step is not None and self._step.is_alive()
        now = time.monotonic()
        if self._press is not None or stepping or now - self._asked > IDLE_ASK_S:
            self._asked = now
            self._screen.ask()
        if self._press is not None and self._press.over() is not None:
            self._press = None
        if stepping and self._screen.silent_s > ATTENDED_S:
            self._stop("the terminal does not answer")

    # --- what moves ---

    def _move(self, sign: int) -> None:
        if self._step is not None and self._step.is_alive():
            self._said = "still moving; space stops it"
            return
        device, axis = AXES[self._axis]
        try:
            if not self._manual.on:
                self._manual.begin(getpass.getuser())
        except (CellError, Aborted) as error:
            self._said = str(error)
            return
        if not self._holding or AXES[self._axis] not in HELD:
            amount, unit = self._amount
            size = math.radians(amount) if unit == "deg" else 1e-3 * amount
            self._said = f"{device} {axis} {sign * amount:+g} {unit} …"
            wish = Jog(device, axis, sign * size)
            self._step = threading.Thread(target=self._do_step, args=(wish,), name="jog step", daemon=True)
            self._step.start()
        elif not self._near:
            self._said = f"the terminal answers too late to hold a key: {self._trip}; tab changes to steps"
        else:
            self._presses += 1
            self._manual.speed = SPEEDS[self._speed]
            self._press = Press("terminal", self._presses, device, axis, sign)
            self._manual.press(self._press)

    def _do_step(self, wish: Jog) -> None:
        try:
            told = self._manual.step(wish)
            self._said = "  ".join(f"{name} {value}" for name, value in told.items())
        except (CellError, Aborted) as error:
            self._said = str(error)

    def _stop(self, why: str) -> None:
        if self._press is not None:
            self._press.end(why)
        if self._step is not None and self._step.is_alive() and (run := self._cell.current) is not None:
            run.abort(why)

    def _told(self, press: Press, state: str, text: str) -> None:
        self._said = f"{press.device} {press.axis} {state}: {text}" if text else f"{press.device} {press.axis} {state}"

    # --- what is shown ---

    @property
    def _amount(self) -> tuple[float, str]:
        device, axis = AXES[self._axis]
        unit = "deg" if axis.startswith(("r", "j")) or axis == "yaw" else "mm"
        return (DRIVES if device == "vehicle" else STEPS)[unit][self._size], unit

    @property
    def _trip(self) -> str:
        trip = self._screen.trip_s
        return "no answer yet" if trip is None else f"{1e3 * trip:.0f} ms, allowed {1e3 * MOST_TRIP_S:.0f} ms"

    def _show(self) -> None:
        now = time.monotonic()
        if now - self._shown < SHOW_S:
            return
        self._shown = now
        device, axis = AXES[self._axis]
        held = self._holding and AXES[self._axis] in HELD
        amount, unit = self._amount
        mode = (
            f"moves while held, {100 * SPEEDS[self._speed]:.0f} % of the jog speed"
            if held
            else f"steps of {amount:g} {unit}"
        )
        config = self._cell.config.cell
        world = simulated_words(bool(config.truth) or list(config.sim)).upper() or "REAL"
        can = "" if self._screen.releases else "This terminal does not report a key's release: steps only."
        rows = [
            f"{which:<{LABEL}}"
            + "".join(f"[{a}]" if (d, a) == (device, axis or "along") else f" {a} " for d, a in shown)
            for which in ("rail", "arm", "vehicle")
            if (shown := [(d, a or "along") for d, a in AXES if d == which])
        ]
        self._screen.show([
            f"jog · cell {config.name} · {world} · not an emergency stop",
            "",
            *rows,
            "",
            f"{f'{device} {axis}'.strip()}: {mode}",
            can,
            *self._positions(now),
            "",
            self._said,
            "" if (asked := self._question) is None else f"{asked[1]} y: I have looked, unlock it",
            "↑ ↓ axis  ← → move  [ ] step  , . speed  tab hold or step  space stop  q leave",
        ])  # fmt: skip

    def _positions(self, now: float) -> list[str]:
        devices = self._cell.devices
        rate = devices.clock.rate
        why: dict[str, str] = {}
        arm = vehicle = None
        try:
            arm = devices.arm.state(rate)
        except CellError as error:
            why["arm"] = str(error)
        try:
            vehicle = devices.vehicle.state(rate)
        except CellError as error:
            why["vehicle"] = str(error)
        # A rail on a serial line answers one question at a time: while it moves it is left alone.
        still = self._press is None and (self._step is None or not self._step.is_alive())
        if still and now - self._looked > RAIL_S:
            self._looked = now
            try:
                self._rail = devices.rail.state()
            except CellError as error:
                self._rail, why["rail"] = None, str(error)
        return [
            *arm_lines(arm, self._limits, why.get("arm", "")),
            *rail_lines(self._rail, devices.rail.travel, why.get("rail", "")),
            *vehicle_lines(vehicle, why.get("vehicle", "")),
        ]
