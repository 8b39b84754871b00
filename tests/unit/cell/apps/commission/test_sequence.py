"""`cell commission` finds by name what is not as the configuration says, writes it, and then finds nothing more."""

import re
import tomllib
from collections.abc import Callable
from contextlib import closing
from typing import Any

import pytest

from cell.apps.commission.check import CheckVerdict, Result
from cell.apps.commission.sequence import CHECKS, by_name, chosen, edited, write_changes
from cell.config.cell_config import default_toml, load_config
from drivers.errors import ConfigError, RefusedError
from tests.support import ROOT
from tests.support.commissioning import Shown, commissioned, files, opened, replaced, same


def test_a_wrong_payload_is_weighed_written_and_not_weighed_again(tmp_path):
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
    with pytest.raises(ConfigError, match="nothing would be checked: verification comes after links"):
        chosen(("verification",), "links")
    assert [verdict for _, verdict, _ in again.rows] == ["good already"] * 3


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
    tmp_path, truth: Callable[[str], str], cell: Callable[[str], str], until: str, words: str
):
    files(tmp_path, truth, cell)
    good, shown = commissioned(tmp_path, until)
    assert good
    assert len(shown.found) == 1, shown.found
    assert re.search(words, shown.found[0])


# --- files ---

AT = '["9 mm", "-5 mm", "8 mm"]'
CHANGES = {
    "rail.lead": '"4 mm"',
    "rail.reversed": "true",
    "laser.output": "1",
    "claw.output": "0",
    "calibration.fine.board": '"marked_dots:11x9:2.5mm"',
    "arm.payload": '"4.3 kg"',
    "arm.payload_centre": '["0 mm", "1 mm", "60 mm"]',
    "scan_camera.flange_from_camera": f"{{ translation = {AT}, rotation = {AT.replace('mm', 'deg')} }}",
}  # fmt: skip


def test_values_are_changed_and_everything_else_of_the_file_stays():
    text = default_toml()
    new = edited(text, CHANGES)
    wanted = tomllib.loads(text)
    for key, value in CHANGES.items():
        *tables, name = key.split(".")
        table: Any = wanted
        for part in tables:
            table = table[part]
        table[name] = tomllib.loads(f"x = {value}")["x"]
    assert tomllib.loads(new) == wanted
    assert re.findall(r"#.*", new) == re.findall(r"#.*", text)
    assert len(new.splitlines()) == len(text.splitlines())


def test_a_value_over_several_lines_and_a_key_that_is_missing_are_written_too():
    text = '[a]  # first\nlist = [\n  1,  # one\n  2,\n]\nb = "x # y"   # said\n\n[c.d]\ne = 1\n'
    new = edited(text, {"a.list": "[3]", "a.b": '"z"', "c.d.f": "2", "g.h": "true"})
    assert tomllib.loads(new) == {"a": {"list": [3], "b": "z"}, "c": {"d": {"e": 1, "f": 2}}, "g": {"h": True}}
    assert "# said" in new and "# first" in new


def test_what_cannot_be_changed_without_risk_is_refused_with_what_to_write(monkeypatch):
    with pytest.raises(ConfigError, match=r"a\.b = 2"):
        edited("a = 1\n", {"a.b": "2"})
    monkeypatch.setattr("tomlkit.value", lambda value: 3)
    with pytest.raises(ConfigError, match=r"a\.b = 2"):
        edited("[a]\nb = 1\n", {"a.b": "2"})


def test_the_old_file_is_kept_each_time(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_bytes(default_toml().replace("\n", "\r\n").encode())
    kept = [write_changes(path, {"rail.lead": f'"{k} mm"'}) for k in (3, 4)]
    assert len(set(kept)) == 2
    assert kept[0].read_text(encoding="utf-8") == default_toml()
    assert 'lead = "3 mm"' in kept[1].read_text(encoding="utf-8")
    assert load_config(path).rail.lead == pytest.approx(0.004)
    assert path.read_bytes().count(b"\r\n") == path.read_bytes().count(b"\n")


def test_every_check_says_what_moves_and_needs_only_earlier_ones():
    before: set[str] = set()
    for check in CHECKS:
        assert check.title and check.limit and check.moves
        assert check.moves == "nothing" or (check.far and check.fast)
        assert set(check.needs) <= before, check.name
        before.add(check.name)


def test_the_documents_table_is_current():
    text = (ROOT / "docs" / "how-to" / "commission.md").read_text(encoding="utf-8")
    rows = [f"| `{c.name}` | {c.moves} | {c.far} | {c.fast} | {c.limit} |" for c in CHECKS]
    assert "\n".join(["| check | moves | how far | how fast | has to hold |", "|---|---|---|---|---|", *rows]) in text


def test_what_rests_on_a_check_that_came_out_wrong_waits_though_it_was_good_before(tmp_path):
    files(tmp_path)
    good, _ = commissioned(tmp_path, "payload")
    assert good
    shown = Shown()
    made = opened(tmp_path, shown)
    made.progress.keep(by_name("links"), made.workplace.config, Result(verdict=CheckVerdict.WRONG), 0.1, "")
    assert not made.go([by_name("payload")])
    assert [verdict for _, verdict, _ in shown.rows] == ["waits for arm_axes"]


@pytest.mark.parametrize("check", ["outputs", "stops"])
def test_what_a_person_would_not_do_is_not_good(tmp_path, monkeypatch, check: str):
    files(tmp_path)
    made = opened(tmp_path, Shown())
    with closing(made.workplace):
        monkeypatch.setattr(made.workplace, "simulated", False)
        monkeypatch.setattr(made.workplace.person, "_ask", lambda text: not text.startswith(("Keep", "Joint 1")))
        with pytest.raises(RefusedError, match="not tried"):
            by_name(check).work(made.workplace, Result())
