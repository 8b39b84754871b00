"""What pages may ask of a cell on the virtual clock: who holds, what is refused in which words, what is begun."""

import os
import threading
from typing import Any

import pytest

from cell.apps.console.host.controller import SOON_S, ConsoleController, Questions
from cell.apps.console.view.readings import jobs
from cell.config.job import item_names, job_path, load_job, shipped_jobs
from cell.run.runs import Run
from cell.run.session.supervisor import Cell
from drivers.errors import CellError, ConfigError, InterlockError, LimitError, Measured, RefusedError
from statemachine.runner import Again
from statemachine.step import Failure, Outcome
from tests.support import until
from tests.support.console.server import refusal

STEPS = ("board_photo", "laser_sweep", "reconstruct")


def asked(questions: Questions, run: Run[Any]) -> tuple[list[object], threading.Thread]:
    """A run of these steps that is refused at its sweep, in a thread of its own."""
    made: list[object] = []
    number = Measured("stripe, rows seen", 12, "rows", least=200)
    failure = Failure(Outcome.REFUSED, "too little stripe", "RefusedError", error=RefusedError("x", number))
    decide = questions.script(STEPS).on_refusal
    questions.hold(run)

    def ask() -> None:
        try:
            made.append(decide("laser_sweep", failure))
        except RefusedError as error:
            made.append(error)

    thread = threading.Thread(target=ask)
    thread.start()
    assert until(lambda: questions.present(None) is not None)
    return made, thread


def test_a_refusal_is_shown_with_its_numbers_and_the_choices_that_the_policy_allows():
    questions, end = Questions(), threading.Event()
    run: Run[Any] = Run("job", lambda run: end.wait(10))
    made, thread = asked(questions, run)
    shown = questions.present(None)
    assert shown["numbers"] == [{"name": "stripe, rows seen", "value": 12, "limit": 200, "unit": "rows", "ok": False}]
    again, abort = shown["choices"]
    assert again == {"choice": "again", "steps": ["board_photo", "laser_sweep"]}
    assert abort == {"choice": "abort"}
    number = shown["number"]
    for wrong in (
        (number + 1, "again", "laser_sweep", "Ann", "dust"),
        (number, "again", "reconstruct", "Ann", "dust"),
        (number, "confirm", None, "Ann", "dust"),
        (number, "again", "laser_sweep", " ", "dust"),
        (number, "again", "laser_sweep", "Ann", " \n"),
    ):
        with pytest.raises(ConfigError):
            questions.decide(run, *wrong)
    questions.decide(run, number, "again", "board_photo", "Ann", "wiped the lens")
    thread.join(5)
    assert made == [Again("board_photo", "Ann: wiped the lens")]
    assert questions.present(None) is None

    made, thread = asked(questions, run)
    later = questions.present(None)
    questions.decide(run, later["number"], "abort", None, "Bob", "the part is scrap")
    thread.join(5)
    assert isinstance(made[0], RefusedError)
    assert "Bob: the part is scrap" in str(made[0])
    end.set()


def test_a_run_that_is_ended_asks_no_more():
    questions, end = Questions(), threading.Event()
    run: Run[Any] = Run("job", lambda run: end.wait(10))
    made, thread = asked(questions, run)
    run.abort("stopped")
    thread.join(5)
    assert made == [None]
    end.set()


def test_nobody_is_asked_where_nobody_looks():
    decide = Questions().script(STEPS, seen=lambda: False).on_refusal
    assert decide("board_photo", Failure(Outcome.REFUSED, "no board")) is None


def test_one_holds_the_others_see(controller: ConsoleController):
    assert "nobody" in str(refusal(controller, "c1", do="home"))
    assert controller.do("c1", {"do": "hold", "name": "  Ann\n\x07 "}) == {"ok": True, "text": "Ann holds the cell"}
    assert "Ann" in str(refusal(controller, "c2", do="hold", name="Bob"))
    assert "Ann does" in str(refusal(controller, "c2", do="start", job="pot"))
    assert isinstance(refusal(controller, "c1", do="hand_over", to="c9"), InterlockError)
    controller.do("c1", {"do": "hand_over", "to": "c2"})
    assert isinstance(refusal(controller, "c1", do="leave"), InterlockError)
    controller.left("c2")
    assert controller.holders.holder is None
    # A page that is gone cannot come back as itself.
    assert isinstance(refusal(controller, "c2", do="hold", name="Bob"), InterlockError)


@pytest.mark.parametrize(
    ("words", "kind"),
    [
        ({"do": "explode"}, ConfigError),
        ({"do": None}, ConfigError),
        ({"do": ["stop"]}, ConfigError),
        ({"do": "start", "job": "../../etc/passwd"}, ConfigError),
        ({"do": "start", "job": "no-such-job"}, ConfigError),
        ({"do": "start", "job": 3}, ConfigError),
        ({"do": "pause"}, InterlockError),
        ({"do": "abort", "reason": "x"}, InterlockError),
        ({"do": "decide", "number": 1}, ConfigError),
        ({"do": "decide", "number": 1, "choice": "abort", "reason": "x"}, InterlockError),
        ({"do": "decide", "number": 10**400, "choice": "abort", "reason": "x"}, ConfigError),
        ({"do": "jog_step", "device": "arm", "axis": "z", "amount": 10**400}, ConfigError),
        ({"do": "home", "device": "rail", "by": "Ann"}, ConfigError),
        ({"do": "abort", "reason": "x" * 5000}, ConfigError),
        ({"do": "resume", "run": "../elsewhere"}, ConfigError),
        ({"do": "cancel_dry_run"}, InterlockError),
        ({"do": "clear_stop", "by": " "}, ConfigError),
        ({"do": "speed", "fraction": 2}, ConfigError),
        ({"do": "speed", "fraction": float("nan")}, ConfigError),
        ({"do": "pace", "share": 0.1}, ConfigError),
        ({"do": "pace"}, ConfigError),
        ({"do": "jog_step", "device": "arm", "axis": "z", "amount": 0.001}, InterlockError),
        ({"do": "dry_run", "seed": -1}, ConfigError),
    ],
)
def test_what_is_wrong_is_refused(controller: ConsoleController, words: dict[str, Any], kind: type[CellError]):
    controller.do("c1", {"do": "hold", "name": "Ann"})
    assert type(refusal(controller, "c1", **words)) is kind


def test_manual_mode_jogs_and_nothing_else_can_be_begun_meanwhile(cell: Cell, controller: ConsoleController):
    controller.do("c1", {"do": "hold", "name": "Ann"})
    controller.do("c1", {"do": "manual", "on": True})
    assert controller.manual.on
    before = cell.devices.arm.state().flange.copy()
    controller.do("c1", {"do": "jog_step", "device": "arm", "axis": "z", "amount": 0.01})
    moved = cell.devices.arm.state().flange - before
    assert moved[:3] == pytest.approx([0, 0, 0.01], abs=1e-4)
    assert isinstance(refusal(controller, "c1", do="jog_step", device="arm", axis="z", amount=2.0), LimitError)
    assert isinstance(refusal(controller, "c1", do="jog_step", device="arm", axis="q", amount=0.01), ConfigError)
    # What a step refuses does not end the mode; a job does not begin in it.
    assert controller.manual.on
    assert "jog is going on" in str(refusal(controller, "c1", do="start", job="pot"))
    controller.do("c1", {"do": "leave"})
    assert until(lambda: not controller.manual.on)


def test_a_stop_ends_manual_mode_and_then_somebody_has_to_look(cell: Cell, controller: ConsoleController):
    controller.do("c1", {"do": "hold", "name": "Ann"})
    controller.do("c1", {"do": "manual", "on": True})
    cell.stop()
    assert until(lambda: not controller.manual.on)
    assert not cell.devices.gate.is_open
    controller.do("c1", {"do": "clear_stop", "by": "Ann"})
    assert cell.devices.gate.is_open


def test_what_takes_long_to_begin_is_answered_at_once_and_not_begun_twice(
    cell: Cell, controller: ConsoleController, monkeypatch
):
    told, slow = [], threading.Event()

    def start(*_: object, **__: object) -> Run[Any]:
        slow.wait(10)
        raise RefusedError("the battery is empty")

    monkeypatch.setattr(cell, "start", start)
    monkeypatch.setattr(controller, "_say", lambda client, words: told.append((client, words)))
    controller.do("c1", {"do": "hold", "name": "Ann"})
    # While it still takes: the answer waits for `SOON_S` alone.
    assert controller.do("c1", {"do": "start", "job": "pot"})["text"] == "starting job pot …"
    assert SOON_S <= 0.1
    assert controller.starting == "job pot"
    for again in ("start", "home", "calibrate"):
        assert "is starting job pot" in str(refusal(controller, "c1", do=again))
    slow.set()
    assert until(lambda: controller.starting is None)
    # What refuses it later is told to the page that asked.
    assert told == [("c1", {"type": "answer", "ok": False, "text": "the battery is empty"})]
    assert "battery" in str(refusal(controller, "c1", do="start"))


def test_a_stop_while_something_is_starting_ends_it(cell: Cell, controller: ConsoleController, monkeypatch):
    slow, begun = threading.Event(), list[Run[Any]]()

    def home(_: object) -> None:
        slow.wait(10)
        begun.append(cell.begin("homing", lambda run: until(lambda: run.control.token.reason is not None)))
        begun[0].ended(10)

    monkeypatch.setattr(cell, "home", home)
    controller.do("c1", {"do": "hold", "name": "Ann"})
    assert controller.do("c1", {"do": "home"})["text"] == "starting homing …"
    cell.stop()
    slow.set()
    assert until(lambda: begun and begun[0].done, 5.0)
    assert "stopped while this was starting" in str(begun[0].control.token.reason)
    cell.clear_stop("the test")


def test_jobs_are_named_never_addressed(controller: ConsoleController, tmp_path, monkeypatch):
    """Nothing of a file's text is told, and a pipe keeps nobody waiting."""
    elsewhere, here = tmp_path / "elsewhere", tmp_path / "here"
    for folder in (elsewhere, here):
        folder.mkdir()
    text = job_path("pot").read_text()
    for path in (elsewhere / "mine.toml", here / "mine.toml", here / "plain"):
        path.write_text(text + "# secret")
    (here / "pot.ply").write_bytes(job_path("pot").with_suffix(".ply").read_bytes())
    (here / "linked.toml").symlink_to(elsewhere / "mine.toml")
    os.mkfifo(here / "pipe.toml")
    monkeypatch.chdir(here)
    assert controller.named_job("mine") == "mine" and controller.named_job("seat") == "seat"
    elsewheres = ["../elsewhere/mine", "../elsewhere/mine.toml", str(here / "mine.toml"), "/dev/zero", "/etc/passwd"]
    for name in [*elsewheres, "mine.toml", "plain", "linked", "pipe", "pipe.toml", "", ".", "..", "x" * 300]:
        with pytest.raises(ConfigError) as refused:
            controller.named_job(name)
        assert "secret" not in str(refused.value)
    shipped = dict.fromkeys(each for name in shipped_jobs() if name != "pot" for each in (name, *item_names(name)))
    assert jobs("pot") == ["pot", "mine", *shipped]
    with pytest.raises(ConfigError, match="no regular file"):
        load_job("pipe.toml")


@pytest.mark.parametrize(
    "wrong",
    [{"at": 10**400}, {"at": float("nan")}, {"at": float("inf")}, {"press": 1.5}, {"press": -1}, {"sign": 2},
     {"device": "claw"}, {"axis": "x" * 900}, {"surplus": 1}],
    ids=str,
)  # fmt: skip
def test_a_beat_that_is_not_understood_moves_nothing(controller: ConsoleController, wrong: dict[str, Any]):
    beat = {"type": "jog", "press": 1, "device": "arm", "axis": "z", "sign": 1, "at": 1.0}
    with pytest.raises(ConfigError, match="not understood"):
        controller.beat("c1", beat | wrong)
    controller.beat("c1", beat)
