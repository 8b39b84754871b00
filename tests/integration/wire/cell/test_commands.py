"""Single commands on one served cell: they connect what they need, move, refuse, look without touching, and recover."""

import json
import os
import re
import signal
import socket
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell import Cell
from cell.config.cell_config import default_toml, load_config
from cell.devices.assembly import connect
from cell.devices.lock import CellLock
from cell.run.folder import awaited_word, list_runs, read_report
from cell.run.jogging import jog, needed_for, parse_jog
from drivers.clock import Clock
from drivers.errors import DeadlineError, DeviceFault, InterlockError, NotConnectedError
from statemachine.journal import request
from tests.support import Typed, until
from tests.support.packages import RAIL, install, with_acme_rail
from tests.support.wire import cells
from tests.support.wire.cells import ask, assert_safe, cell, started, wait_for_step

pytestmark = pytest.mark.wire

STAYS = ("laser_on", "digital_outputs", "rail_moving", "vehicle", "arm", "part")


serving = cells.serving("--seed", "3", "--level", "ideal")


@pytest.fixture
def endpoints(serving: tuple[Path, dict[str, Any]], here: Path) -> dict[str, Any]:
    """The served cell after a reset of the rail; its configuration is the `cell.toml` of the present folder."""
    folder, endpoints = serving
    (here / "cell.toml").write_text((folder / "sim.toml").read_text(encoding="utf-8"), encoding="utf-8")
    ask(endpoints, op="fault", name="rail.reset")
    ask(endpoints, op="reset")
    return endpoints


def truth(endpoints: dict[str, Any]) -> dict[str, Any]:
    told: dict[str, Any] = ask(endpoints, op="truth")["truth"]
    return told


def change(old: str, new: str) -> None:
    """Another configuration in the present folder."""
    toml = Path("cell.toml")
    text, count = re.subn(old, new, toml.read_text(encoding="utf-8"))
    assert count
    toml.write_text(text, encoding="utf-8")


def test_diag_tells_what_the_devices_tell_changes_nothing_and_fails_when_one_does(
    endpoints: dict[str, Any], typed: Typed
):
    before = truth(endpoints)
    code, out, error = typed("diag", "--json")
    after = truth(endpoints)
    assert code == 0, error
    rows = json.loads(out)
    assert set(rows) == {"arm", "rail", "vehicle", "scan_camera", "target_camera", "laser", "claw"}
    assert all(row["ok"] and np.isfinite(row["p99_ms"]) for row in rows.values())
    figures = {(name, figure["what"]): figure for name, row in rows.items() for figure in row["readings"]}
    told = {key: figures[key]["value"] for key in figures}
    assert (told["arm", "supply"], told["arm", "hottest joint"]) == (48.0, 30.0)
    assert told["vehicle", "battery"] == pytest.approx(26.4)
    assert 0.0 < told["vehicle", "bus load, at most"] < 50.0
    assert told["rail", "driver too hot"] == 0.0
    assert told["scan_camera", "frame rate by its clock"] == pytest.approx(10.0, rel=0.01)
    assert "brake unknown" in rows["vehicle"]["state"]
    assert rows["rail"]["state"].startswith("not homed")
    for name in STAYS:
        assert after[name] == before[name], name
    assert after["rail"]["carriage"] == before["rail"]["carriage"]
    change(r'url = "socket://[^"]*"', 'url = "socket://127.0.0.1:1"')
    code, out, _ = typed("diag", "--device", "rail", "--json")
    assert code == 1
    assert not json.loads(out)["rail"]["ok"]


def test_find_tells_which_configured_addresses_answer_and_touches_nothing(endpoints: dict[str, Any], typed: Typed):
    before = truth(endpoints)
    code, out, error = typed("find", "--json")
    after = truth(endpoints)
    assert code == 0, error
    rows = {row["what"]: row for row in json.loads(out)}
    for name in ("arm", "rail", "vehicle", "scan_camera", "target_camera"):
        assert rows[f"configured {name}"]["ok"], rows
    assert rows["configured arm"]["state"] == "answers on 29999, 30001, 30004"
    for name in STAYS:
        assert after[name] == before[name], name
    url = load_config(Path("cell.toml")).rail.place
    code, out, error = typed("find", url, "--json")
    assert (code, [row["state"] for row in json.loads(out) if row["what"] == "TMCL module"]) == (
        0,
        ["version 1260V112"],
    )


def test_the_rail_works_while_the_arm_is_switched_off(endpoints: dict[str, Any], typed: Typed):
    change(re.escape(f'"{load_config(Path("cell.toml")).arm.place}"'), '"127.255.0.9"')
    code, out, error = typed("home", "rail")
    assert (code, out) == (0, "rail homed\n"), error
    code, _, error = typed("jog", "rail", "+5mm")
    assert code == 0, error
    assert truth(endpoints)["rail"]["carriage"] == pytest.approx(0.005, abs=1e-5)
    code, out, error = typed("diag", "--device", "rail", "--json")
    assert code == 0, error
    rows = json.loads(out)
    assert (list(rows), rows["rail"]["state"]) == (["rail"], "homed, at 5.00 mm")
    code, _, error = typed("home")
    assert code == 1
    assert "127.255.0.9" in error


def test_two_jogs_by_5_mm_end_at_10_mm_and_one_after_a_reset_says_that_it_homed(
    endpoints: dict[str, Any], typed: Typed
):
    """The rail goes on from where it stands, program after program; only a rail that is not homed is homed."""

    def jogged() -> dict[str, str]:
        code, out, error = typed("jog", "rail", "+5mm", "--json")
        assert code == 0, error
        answer: dict[str, str] = json.loads(out)
        return answer

    assert "homing" in jogged()
    assert truth(endpoints)["rail"]["carriage"] == pytest.approx(0.005, abs=1e-5)
    # Another process than the one that homed it.
    done = cell("jog", "rail", "+5mm", "--json", folder=Path.cwd())
    assert done.returncode == 0, done.stderr
    assert "homing" not in json.loads(done.stdout)
    assert truth(endpoints)["rail"]["carriage"] == pytest.approx(0.010, abs=1e-5)
    ask(endpoints, op="fault", name="rail.reset")
    assert "homing" in jogged()
    assert truth(endpoints)["rail"]["carriage"] == pytest.approx(0.005, abs=1e-5)


def test_jogs_move_and_are_refused_outside_the_limits(endpoints: dict[str, Any], typed: Typed):
    before = np.array(truth(endpoints)["poses"]["base_from_flange"])
    assert typed("jog", "arm", "z", "-10mm")[0] == 0
    after = np.array(truth(endpoints)["poses"]["base_from_flange"])
    assert after[2, 3] - before[2, 3] == pytest.approx(-0.010, abs=0.0005)
    start = np.array(truth(endpoints)["poses"]["world_from_vehicle"])
    code, _, error = typed("jog", "vehicle", "+0.1m")
    assert (code, "arm_stowed" in error) == (1, True)
    code, _, error = typed("jog", "vehicle", "+0.1m", "--lift", "arm_stowed", "--reason", "the arm stands upright")
    assert code == 0, error
    end = np.array(truth(endpoints)["poses"]["world_from_vehicle"])
    assert np.linalg.norm(end[:2, 3] - start[:2, 3]) == pytest.approx(0.1, abs=0.01)
    code, _, error = typed("jog", "rail", "-20mm")
    assert code == 1
    assert "0 mm" in error or "0 to 100" in error


def test_an_arm_whose_program_somebody_has_ended_is_jogged_all_the_same(endpoints: dict[str, Any]):
    wish = parse_jog("arm", ["j1", "+2deg"])
    with Cell.open("cell.toml", only=needed_for(wish)) as opened:
        arm, joints = opened.devices.arm, opened.devices.arm.state().joints
        with socket.create_connection((opened.config.arm.place, 29999), timeout=5.0) as dashboard:
            dashboard.makefile("r").readline()
            dashboard.sendall(b"stop\n")
            assert until(lambda: not arm.state().controlled, 5.0)
        jog(opened, wish)
        assert np.degrees(arm.state().joints - joints)[0] == pytest.approx(2.0, abs=0.01)


def test_only_the_device_that_is_used_is_held_and_no_other_can_be_asked(endpoints: dict[str, Any]):
    config = load_config(Path("cell.toml"))
    with CellLock(config, ["rail"]):
        with CellLock(config, ["vehicle"]):
            pass
        with pytest.raises(InterlockError, match="the rail at"), CellLock(config):
            pass
    devices = connect(config, ["rail"])
    assert [device.name for device in devices] == ["rail"]
    with pytest.raises(NotConnectedError, match="arm: this command works without it"):
        _ = devices.arm
    assert devices.stop() == devices.close() == []


def test_a_rail_of_another_maker_is_jogged_from_the_command_line(tmp_path, monkeypatch):
    site = install(tmp_path / "site", "acme-rail", "1.2", "rail.acme = acme_rail:MAKE", acme_rail=RAIL)
    monkeypatch.setenv("PYTHONPATH", str(site), prepend=":")
    (tmp_path / "cell.toml").write_text(with_acme_rail(default_toml()).replace("192.0.2.", "10.255.255."))
    done = cell("jog", "rail", "+5mm", "--json", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["rail"] == "0.000 mm → 5.000 mm"


# --- out of a fault ---


def test_an_idle_protective_stop_is_unlocked_by_a_person_who_is_named(endpoints: dict[str, Any], typed: Typed):
    ask(endpoints, op="fault", name="arm.protective_stop")
    code, _, error = typed("recover")
    assert code == 2 and "--by NAME" in error
    assert truth(endpoints)["arm"]["safety"] == "protective_stop"
    code, _, error = typed("recover", "--by", "Ann")
    assert (code, truth(endpoints)["arm"]["safety"]) == (0, "normal"), error


def test_a_homing_that_stopped_goes_on_after_cell_confirm(endpoints: dict[str, Any], here: Path):
    with started("home", "arm", folder=here) as homing:
        run = wait_for_step(here, "homing", homing)
        ask(endpoints, op="fault", name="arm.protective_stop")
        while (asked := awaited_word(run)) is None:
            assert homing.poll() is None
            Clock().sleep(0.05)
        request(run, "confirm", "Ann", asked.number)
        assert homing.wait(60.0) == 0
        assert homing.stderr is not None and "waiting for a person, question 1" in homing.stderr.read()


def word(cell: Cell) -> None:
    """A controller that was held up may stop itself as it goes on: a person looks, and lets it."""
    if cell.current is not None:
        cell.current.confirm("Ann")


def test_an_arm_that_froze_is_used_again_by_the_same_program(endpoints: dict[str, Any]):
    """Its link is lost after 1.5 s of silence: a person's word connects it again."""
    with Cell.open("cell.toml", only=("arm", "vehicle")) as opened:

        def lost() -> bool:
            with suppress(DeadlineError):
                opened.devices.arm.state()
            return False

        os.kill(endpoints["pid"], signal.SIGSTOP)
        try:
            with pytest.raises(DeviceFault, match="was lost"):
                until(lost, 4.0)
        finally:
            os.kill(endpoints["pid"], signal.SIGCONT)
        opened.recover("Ann")
        opened.home("arm", lambda event: event.kind == "confirm_needed" and word(opened))
        assert opened.devices.arm.state().controlled


# --- a stop from anywhere ends the run that is going on ---


def test_cell_abort_ends_a_calibration(endpoints: dict[str, Any], here: Path, typed: Typed):
    with started("calibrate", folder=here) as work:
        wait_for_step(here, "calibration", work)
        code, _, said = typed("abort")
        _, error = work.communicate(timeout=60)
    assert code == 0, said
    assert work.returncode == 1, error
    assert "cell abort" in error
    assert_safe(endpoints)
    assert [read_report(run)["outcome"] for run in list_runs(here / "runs")] == ["aborted"]


def test_a_jog_is_ended_by_a_request_and_stops_on_its_way(endpoints: dict[str, Any], here: Path):
    with started("jog", "arm", "j1", "+80deg", folder=here) as work:
        request(wait_for_step(here, "jog", work), "abort", "enough")
        _, error = work.communicate(timeout=60)
    assert work.returncode == 1, error
    assert "enough" in error
    assert not ask(endpoints, op="truth")["truth"]["arm"]["moving"]
    (folder,) = list_runs(here / "runs")
    assert read_report(folder)["outcome"] == "aborted"


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.campaign), signal.SIGINT]
)
def test_a_signal_while_the_cell_starts_is_told_and_leaves_no_process(tmp_path, number: signal.Signals):
    with started("dry-run", "--seed", "3", folder=tmp_path) as run:
        started_by_it = Path(f"/proc/{run.pid}/task/{run.pid}/children")
        assert until(started_by_it.read_text, 60.0)
        children = started_by_it.read_text().split()
        os.kill(run.pid, number)
        _, error = run.communicate(timeout=60)  # a loop that is just being compiled is finished
    assert run.returncode == 130
    assert "asked to end" in error or "interrupted from the keyboard" in error
    assert "Traceback" not in error
    # A world whose start the signal cut in two ends by itself, because its standard input has ended.
    assert until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in children), 20.0)
