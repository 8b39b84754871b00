"""Looks at the cell twenty times a second and tells the server; nothing of the cell ever waits for it."""

import json
import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from cell.apps.console.host.controller import ConsoleController
from cell.apps.console.host.link import CloudPart, Happened, Show, ShownPicture
from cell.apps.console.view.archive import true_error_mm
from cell.apps.console.view.readings import Readings
from cell.apps.console.view.run_view import GrowingCloud, Pictures, RunView
from cell.apps.console.view.scene import SceneNow
from cell.base.lateness import busy_words
from cell.config.job import load_job
from cell.measure.geometry.poses import from_ur
from cell.procedures.steps.kinds import kind_of
from cell.run.folder import list_runs, read_report
from cell.run.runs import Run
from cell.run.session.supervisor import Cell
from drivers.errors import CellError

PERIOD_S = 0.05
EVERY = 2
"""Pictures and cloud at every so many-th look."""
RECENT_RUNS = 20

log = logging.getLogger(__name__)


class CellObserver:
    """Of one cell and its controller; `notify` gives a message to the server."""

    def __init__(self, cell: Cell, controller: ConsoleController, notify: Callable[[object], None]) -> None:
        self._cell, self._controller, self._notify = cell, controller, notify
        simulated = () if cell.simulated is None else cell.simulated.simulated
        # On the virtual clock the devices have no time of the wall, and are not to be looked at by another thread.
        self._virtual = cell.simulated is not None and cell.simulated.facts.get("clock") == "virtual"
        self._readings = Readings(cell.config, cell.devices, simulated)
        self._view: RunView | None = None
        self._named: tuple[Run[object], str | None] | None = None
        self._pictures = Pictures()
        self._cloud = GrowingCloud()
        self._now = SceneNow()
        self._last: dict[str, object] | None = None
        self._faults: list[dict[str, object]] = []
        self._count = 0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._perform, name="console look", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def close(self) -> None:
        """Look no more."""
        self._over.set()
        self._thread.join(2.0)

    def began(self, run: Run[object], job: str | None) -> None:
        """This run was begun, of this job if it is one."""
        self._named = run, job

    def _perform(self) -> None:
        due = time.monotonic()
        while not self._over.wait(max(0.0, due - time.monotonic())):
            due = max(due + PERIOD_S, time.monotonic())
            try:
                self._observe()
            # One look that fails is no reason to look no more.
            except Exception:
                log.exception("the console's look failed")
                self._over.wait(1.0)

    def _observe(self) -> None:
        self._count += 1
        self._follow_run()
        run = self._cell.current
        if not self._virtual:
            self._readings.look(idle=run is None)
        view = self._view
        told = None if view is None or view.over else view.as_dict()
        self._notify(Show(json.dumps(self._state(view, told))))
        if view is not None and self._count % EVERY == 0:
            self._show(view.run)

    def _state(self, view: RunView | None, told: dict[str, Any] | None) -> dict[str, object]:
        readings, controller = self._readings, self._controller
        faults = [*self._faults, *(view.faults if view is not None and told is not None else [])]
        return {
            "type": "state", "n": self._count, "t": round(time.time(), 3),
            "cell_s": round(self._cell.devices.clock.now(), 3),
            **readings.motion(), **self._now.as_dict(self._cell.devices.interlocks.situation), "run": told,
            "question": controller.questions.present(view if told is not None else None),
            "last": controller.with_finding(self._last), "faults": faults[-8:],
            "devices": {} if self._virtual else readings.devices("" if told is None else told["kind"]),
            "safety": readings.safety(), "holder": controller.holders.holder, "clients": controller.holders.rows(),
            "starting": controller.starting, "queue": controller.queue.as_dict(),
            "manual": controller.manual.on, "jog": controller.jogging(), "speed": controller.manual.speed,
            "pace": self._cell.pace, "dry_run": controller.rehearsals.present, "busy": busy_words(),
        }  # fmt: skip

    def _follow_run(self) -> None:
        run = self._cell.current
        if run is not None and (self._view is None or self._view.run is not run):
            self._end_view()
            self._view = self._viewed(run)
            self._cloud = GrowingCloud()
        if self._view is None:
            return
        for event in self._view.news():
            if (event["kind"], event["step"]) == ("step_started", "laser_sweep"):
                self._cloud = GrowingCloud()
            self._notify(Happened(json.dumps(event, default=str)))
        if self._view.over:
            self._end_view()

    def _end_view(self) -> None:
        if (view := self._view) is None:
            return
        if view.ended is not None:
            self._last = {**view.ended, "figure": _figure(view)}
        self._faults = [*self._faults, *({**fault, "over": True} for fault in view.faults)][-8:]
        self._view = None

    def _viewed(self, run: Run[object]) -> RunView:
        named = self._named
        job = named[1] if named is not None and named[0] is run else None
        if run.kind == "job" and job is None:
            job = self._controller.queue.job or self._controller.job
        steps: tuple[str, ...] = ()
        if run.kind == "job" and job is not None:
            with suppress(CellError):
                steps = kind_of(load_job(job)[0]).names
        return RunView(run, steps, job, self._expected(job) if steps else {})

    def _expected(self, job: str | None) -> dict[str, float]:
        """Wall seconds of each step in the newest run of this job that came to its end."""
        for folder in reversed(list_runs(self._cell.runs_folder)[-RECENT_RUNS:]):
            with suppress(CellError, OSError, KeyError, TypeError, ValueError):
                report = read_report(folder)
                ended = report["outcome"] in ("placed", "done")
                if ended and report.get("job") == job and report.get("clock") == "wall":
                    return {step["name"]: float(step["wall_s"]) for step in report["steps"]}
        return {}

    def _show(self, run: Run[object]) -> None:
        newest = self._pictures.newest(run)
        if newest is not None:
            self._notify(ShownPicture(*newest))
        arm = self._readings.arm
        flange = None if arm is None else from_ur(arm.flange).homogeneous
        rail = self._cell.devices.rail.motion if "rail" in self._cell.devices else None
        folder = None if run.folder is None else run.folder.name
        for part in (self._cloud.increment(run, flange, rail), self._cloud.final(run)):
            if part is not None:
                header, payload = part
                self._notify(CloudPart({**header, "run": folder}, payload))


def _figure(view: RunView) -> dict[str, object] | None:
    """A placed job's place error in mm: the true one where a simulated world tells it, else the stated bound."""
    if view.ended is None or view.ended["outcome"] != "placed" or view.run.folder is None:
        return None
    with suppress(CellError, OSError, KeyError, TypeError, ValueError):
        report = read_report(view.run.folder)
        if (true := true_error_mm(report)) is not None:
            return {"mm": true, "kind": "true"}
        return {"mm": float(report["place_bound_95"]["d"]), "kind": "stated"}
    return None
