"""Making the arm safe without its child process: the program ended through the dashboard, the safe outputs off."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from drivers.arm.dashboard import Dashboard
from drivers.arm.link import see_safe
from drivers.errors import DeviceError
from drivers.interfaces import LinkStatistics

_DASHBOARD_S, _SEEN_S, _LEAST_S = 0.7, 1.9, 0.3
"""Seconds on the wall for ending the program and for switching off, and the least that another try is worth."""


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
        self._problem = ""

    def begin(self) -> threading.Thread:
        """The attempt that is under way, or a new one."""
        with self._lock:
            if self._attempt is None or not self._attempt.is_alive():
                self._attempt = threading.Thread(target=self._make_safe, name=f"{self._name} make safe", daemon=True)
                self._attempt.start()
            return self._attempt

    def confirm(self) -> str:
        """Wait for an attempt: what could not be confirmed, empty once the arm itself has shown that it is safe."""
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
        self._problem = "; ".join(problems)

    def _seen_safe(self, outputs: tuple[int, ...]) -> bool:
        end = time.monotonic() + _SEEN_S
        while (left := end - time.monotonic()) > _LEAST_S:
            if see_safe(self._address, outputs, deadline=left):
                return True
            self._statistics.count("emergency switching of outputs failed")
        return False
