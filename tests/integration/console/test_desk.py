"""What pages may ask of a cell on the virtual clock: who holds, what is refused in which words, what is decided."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.apps.console.host.controller import SOON_S, ConsoleController
from cell.apps.console.host.observer import _figure
from cell.apps.console.host.questions import Questions
from cell.apps.console.server.commands import MOST_CLOUDS, Mailbox
from cell.apps.console.view.readings import cell_facts, jobs
from cell.apps.console.view.run_view import RunView
from cell.config.job import job_path, load_job, shipped_jobs
from cell.run.runs import Run
from cell.run.session.supervisor import Cell
from drivers.errors import CellError, ConfigError, InterlockError, LimitError, Measured, RefusedError
from statemachine.runner import Again
from statemachine.step import Event, Failure, Outcome
from tests.support.console.server import until

STEPS = ("board_photo", "laser_sweep", "reconstruct")


@pytest.fixture
def desk(cell: Cell) -> Iterator[ConsoleController]:
    made = ConsoleController(cell, "pot", lambda client, words: None)
    made.joined("c1")
    made.joined("c2")
    yield made
    made.close()


def refusal(desk: ConsoleController, client: str, **words: Any) -> CellError:
    with pytest.raises(CellError) as refused:
        desk.do(client, words)
    return refused.value


def test_one_holds_the_others_see(desk: ConsoleController) -> None:
    assert "nobody" in str(refusal(desk, "c1", do="home"))
    assert desk.do("c1", {"do": "hold", "name": "  Ann\n\x07 "}) == {"ok": True, "text": "Ann holds the cell"}
    assert "Ann" in str(refusal(desk, "c2", do="hold", name="Bob"))
    assert "Ann does" in str(refusal(desk, "c2", do="start", job="pot"))
    assert isinstance(refusal(desk, "c1", do="hand_over", to="c9"), InterlockError)
    desk.do("c1", {"do": "hand_over", "to": "c2"})
    assert isinstance(refusal(desk, "c1", do="leave"), InterlockError)
    desk.left("c2")
    assert desk.holders.holder is None
    # A page that is gone cannot come back as itself.
    assert isinstance(refusal(desk, "c2", do="hold", name="Bob"), InterlockError)


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
def test_what_is_wrong_is_refused(desk: ConsoleController, words: dict[str, Any], kind: type[CellError]) -> None:
    desk.do("c1", {"do": "hold", "name": "Ann"})
    assert type(refusal(desk, "c1", **words)) is kind


def test_manual_mode_jogs_and_nothing_else_can_be_begun_meanwhile(cell: Cell, desk: ConsoleController) -> None:
    desk.do("c1", {"do": "hold", "name": "Ann"})
    desk.do("c1", {"do": "manual", "on": True})
    assert desk.manual.on
    before = cell.devices.arm.state().flange.copy()
    desk.do("c1", {"do": "jog_step", "device": "arm", "axis": "z", "amount": 0.01})
    moved = cell.devices.arm.state().flange - before
    assert moved[:3] == pytest.approx([0, 0, 0.01], abs=1e-4)
    assert isinstance(refusal(desk, "c1", do="jog_step", device="arm", axis="z", amount=2.0), LimitError)
    assert isinstance(refusal(desk, "c1", do="jog_step", device="arm", axis="q", amount=0.01), ConfigError)
    # What a step refuses does not end the mode; a job does not begin in it.
    assert desk.manual.on
    assert "jog is going on" in str(refusal(desk, "c1", do="start", job="pot"))
    desk.do("c1", {"do": "leave"})
    assert until(lambda: not desk.manual.on)


def test_a_stop_ends_manual_mode_and_then_somebody_has_to_look(cell: Cell, desk: ConsoleController) -> None:
    desk.do("c1", {"do": "hold", "name": "Ann"})
    desk.do("c1", {"do": "manual", "on": True})
    cell.stop()
    assert until(lambda: not desk.manual.on)
    assert not cell.devices.gate.is_open
    desk.do("c1", {"do": "clear_stop", "by": "Ann"})
    assert cell.devices.gate.is_open


@pytest.mark.parametrize(("device", "axis"), [("arm", "z"), ("arm", "j1"), ("rail", "")])
@pytest.mark.parametrize("end", ["release", "page gone", "another button", "manual off", "silence"])
def test_what_ends_a_held_button_stops_the_motion(
    cell: Cell, desk: ConsoleController, monkeypatch: pytest.MonkeyPatch, device: str, axis: str, end: str
) -> None:
    """Virtual time passes here alone: what moves on after the end would be seen to."""
    cell.home("rail")
    told: list[str] = []
    moved: Any = getattr(cell.devices, device)
    monkeypatch.setattr(moved.bare, "attended", lambda: nullcontext(lambda: None), raising=False)
    monkeypatch.setattr("cell.apps.console.host.manual.ATTENDED_S", 60.0)
    monkeypatch.setattr(desk, "_say", lambda client, words: told.append(words["state"]))
    desk.do("c1", {"do": "hold", "name": "Ann"})
    desk.do("c1", {"do": "manual", "on": True})

    def beat(number: int) -> None:
        desk.beat("c1", {"type": "jog", "press": number, "device": device, "axis": axis, "sign": 1, "at": None})

    def place() -> Any:
        return moved.state().position if device == "rail" else moved.state().joints

    begun = place()
    beat(1)
    assert until(lambda: told == ["moving"])
    cell.devices.clock.sleep(0.3)
    assert np.abs(place() - begun).max() > 1e-4
    ends: dict[str, Any] = {
        "release": lambda: desk.jog_end("c1"), "page gone": lambda: desk.left("c1"), "another button": lambda: beat(2),
        "manual off": lambda: desk.do("c1", {"do": "manual", "on": False}),
        "silence": lambda: monkeypatch.setattr("cell.apps.console.host.manual.ATTENDED_S", 0.0),
    }  # fmt: skip
    ends[end]()
    assert until(lambda: told == ["moving", "ended"])
    stood = place()
    cell.devices.clock.sleep(0.5)
    assert np.abs(place() - stood).max() < 1e-5
    beat(1)
    cell.devices.clock.sleep(0.5)
    assert np.abs(place() - stood).max() < 1e-5


def test_holding_is_offered_only_where_something_beside_the_program_would_stop_it(cell: Cell) -> None:
    """The devices on the virtual clock have nothing beside them."""
    facts = cell_facts(cell, "pot")
    assert {entry["device"] for entry in facts["jog"]} == {"rail", "arm", "vehicle"}
    assert not any(entry["hold"] for entry in facts["jog"])
    assert facts["simulated"] is True
    assert facts["jobs"][0] == "pot"


def test_what_takes_long_to_begin_is_answered_at_once_and_not_begun_twice(
    cell: Cell, desk: ConsoleController, monkeypatch: pytest.MonkeyPatch
) -> None:
    told, slow = [], threading.Event()

    def start(*_: object, **__: object) -> Run[Any]:
        slow.wait(10)
        raise RefusedError("the battery is empty")

    monkeypatch.setattr(cell, "start", start)
    monkeypatch.setattr(desk, "_say", lambda client, words: told.append((client, words)))
    desk.do("c1", {"do": "hold", "name": "Ann"})
    # While it still takes: the answer waits for `SOON_S` alone.
    assert desk.do("c1", {"do": "start", "job": "pot"})["text"] == "starting job pot …"
    assert SOON_S <= 0.1
    assert desk.starting == "job pot"
    for again in ("start", "home", "calibrate"):
        assert "is starting job pot" in str(refusal(desk, "c1", do=again))
    slow.set()
    assert until(lambda: desk.starting is None)
    # What refuses it later is told to the page that asked.
    assert told == [("c1", {"type": "answer", "ok": False, "text": "the battery is empty"})]
    assert "battery" in str(refusal(desk, "c1", do="start"))


def test_a_stop_while_something_is_starting_ends_it(
    cell: Cell, desk: ConsoleController, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow, begun = threading.Event(), list[Run[Any]]()

    def home(_: object) -> None:
        slow.wait(10)
        begun.append(cell.begin("homing", lambda run: until(lambda: run.control.token.reason is not None)))
        begun[0].ended(10)

    monkeypatch.setattr(cell, "home", home)
    desk.do("c1", {"do": "hold", "name": "Ann"})
    assert desk.do("c1", {"do": "home"})["text"] == "starting homing …"
    cell.stop()
    slow.set()
    assert until(lambda: begun and begun[0].done, 5.0)
    assert "stopped while this was starting" in str(begun[0].control.token.reason)
    cell.clear_stop("the test")


@pytest.mark.parametrize(
    ("report", "figure"),
    [
        ({"truth": {"error_mm": {"d": {"mean": 0.021}}}, "place_bound_95": {"d": 0.3}}, {"mm": 0.021, "kind": "true"}),
        ({"place_bound_95": {"d": 0.3}}, {"mm": 0.3, "kind": "stated"}),
        ({"place_bound_95": None}, None),
    ],
)
def test_a_placed_job_ends_with_its_figure(tmp_path: Path, report: dict[str, Any], figure: object) -> None:
    """The true error where a simulated world tells it, else the bound that was stated, said as such."""

    def work(run: Run[Any]) -> None:
        run.folder = tmp_path
        run.tell(Event("run_ended", None, {"outcome": "placed", "reason": "all steps done"}))
        (tmp_path / "report.json").write_text(json.dumps({"outcome": "placed", **report}))

    run: Run[Any] = Run("job", work)
    view = RunView(run, STEPS, "pot", {})
    run.ended(5)
    view.news()
    assert _figure(view) == figure


# --- decisions ---


def asked(questions: Questions, run: Run[Any]) -> tuple[list[object], threading.Thread]:
    """A run of these steps that is refused at its sweep, in a thread of its own."""
    made: list[object] = []
    number = Measured("stripe, rows seen", 12, "rows", least=200)
    failure = Failure(Outcome.REFUSED, "too little stripe", "RefusedError", error=RefusedError("x", number))
    decide = questions.script(STEPS).on_refusal
    assert decide is not None
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


def test_a_refusal_is_shown_with_its_numbers_and_the_choices_that_the_policy_allows() -> None:
    questions, end = Questions(), threading.Event()
    run: Run[Any] = Run("job", lambda run: end.wait(10))
    made, thread = asked(questions, run)
    shown = questions.present(None)
    assert shown is not None
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
    assert later is not None
    questions.decide(run, later["number"], "abort", None, "Bob", "the part is scrap")
    thread.join(5)
    assert isinstance(made[0], RefusedError)
    assert "Bob: the part is scrap" in str(made[0])
    end.set()


def test_a_run_that_is_ended_asks_no_more() -> None:
    questions, end = Questions(), threading.Event()
    run: Run[Any] = Run("job", lambda run: end.wait(10))
    made, thread = asked(questions, run)
    run.abort("stopped")
    thread.join(5)
    assert made == [None]
    end.set()


def test_nobody_is_asked_where_nobody_looks() -> None:
    decide = Questions().script(STEPS, seen=lambda: False).on_refusal
    assert decide is not None
    assert decide("board_photo", Failure(Outcome.REFUSED, "no board")) is None


def test_a_run_is_followed_by_its_own_events() -> None:
    seen, begun, end = threading.Event(), threading.Event(), threading.Event()

    def work(run: Run[Any]) -> None:
        seen.wait(10)
        run.tell(Event("progress", "calibrate", {"fraction": 1.0, "text": "stored"}))
        run.tell(Event("step_started", "board_photo", {"attempt": 1}))
        run.tell(Event("progress", "board_photo", {"fraction": 0.5, "text": "to the board"}))
        run.tell(
            Event(
                "fault", "board_photo", {"attempt": 1, "code": "arm.link_lost", "reason": "cut", "remedy": "recovered"}
            )
        )
        run.tell(Event("confirm_needed", "board_photo", {"reason": "look", "code": "arm.protective_stop", "number": 1}))
        begun.set()
        end.wait(10)
        run.tell(Event("run_ended", None, {"outcome": "placed", "reason": "all steps done"}))

    run: Run[Any] = Run("job", work)
    view = RunView(run, STEPS, "pot", {"board_photo": 10.0, "laser_sweep": 5.0, "reconstruct": 1.0})
    seen.set()
    assert begun.wait(5)
    view.news()
    told = view.as_dict()
    # A first calibration stands before the steps, and has ended with the first of them.
    assert [(step["name"], step["state"]) for step in told["steps"][:2]] == [
        ("calibrate", "done"),
        (STEPS[0], "active"),
    ]
    assert (told["state"], told["step"], told["fraction"]) == ("asking", "board_photo", 0.5)
    assert told["left_s"] == pytest.approx(16.0, abs=1.0)
    assert [step["state"] for step in told["steps"][1:]] == ["active", "open", "open"]
    assert view.faults[0]["device"] == "arm"
    question = Questions().present(view)
    assert question is not None
    assert [choice["choice"] for choice in question["choices"]] == ["confirm", "abort"]
    end.set()
    run.ended(5)
    view.news()
    assert view.over
    assert view.ended is not None and view.ended["outcome"] == "placed"


def test_the_mailbox_keeps_the_newest_and_of_the_cloud_as_much_as_it_may() -> None:
    import asyncio

    async def fill() -> list[str | bytes]:
        mailbox = Mailbox()
        for n in range(500):
            mailbox.show("state", f"state {n}")
            mailbox.cloud(n.to_bytes(2, "big"))
        mailbox.say("hello")
        return [await mailbox.take() for _ in range(mailbox.waiting)]

    taken = asyncio.run(fill())
    assert taken[:2] == ["hello", "state 499"]
    assert taken[2:] == [n.to_bytes(2, "big") for n in range(500 - MOST_CLOUDS, 500)]


def test_runs_of_the_archive_are_read_from_their_folders(tmp_path: Path) -> None:
    from cell.apps.console.view.archive import Archive

    folder = tmp_path / "20260101T000000-abcd"
    (folder / "frames").mkdir(parents=True)
    (folder / "frames" / "board-01-000001.png").write_bytes(b"png")
    (tmp_path / "secret.png").write_bytes(b"png")
    report = (
        '{"outcome": "placed", "reason": "done", "job": "pot", "place_sigma": {"translation_mm": [0.03, 0.04, 0.0]}'
    )
    (folder / "report.json").write_text(report + ', "truth": {"error_mm": {"d": {"mean": 0.07}}}, "started": "2026"}')
    archive = Archive(tmp_path)
    (row,) = archive.runs()
    assert (row["d_mean_mm"], row["expected_mm"], row["outcome"]) == (0.07, 0.05, "placed")
    (point,) = archive.trend()
    assert point["run"] == folder.name
    run = archive.run(folder.name)
    assert run is not None and run["pictures"] == ["board-01-000001.png"]
    assert archive.picture(folder.name, "board-01-000001.png") is not None
    assert archive.replay(folder.name) is None
    (folder / "linked.png").symlink_to(tmp_path / "secret.png")
    (folder / "trace.json").symlink_to(tmp_path / "secret.png")
    for name in ("../secret.png", "..", "secret.png", "linked.png"):
        assert archive.picture(folder.name, name) is None
    assert archive.run("..") is None
    assert archive.replay(folder.name) is None and archive.page(folder.name) is None
    # A pipe would keep whoever reads it waiting, and a linked run lies elsewhere.
    piped = tmp_path / "20260102T000000-abcd"
    piped.mkdir()
    os.mkfifo(piped / "report.json")
    (tmp_path / "20260103T000000-abcd").symlink_to(folder)
    assert [row["run"] for row in archive.runs()] == [folder.name]
    assert archive.run(piped.name) is None and archive.run("20260103T000000-abcd") is None


def test_jobs_are_named_never_addressed(
    desk: ConsoleController, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    assert desk.named_job("mine") == "mine" and desk.named_job("seat") == "seat"
    wrong = [
        "../elsewhere/mine",
        "../elsewhere/mine.toml",
        str(here / "mine.toml"),
        "mine.toml",
        "plain",
        "linked",
        "pipe",
    ]
    for name in [*wrong, "pipe", "pipe.toml", "/dev/zero", "/etc/passwd", "", ".", "..", "x" * 300]:
        with pytest.raises(ConfigError) as refused:
            desk.named_job(name)
        assert "secret" not in str(refused.value)
    assert jobs("pot") == ["pot", "mine", *(name for name in shipped_jobs() if name != "pot")]
    with pytest.raises(ConfigError, match="no regular file"):
        load_job("pipe.toml")


@pytest.mark.parametrize(
    "wrong",
    [{"at": 10**400}, {"at": float("nan")}, {"at": float("inf")}, {"press": 1.5}, {"press": -1}, {"sign": 2},
     {"device": "claw"}, {"axis": "x" * 900}, {"surplus": 1}],
    ids=str,
)  # fmt: skip
def test_a_beat_that_is_not_understood_moves_nothing(desk: ConsoleController, wrong: dict[str, Any]) -> None:
    beat = {"type": "jog", "press": 1, "device": "arm", "axis": "z", "sign": 1, "at": 1.0}
    with pytest.raises(ConfigError, match="not understood"):
        desk.beat("c1", beat | wrong)
    desk.beat("c1", beat)
