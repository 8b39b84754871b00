"""Endings at random instants: a run is killed, signalled or aborted; the simulated world's truth says what moved on.

Each trial has a served world of its own and a `cell` command in a process of its own, as an operator would have them.
The truth is asked from the ending on: when did something move or shine for the last time?
"""

import json
import logging
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cell.devices.simulated.process import ask_truth
from cell.procedures.steps.kinds import PLACE
from cell.run.folder import is_going, list_runs
from drivers.clock import Clock
from drivers.errors import CellError
from statemachine.journal import JournalError, read, request

log = logging.getLogger(__name__)

LIMIT_S = 0.5
"""Wall seconds after the ending from which on nothing may move or shine."""
WATCHED_S = 3.0
"""Wall seconds for which it is watched: long enough to see something go on, or begin again."""
_BEGIN_TIMEOUT_S = 180.0
_MOVED = 2e-4
"""Change of a pose's entry (m or a direction's cosine) between two looks that counts as motion."""

WAYS = ("kill", "SIGINT", "SIGTERM", "SIGHUP", "abort")
JOGS = {
    "jog arm": ("jog", "arm", "j1", "+80deg"),
    "jog rail": ("jog", "rail", "+80mm"),
    "jog vehicle": ("jog", "vehicle", "-0.4m"),
}
WORK = (*PLACE.names, "calibration", "verification", *JOGS)
"""What is ended: the six steps of a job, and the runs that are no job."""
_LASTS_S = {
    "drive_to_target": 14.0, "board_photo": 4.0, "laser_sweep": 10.0, "reconstruct": 2.0, "invert_pose": 2.0,
    "place": 11.0, "calibration": 70.0, "verification": 40.0, "jog arm": 2.0, "jog rail": 8.0, "jog vehicle": 7.0,
}  # fmt: skip
"""About how long each lasts, in seconds of the cell: the instant is drawn within it."""


@dataclass(frozen=True)
class Ending:
    """One trial: what was ended and how, when in it (s of the cell), and when something moved or shone last (wall s).
    `what_moved` names what still did after `LIMIT_S`; `exit_code` is the process's, negative for a kill."""

    work: str
    way: str
    instant_s: float
    rest_s: float
    what_moved: str
    exit_code: int | None


def campaign(folder: Path, count: int, seed: int, speed: float, progress: Callable[[int, str], None]) -> list[Ending]:
    """`count` trials of each kind of ending (killed; signalled or aborted) in turn over all work, in `folder`.

    Calibrates the cell of `seed` there first; each trial is logged (`cell -v`) as it ends. Raises `CellError` when a
    command cannot be brought to where it is ended.
    """
    rng = np.random.default_rng([seed, 9])
    progress(0, "calibrating")
    done = subprocess.run(
        _command("calibrate", "--sim", "all", "--seed", str(seed)), cwd=folder, capture_output=True, text=True
    )
    if done.returncode != 0:
        raise CellError(f"the cell of seed {seed} could not be calibrated: {done.stderr.strip()[-300:]}")
    endings = []
    for number in range(2 * count):
        work = WORK[(number // 2) % len(WORK)]
        way = "kill" if number % 2 == 0 else WAYS[1 + (number // 2) % (len(WAYS) - 1)]
        progress(number, f"{way} in {work}")
        ending = None
        while ending is None:
            ending = _trial(folder, work, way, float(rng.uniform(0.0, _LASTS_S[work])), seed, speed)
        endings.append(ending)
        log.info("%s", json.dumps(asdict(endings[-1])))
    return endings


def summary(endings: list[Ending], seed: int, speed: float) -> dict[str, Any]:
    """The campaign as JSON-ready data: a row for each work, and the trials."""
    rows = []
    for work in WORK:
        own = [ending for ending in endings if ending.work == work]
        if own:
            rows.append(
                {
                    "work": work,
                    "kills": sum(ending.way == "kill" for ending in own),
                    "signals_and_aborts": sum(ending.way != "kill" for ending in own),
                    "moved_or_shone_after": sum(ending.rest_s > LIMIT_S for ending in own),
                    "slowest_rest_s": round(max(ending.rest_s for ending in own), 3),
                }
            )
    return {
        "seed": seed, "speed": speed, "limit_s": LIMIT_S, "trials": len(endings),
        "moved_or_shone_after": sum(ending.rest_s > LIMIT_S for ending in endings),
        "work": rows, "endings": [asdict(ending) for ending in endings],
    }  # fmt: skip


def _trial(folder: Path, work: str, way: str, instant: float, seed: int, speed: float) -> Ending | None:
    """One trial; None when the work had ended by itself before the instant."""
    with _world(folder, seed, speed) as truth_address:
        if work in JOGS:
            words = JOGS[work]
        elif work == "calibration":
            words = ("calibrate",)
        elif work == "verification":
            words = ("calibrate", "verify")
        else:
            words = ("run", "--at-start", "--json")
        before = set(list_runs(folder / "runs"))
        process = subprocess.Popen(
            _command(*words, "-c", "endings.toml"), cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        try:
            run = _begun(folder / "runs", before, work, process)
            with suppress(subprocess.TimeoutExpired):
                process.wait(instant / speed)
                return None
            if not is_going(run):
                return None
            _end(process, run, way)
            rest, moved = _watch(truth_address)
            try:
                code = process.wait(30.0)
            except subprocess.TimeoutExpired:
                rest, moved, code = math.inf, "the process itself", None
        finally:
            if process.poll() is None:
                process.kill()
                process.wait(10.0)
        return Ending(work, way, round(instant, 2), round(rest, 3), moved, code)


@contextmanager
def _world(folder: Path, seed: int, speed: float) -> Iterator[str]:
    """A served world; gives its truth's address. `endings.toml` in `folder` names it."""
    toml = folder / "endings.toml"
    toml.unlink(missing_ok=True)
    world = subprocess.Popen(
        _command("sim", "serve", "--json", "--seed", str(seed), "--speed", str(speed), "--config-out", toml.name),
        cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    assert world.stdout is not None
    try:
        yield str(json.loads(world.stdout.readline())["truth"]["address"])
    finally:
        world.send_signal(signal.SIGINT)
        try:
            world.wait(10.0)
        except subprocess.TimeoutExpired:
            world.kill()
            world.wait(10.0)
        world.stdout.close()


def _begun(root: Path, before: set[Path], work: str, process: subprocess.Popen[bytes]) -> Path:
    step = work.removeprefix("jog ") if work in JOGS else work
    deadline = time.monotonic() + _BEGIN_TIMEOUT_S
    while time.monotonic() < deadline:
        for run in set(list_runs(root)) - before:
            with suppress(JournalError):
                names = [row.name for row in read(run).steps if row.state == "running"]
                if is_going(run) and (step in names or (work in JOGS and "jog" in names)):
                    return run
        if process.poll() is not None:
            assert process.stderr is not None
            words = process.stderr.read().decode(errors="replace").strip()[-300:]
            raise CellError(f"`cell` ended ({process.returncode}) before it came to {work}: {words}")
        Clock().sleep(0.01)
    raise CellError(f"`cell` did not come to {work} within {_BEGIN_TIMEOUT_S:g} s")


def _end(process: subprocess.Popen[bytes], run: Path, way: str) -> None:
    if way == "abort":
        request(run, "abort", "a trial of endings")
    elif process.poll() is None:
        os.kill(process.pid, signal.SIGKILL if way == "kill" else signal.Signals[way])


def _watch(address: str) -> tuple[float, str]:
    """When something moved or shone last after now, in wall s, and what did so after the limit."""
    begun = time.monotonic()
    last, late = 0.0, set()
    before: dict[str, Any] | None = None
    while (passed := time.monotonic() - begun) < WATCHED_S:
        truth = ask_truth(address)
        if moving := _moving(truth, before):
            last = passed
            if passed > LIMIT_S:
                late |= moving
        before = truth
        Clock().sleep(0.02)
    return last, ", ".join(sorted(late))


def _moving(truth: dict[str, Any], before: dict[str, Any] | None) -> set[str]:
    shown = {
        "laser": truth["laser_on"], "rail": truth["rail_moving"], "arm": truth["arm"]["moving"],
        "vehicle": not truth["vehicle"]["stopped"],
    }  # fmt: skip
    moving = {name for name, does in shown.items() if does}
    if before is not None:
        for name, pose in (("arm", "base_from_flange"), ("vehicle", "world_from_vehicle")):
            if np.abs(np.array(truth["poses"][pose]) - np.array(before["poses"][pose])).max() > _MOVED:
                moving.add(name)
    return moving


def _command(*words: str) -> list[str]:
    return [sys.executable, "-c", "from cell.apps.cli import main; main()", *words]
