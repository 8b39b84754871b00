"""`cell commission` on simulated cells that are not as their configuration says: found by name, written, and good then.

The world is built from one configuration, the product works with another: it knows the truth from its devices alone.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from cell.apps.commission.check import CommissionCheck, Result
from cell.apps.commission.checks.vehicle import judge_board
from cell.apps.commission.person import PersonAtTheConsole, SimulatedPerson
from cell.apps.commission.protocol import write_protocol
from cell.apps.commission.sequence import CHECKS, Commissioning, begin, by_name, chosen
from cell.config.cell_config import default_toml, load_config
from cell.config.job import load_job
from cell.devices.simulated.described import Described
from cell.devices.simulated.direct import VirtualCell
from cell.measure.vision import parse_board
from drivers.errors import DeviceFault
from tests.support.described_cells import described

SEED = 3


class Shown:
    """What was shown of each check, in order."""

    def __init__(self) -> None:
        self.rows: list[tuple[str, str, Result | None]] = []

    def __call__(self, check: CommissionCheck, verdict: str, result: Result | None) -> None:
        self.rows.append((check.name, verdict, result))

    @property
    def found(self) -> list[str]:
        return [str(finding) for _, _, result in self.rows if result is not None for finding in result.findings]


def files(folder: Path, truth: Callable[[str], str], cell: Callable[[str], str] = lambda text: text) -> None:
    text = default_toml()
    (folder / "true.toml").write_text(truth(text), encoding="utf-8")
    (folder / "cell.toml").write_text(cell(text), encoding="utf-8")


def opened(folder: Path, shown: Shown, ask: Callable[[str], bool] | None = None, job: str = "pot") -> Commissioning:
    person = SimulatedPerson(lambda text: None) if ask is None else PersonAtTheConsole(ask)
    return begin(
        folder / "cell.toml",
        person,
        shown,
        job=job,
        sim="all",
        seed=SEED,
        clock="virtual",
        truth=folder / "true.toml",
    )


def commissioned(folder: Path, until: str, ask: Callable[[str], bool] | None = None) -> tuple[bool, Shown]:
    shown = Shown()
    made = opened(folder, shown, ask)
    try:
        good = made.go(chosen((), until))
        write_protocol(made.progress, CHECKS, made.desk.config)
    finally:
        made.desk.close()
    return good, shown


def replaced(old: str, new: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new)

    return change


def same(text: str) -> str:
    return text


def test_a_wrong_payload_is_weighed_written_and_not_weighed_again(tmp_path: Path) -> None:
    files(tmp_path, replaced('payload = "2.1 kg"', 'payload = "4.3 kg"'))
    good, shown = commissioned(tmp_path, "payload")
    assert good
    assert [row[:2] for row in shown.rows] == [
        ("links", "good"), ("arm_axes", "good"), ("payload", "wrong"), ("payload", "good"),
    ]  # fmt: skip
    assert len(shown.found) == 1 and "arm.payload" in shown.found[0] and "4.3" in shown.found[0]
    assert load_config(tmp_path / "cell.toml").arm.payload == pytest.approx(4.3)
    assert [path.read_text(encoding="utf-8") for path in tmp_path.glob("cell.toml.before-*")] == [default_toml()]
    protocol = (tmp_path / "commissioning" / "protocol.html").read_text(encoding="utf-8")
    assert "A simulated cell" in protocol and "Found and mended" in protocol and "4.30 kg" in protocol
    # What is good is passed over the next time, without opening a cell.
    again = Shown()
    made = opened(tmp_path, again)
    assert made.go(chosen((), "payload"))
    assert [verdict for _, verdict, _ in again.rows] == ["good already"] * 3


def test_nothing_moves_without_a_persons_word_and_what_needs_it_waits(tmp_path: Path) -> None:
    files(tmp_path, lambda text: text)
    asked: list[str] = []

    def ask(text: str) -> bool:
        asked.append(text)
        return "moves for the first time" not in text

    good, shown = commissioned(tmp_path, "payload", ask)
    assert not good
    assert [row[:2] for row in shown.rows] == [
        ("links", "good"), ("arm_axes", "declined"), ("payload", "waits for arm_axes"),
    ]  # fmt: skip
    assert sum("joint 1 moves for the first time: this joint alone, 2 deg" in text for text in asked) == 1


def test_a_rail_whose_motor_turns_backwards_is_nudged_but_finds_no_zero_until_it_is_turned_round() -> None:
    config, described = load_config(None), Described.of("pot")
    backwards = config.model_copy(update={"rail": config.rail.model_copy(update={"reversed": True})})
    cell = VirtualCell(config, SEED, described=described, truth=backwards)
    before = cell.world.rail.carriage(cell.clock.now())
    cell.rail.nudge(0.005, 0.005).wait(10.0)
    assert cell.world.rail.carriage(cell.clock.now()) - before == pytest.approx(-0.005, abs=1e-4)
    with pytest.raises(DeviceFault, match=r"right limit switch tripped .* the motor turns the other way"):
        cell.rail.home().wait(10.0)
    assert cell.world.rail.carriage(cell.clock.now()) < 0.1035  # short of the end stop
    right = VirtualCell(backwards, SEED, described=described)
    right.rail.nudge(0.005, 0.005).wait(10.0)
    assert right.world.rail.carriage(right.clock.now()) - before == pytest.approx(0.005, abs=1e-4)
    right.rail.home().wait(60.0)
    assert right.world.rail.carriage(right.clock.now()) == pytest.approx(0.0, abs=1e-4)


def test_limit_switches_that_are_exchanged_are_found_by_name_short_of_the_end_stop(tmp_path: Path) -> None:
    files(tmp_path, same)
    made, result = opened(tmp_path, Shown()), Result()
    try:
        simulated = made.desk.cell.simulated
        assert isinstance(simulated, VirtualCell)
        simulated.fault("rail.exchanged_switches")
        by_name("rail_limits").work(made.desk, result)
        (finding,) = result.findings
        assert "left limit switch at the left end, measured that of the other end" in str(finding)
        assert not simulated.world.rail.stalled(simulated.clock.now())
    finally:
        made.desk.close()


def test_a_station_board_of_another_pitch_is_written_into_a_job_of_ones_own_and_not_into_one_that_ships(
    tmp_path: Path,
) -> None:
    files(tmp_path, same)
    _, job = described(tmp_path / "own")
    check, shown = by_name("station"), Shown()
    for name, written in (("pot", {}), (str(job), {"board.spec": '"marked_dots:9x7:24mm"'})):
        made, result = opened(tmp_path, shown, job=name), Result()
        try:
            judge_board(name, parse_board(made.desk.job.board.spec), 1.201, result)
            (finding,) = result.findings
            assert finding.write_job == written
            assert 'write spec = "marked_dots:9x7:24mm"' in str(finding) or "own.toml it has to read" in str(finding)
            made.progress.keep(check, made.desk.config, Result(), 1.0, "")
            assert made._mend(check, result) is bool(written)
            assert made.progress.standing(check, made.desk.config) == ("stale" if written else "good")
        finally:
            made.desk.close()
    assert load_job(job)[0].board.spec == "marked_dots:9x7:24mm"
    assert len(list(job.parent.glob("own.toml.before-*"))) == 1


def swapped(text: str) -> str:
    return re.sub(r"^output = (\d)", lambda found: f"output = {1 - int(found[1])}", text, flags=re.MULTILINE)


def mounting(camera: str, rotation: str) -> Callable[[str], str]:
    """The configuration with another turn of a camera about its optical axis."""
    mark = '["90 mm"' if camera == "scan_camera" else '["-100 mm"'

    def change(text: str) -> str:
        lines = [
            line.replace('"90 deg"] }', f'"{rotation}"] }}') if mark in line else line for line in text.splitlines()
        ]
        return "\n".join(lines) + "\n"

    return change


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("truth", "cell", "until", "words"),
    [
        (replaced("reversed = false", "reversed = true"), same, "rail_limits", "rail.reversed"),
        (replaced('lead = "2 mm"', 'lead = "4 mm"'), same, "rail_limits", "rail.lead"),
        (same, replaced('lead = "2 mm"', 'lead = "4 mm"'), "rail_limits", "rail.lead"),
        (same, swapped, "outputs", "laser.output, claw.output"),
        (same, mounting("scan_camera", "0 deg"), "scan_mounting", "scan_camera.flange_from_camera.*turned by 90"),
        (same, mounting("target_camera", "180 deg"), "target_mounting", "target_camera.flange_from.*turned by -90"),
        (replaced("11x9:3mm", "11x9:2.5mm"), same, "scan_mounting", "calibration.fine.board"),
        (same, replaced("9x7:20mm", "9x7:25mm"), "target_mounting", "calibration.large.board"),
        (same, replaced('payload = "2.1 kg"', 'payload = "1 kg"'), "payload", "arm.payload"),
        (same, mounting("target_camera", "-90 deg"), "target_mounting", "target_camera.*upside down"),
        (same, mounting("scan_camera", "-90 deg"), "scan_mounting", "scan_camera.*upside down"),
    ],
)
def test_each_wrong_configuration_is_found_by_name_and_nothing_else_is(
    tmp_path: Path, truth: Callable[[str], str], cell: Callable[[str], str], until: str, words: str
) -> None:
    files(tmp_path, truth, cell)
    good, shown = commissioned(tmp_path, until)
    assert good
    assert len(shown.found) == 1, shown.found
    assert re.search(words, shown.found[0])


@pytest.mark.campaign
def test_a_cell_on_which_nothing_is_wrong_is_commissioned_up_to_its_first_part(tmp_path: Path) -> None:
    files(tmp_path, lambda text: text)
    good, shown = commissioned(tmp_path, "job_part")
    assert good
    assert shown.found == []
