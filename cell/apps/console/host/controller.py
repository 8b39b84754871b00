"""What a page may ask of the cell, by the words of the command line, and who may ask it.

Whoever asks is answered by a thread of its own, so that nothing waits behind something long. The stop is not here: it
has a way of its own (`cell.apps.console.host.link`), and asks nobody. What a person has to decide is asked here, too: a
step was refused, or a fault waits for somebody's word.
"""

import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from cell.apps.console.host.manual import Manual, Press, Presses
from cell.apps.console.host.part_queue import PartQueue
from cell.apps.console.host.rehearsal import Rehearsals
from cell.apps.console.server.access import Holders, checked_command, checked_message
from cell.apps.console.view.run_view import RunView
from cell.config.job import item_names, load_job, require_job_name
from cell.devices.diagnosis.diagnosis import ask
from cell.devices.gate.gate import Gated
from cell.procedures.calibrate.verification import Verification
from cell.procedures.steps.kinds import kind_of
from cell.run.jogging import Jog
from cell.run.runs import Run
from cell.run.session.supervisor import Cell
from drivers.errors import CellError, ConfigError, InterlockError, Measured, RefusedError
from statemachine.runner import Again, Script
from statemachine.step import Failure

LOOK_S = 0.05
CONFIRM, AGAIN, ABORT = "confirm", "again", "abort"


class Questions:
    """The question of the run that goes on, if it has one; `script` is what a job is begun with, so that it asks."""

    def __init__(self) -> None:
        self._run: Run[object] | None = None
        self._lock = threading.Lock()
        self._numbers = 0
        self._refusal: dict[str, Any] | None = None
        self._answer: tuple[str, str | None, str] | None = None
        self._answered = threading.Event()

    def script(self, steps: tuple[str, ...], seen: Callable[[], bool] = lambda: True) -> Script:
        """Asks about each refusal of a run of these steps, and waits; `hold` tells it the run once it is there. Nobody
        is asked, and the refusal ends the run, when it is not `seen` by anybody then."""
        self._run = None
        return Script(on_refusal=lambda name, failure: self._ask(name, failure, steps) if seen() else None)

    def hold(self, run: Run[object]) -> None:
        """This is the run that asks."""
        self._run = run

    def present(self, view: RunView | None) -> dict[str, object] | None:
        """The question as the page shows it, or None."""
        if (refusal := self._refusal) is not None:
            return refusal
        if view is None or view.asked is None:
            return None
        run = view.run
        choices: list[dict[str, object]] = [{"choice": CONFIRM}, {"choice": ABORT}]
        return {"kind": "confirm", **view.asked, "numbers": [], "picture": _picture(run), "choices": choices}

    def decide(self, run: Run[object], number: int, choice: str, step: str | None, by: str, reason: str) -> str:
        """A person's answer; `ConfigError` when it fits no question, or names nobody and no reason."""
        by, reason = " ".join(by.split()), " ".join(reason.split())
        if not by or not reason:
            raise ConfigError("a decision needs the name of who decides, and the reason; both are recorded")
        said = f"{by}: {reason}"
        with self._lock:
            refusal = self._refusal
            if refusal is None:
                return self._confirm(run, number, choice, said)
            if number != refusal["number"]:
                raise ConfigError(f"question {number} is not asked any more; it is now question {refusal['number']}")
            steps = next(row["steps"] for row in refusal["choices"] if row["choice"] == AGAIN)
            if choice not in (AGAIN, ABORT) or (choice == AGAIN and step not in steps):
                raise ConfigError(f"{choice} {step or ''} is no choice here: again from {', '.join(steps)}, or abort")
            self._answer = choice, step, said
            self._answered.set()
        return f"again from {step}" if choice == AGAIN else "the run ends"

    def _confirm(self, run: Run[object], number: int, choice: str, said: str) -> str:
        if choice == ABORT:
            run.abort(said)
            return "the run ends"
        if choice != CONFIRM:
            raise ConfigError(f"{choice!r} is no choice here: confirm, or abort")
        if not run.confirm(said, number):
            raise ConfigError(f"question {number} is not asked any more; nothing was confirmed")
        return f"question {number} is confirmed"

    def _given(self) -> tuple[str, str | None, str]:
        with self._lock:
            return self._answer or (ABORT, None, "no answer was given")

    def _ask(self, name: str, failure: Failure, steps: tuple[str, ...]) -> Again | None:
        """Called by the run, with the cell at rest."""
        with self._lock:
            self._numbers += 1
            self._answer = None
            self._answered.clear()
            allowed = list(steps[: steps.index(name) + 1])
            self._refusal = {
                "number": self._numbers, "kind": "refusal", "step": name, "code": failure.code,
                "reason": failure.reason, "numbers": _numbers(failure.error), "picture": _picture(self._run),
                "choices": [{"choice": AGAIN, "steps": allowed}, {"choice": ABORT}],
            }  # fmt: skip
        try:
            while not self._answered.wait(LOOK_S):
                run = self._run
                if run is not None and run.control.token.reason is not None:
                    return None
            choice, step, said = self._given()
        finally:
            with self._lock:
                self._refusal = None
        if choice == AGAIN and step is not None:
            return Again(step, said)
        raise RefusedError(f"{failure.reason}; {said}, and let the run end").showing(*_measured(failure.error))


def _measured(error: BaseException | None) -> tuple[Measured, ...]:
    return error.numbers if isinstance(error, RefusedError) else ()


def _numbers(error: BaseException | None) -> list[dict[str, object]]:
    rows = [number.as_dict() for number in _measured(error)]
    return [{"name": row["name"], "value": row["value"], "limit": row["limit"], "unit": row["unit"], "ok": row["kept"]}
            for row in rows]  # fmt: skip


def _picture(run: Run[object] | None) -> str | None:
    """Where the page finds what was looked at last."""
    if run is None or run.folder is None or run.frames is None or not run.frames.recent:
        return None
    return f"/api/runs/{run.folder.name}/pictures/{run.frames.recent[-1]}"


FREE = ("hold",)
"""What a page may do that does not hold the cell."""
SOON_S = 0.1
"""Wall seconds that a command which begins something waits for a refusal, before it answers "starting"."""

Words = Mapping[str, Any]
Answer = dict[str, object]

log = logging.getLogger(__name__)


class ConsoleController:
    """Of one cell. `say(client, message)` sends something to one page, `began(run, job)` hears of each run."""

    def __init__(
        self, cell: Cell, job: str, say: Callable[[str, dict[str, object]], None],
        began: Callable[[Run[object], str | None], None] = lambda run, job: None,
    ) -> None:  # fmt: skip
        self.cell, self.job = cell, job
        self.questions, self.rehearsals, self.queue = Questions(), Rehearsals(cell), PartQueue(cell)
        self.holders, self.presses = Holders(self._lost), Presses()
        self._say, self._began = say, began
        self._beginning = threading.Lock()
        self.starting: str | None = None
        """What was asked for and has not begun yet."""
        self._found: tuple[str, str] | None = None
        self.manual = Manual(cell, load_job(job)[0], self._pressed)
        self._doing: dict[str, Callable[[str, Words], Answer | str]] = {
            "hold": lambda client, words: self.holders.hold(client, words["name"]),
            "leave": lambda client, words: self.holders.leave(client),
            "hand_over": lambda client, words: self.holders.hand_over(client, words["to"]),
            "clear_stop": self._clear_stop,
            "start": self._start,
            "resume": self._resume,
            "dry_run": lambda client, words: self.rehearsals.begin(self.named_job(words["job"]), self._seed(words)),
            "cancel_dry_run": lambda client, words: self.rehearsals.cancel(),
            "pause": lambda client, words: self._running("pause", Run.pause),
            "go_on": lambda client, words: self._running("go on", Run.go_on),
            "queue": lambda client, words: self.queue.want(words["parts"]),
            "abort": lambda client, words: self._running(
                "end", lambda run: run.abort(f"{self.holders.name(client)}: {words['reason']}")
            ),
            "decide": self._decide,
            "calibrate": lambda client, words: self._long(
                client, "calibration", lambda: cell.calibrate(job=self.named_job(words["job"]))
            ),
            "verify": lambda client, words: self._long(
                client, "verification", lambda: cell.verify(job=self.named_job(words["job"]))
            ),
            "home": lambda client, words: self._long(client, "homing", lambda: cell.home(words["device"])),
            "recover": self._recover,
            "diag": lambda client, words: self._diag(),
            "manual": self._manual,
            "jog_step": self._jog_step,
            "speed": self._speed,
            "pace": self._pace,
        }

    def left(self, client: str) -> None:
        """A page is gone: what it held stops."""
        self.presses.left(client)
        self.holders.left(client)

    def do(self, client: str, words: Words) -> Answer:
        """Do what a page asks; its answer as docs/reference/console.md has it. Raises `CellError` for what is
        refused."""
        checked, name = checked_command(words), str(words["do"])
        if name not in FREE:
            self.holders.require(client)
        log.info("%s (%s): %s", self.holders.name(client), client, name)
        answer = self._doing[name](client, checked)
        return {"ok": True, **({"text": answer} if isinstance(answer, str) else answer)}

    def beat(self, client: str, words: Words) -> None:
        """A page says that a button is held; `ConfigError` for what is not understood."""
        held = checked_message(words)
        number = held["press"]
        if self.holders.holder != client or not self.manual.on:
            self.presses.end(client, "this page does not hold the cell")
            self._say(client, {"type": "jog", "press": number, "state": "refused", "text": self._why_not(client)})
            return
        press = self.presses.beat(client, number, held["device"], held["axis"], sign=held["sign"], at_ms=held["at"])
        if press is not None:
            self.manual.press(press)

    def jog_end(self, client: str) -> None:
        """A page says that the button is up."""
        self.presses.end(client, "the button was let go of")

    def jogging(self) -> dict[str, object] | None:
        """What is moved by holding now."""
        press = self.presses.present
        if press is None or press.ended is not None or press.beat is None:
            return None
        return {"device": press.device, "axis": press.axis, "sign": press.sign}

    def with_finding(self, last: dict[str, object] | None) -> dict[str, object] | None:
        """How the last run ended; a verification with what it found."""
        if last is None or self._found is None or last["run"] != self._found[0]:
            return last
        return {**last, "reason": self._found[1]}

    def close(self) -> None:
        """The console ends: what is held stops."""
        self.presses.end_all("the console ends")
        self.queue.close()
        self.rehearsals.close()
        self.manual.end()
        self.manual.join(5.0)

    def _lost(self) -> None:
        self.presses.end_all("the cell was let go of")
        self.manual.end()

    def _pressed(self, press: Press, state: str, text: str) -> None:
        self._say(press.client, {"type": "jog", "press": press.number, "state": state, "text": text})

    def _why_not(self, client: str) -> str:
        try:
            self.holders.require(client)
        except InterlockError as error:
            return str(error)
        return "the cell is not in manual mode, in which alone something is jogged; switch it on"

    def _start(self, client: str, words: Words) -> str:
        job = self.named_job(words["job"])
        until, at_start, count = words["until"], words["at_start"], words["count"]
        self.queue.require_none()
        if count > 1 or len(item_names(job)) > 1:
            if until is not None:
                raise ConfigError("a batch does each part to its end; leave `until` out, or start one part")
            return self._long(client, f"batch of {job}", lambda: self.queue.perform(job, count, at_start=at_start))

        def begin() -> None:
            run = self.cell.start(job, at_start=at_start, until=until, script=self._script(job))
            self.questions.hold(run)
            self._began(run, job)

        return self._soon(client, f"job {job}", begin)

    def _script(self, job: str) -> Script:
        return self.questions.script(kind_of(load_job(job)[0]).names)

    def _require_nothing_starting(self) -> None:
        """Take `_beginning`, or raise `InterlockError` while something else has it."""
        if not self._beginning.acquire(blocking=False):
            busy = f"is starting {self.starting}" if self.starting else "is being asked something else"
            raise InterlockError("cell", f"{busy}; wait a moment, then look before you press again")

    @contextmanager
    def _nothing_starting(self) -> Iterator[None]:
        self._require_nothing_starting()
        try:
            yield
        finally:
            self._beginning.release()

    def _soon(self, client: str, what: str, begin: Callable[[], None]) -> str:
        """Begin beside this command, which answers at once; a refusal that comes later is told to the page."""
        if (going := self.cell.current) is not None:
            raise InterlockError("cell", f"a {going.kind} is going on; wait for its end or abort it, then begin again")
        self._require_nothing_starting()
        self.starting = what
        stops, refused = self.cell.stops, list[Exception]()
        ended, answered = threading.Event(), threading.Event()

        def perform() -> None:
            try:
                begin()
                # A stop that came after the press holds for what was begun late, too.
                if self.cell.stops != stops and (run := self.cell.current) is not None:
                    run.abort("the cell was stopped while this was starting")
            except Exception as error:
                log.info("%s: %s", what, error, exc_info=not isinstance(error, CellError))
                refused.append(error)
                if answered.is_set():
                    self._say(client, {"type": "answer", "ok": False, "text": str(error)})
            finally:
                self.starting = None
                self._beginning.release()
                ended.set()

        threading.Thread(target=perform, name=f"console: starts {what}", daemon=True).start()
        ended.wait(SOON_S)
        answered.set()
        if refused:
            raise refused[0]
        return f"{what} has begun" if ended.is_set() else f"starting {what} …"

    def _resume(self, client: str, words: Words) -> str:
        self.queue.require_none()
        return self._long(client, "resumed job", lambda: self.cell.resume(words["run"], script=self._script(self.job)))

    def _recover(self, client: str, words: Words) -> str:
        by = self.holders.name(client) if words["by"] is None else words["by"]
        return self._long(client, "recovery", lambda: self.cell.recover(by))

    def _long(self, client: str, what: str, work: Callable[[], object]) -> str:
        return self._soon(client, what, lambda: self._begin_long(what, work))

    def _begin_long(self, what: str, work: Callable[[], object]) -> None:
        """Begin it in a thread of its own, and give what refuses it at once."""
        begun = threading.Event()
        failed: list[CellError] = []
        runs: list[Run[object]] = []

        def perform() -> None:
            try:
                made = work()
                if isinstance(made, Verification) and runs and runs[0].folder is not None:
                    self._found = runs[0].folder.name, str(made.summary()["reason"])
            except CellError as error:
                failed.append(error)
                log.info("%s: %s", what, error)
            finally:
                begun.set()

        threading.Thread(target=perform, name=f"console: {what}", daemon=True).start()
        while not begun.wait(0.01) and self.cell.current is None:
            pass
        if (run := self.cell.current) is not None:
            runs.append(run)
            self.questions.hold(run)
            self._began(run, None)
        elif failed:
            raise failed[0]

    def _running(self, what: str, act: Callable[[Run[object]], None]) -> str:
        if (run := self.cell.current) is None:
            raise InterlockError("cell", f"nothing is going on that could {what}")
        act(run)
        return f"asked the {run.kind} to {'hold before its next motion' if what == 'pause' else what}"

    def _decide(self, client: str, words: Words) -> str:
        if (run := self.cell.current) is None:
            raise InterlockError("cell", "nothing is going on that waits for a decision")
        by = self.holders.name(client) if words["by"] is None else words["by"]
        return self.questions.decide(run, words["number"], words["choice"], words["step"], by, reason=words["reason"])

    def _clear_stop(self, client: str, words: Words) -> str:
        self.cell.clear_stop(words["by"])
        return f"the stop was cleared by {words['by']}"

    def _manual(self, client: str, words: Words) -> str:
        if not words["on"]:
            return self.manual.end()
        with self._nothing_starting():
            return self.manual.begin(self.holders.name(client))

    def _jog_step(self, client: str, words: Words) -> Answer:
        told = self.manual.step(Jog(words["device"], words["axis"], words["amount"]))
        return {"text": "  ".join(f"{name} {value}" for name, value in told.items())}

    def _speed(self, client: str, words: Words) -> str:
        self.manual.speed = words["fraction"]
        return f"held buttons move at {100 * self.manual.speed:.0f} %"

    def _pace(self, client: str, words: Words) -> str:
        self.cell.pace = words["share"]
        return f"arm and vehicle move at {100 * self.cell.pace:.0f} % of their planned speed, from the next motion on"

    def _diag(self) -> Answer:
        if self.cell.current is not None:
            raise InterlockError("cell", "is at work, and its devices are asked only while it rests; wait for the end")
        served = () if self.cell.simulated is None else self.cell.simulated.simulated
        with self._nothing_starting():
            rows = []
            for device in self.cell.devices:
                bare: Any = device.bare if isinstance(device, Gated) else device
                record = self.cell.config.device(device.name)
                row = ask(device.name, record.place, bare, self.cell.devices.clock)
                row.simulated = device.name in served
                rows.append(row.as_dict())
        well = all(row["ok"] for row in rows)
        return {"text": "all devices are well" if well else "not all devices are well", "rows": rows}

    def _seed(self, words: Words) -> int:
        own = None if self.cell.simulated is None else self.cell.simulated.facts["seed"]
        seed = words["seed"] if words["seed"] is not None else own
        return 1 if seed is None else int(seed)

    def named_job(self, name: str | None) -> str:
        """One of the jobs that `/api/cell` lists; the console's own without one. `ConfigError` for any other."""
        if name is None or name == self.job:
            return self.job
        require_job_name(name)
        return name
