"""Promises of `cell.config.job`."""

import re
from pathlib import Path

import pytest

from cell.config.job import item_names, job_path, load_job
from drivers.errors import ConfigError


@pytest.mark.usefixtures("here")
def test_the_job_of_the_present_folder_wins_over_the_one_that_ships():
    shipped = job_path("pot")
    assert shipped.is_absolute()
    Path("pot").mkdir()
    assert job_path("pot") == shipped
    Path("pot.toml").write_text(shipped.read_text())
    assert (job_path("pot"), job_path(shipped)) == (Path("pot.toml"), shipped)


def test_what_a_batch_does_is_checked_and_no_part_of_what_runs_rest_on(tmp_path):
    shipped, path = job_path("pot"), tmp_path / "mine.toml"
    text = shipped.read_text().replace('"pot.ply"', f'"{shipped.with_suffix(".ply")}"')
    path.write_text(f'{text}\n[batch]\non_refusal = "skip"\n')
    job = load_job(path)[0]
    assert (job.batch.on_refusal, load_job("pot")[0].batch.on_refusal) == ("skip", "end")
    assert "batch" not in job.model_dump(mode="json")
    path.write_text(path.read_text().replace("skip", "later"))
    with pytest.raises(ConfigError, match=r'batch\.on_refusal.*"end", "ask" or "skip"'):
        load_job(path)


def test_an_item_has_its_own_nest_and_surface_and_knows_where_the_others_are():
    first, third = load_job("tray4")[0], load_job("tray4#3")[0]
    assert item_names("tray4") == [f"tray4#{k}" for k in (1, 2, 3, 4)] and item_names("tray4#2") == ["tray4#2"]
    assert item_names("pot") == ["pot"]
    assert third.nest is not None and third.nest.base_from_part.translation == pytest.approx((-0.7, 0.1, 0.03))
    assert third.surface.place_from_surface.translation == (0.06, -0.06, 0.0)
    assert (third.job.name, third.job.kind) == ("tray4#3", "load")
    assert [number for number, _, _ in third.other_items] == [1, 2, 4]
    assert third.other_items[0][1].isApprox(first.nest.base_from_part.se3()) if first.nest else False
    assert third.other_items[0][2].isApprox(first.surface.place_from_surface.se3())
    assert third.of_item(1) == first, "whichever item it is asked of"
    # What an item does not say is as [nest] and [surface] have it.
    old, new = load_job("swap")[0], load_job("swap#2")[0]
    assert (old.unloads, new.unloads) == (True, False) and old.surface == new.surface
    assert old.nest is not None and old.nest.base_from_part.translation == (-0.6, 0.06, 0.03)


@pytest.mark.parametrize(
    ("name", "old", "new", "told"),
    [
        ("swap", 'kind = "unload"', 'kind = "load"', "item 2: after those before it its place has a part already"),
        ("swap", 'kind = "load"', 'kind = "unload"', "item 2: after those before it its place is empty already"),
    ],
)
def test_two_parts_do_not_go_into_one_place_nor_one_out_of_it_twice(tmp_path, name: str, old: str, new: str, told: str):
    path = tmp_path / f"{name}.toml"
    text = job_path(name).read_text(encoding="utf-8")
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(ConfigError, match=told):
        load_job(path)


def test_an_item_that_is_not_there_and_items_without_a_nest_are_told(tmp_path):
    for name in ("tray4#5", "pot#1"):
        with pytest.raises(ConfigError, match=r"has \d items: there is no item \d"):
            load_job(name)
    path = tmp_path / "mine.toml"
    path.write_text(f'{job_path("pot").read_text(encoding="utf-8")}\n[[item]]\nkind = "load"\n')
    with pytest.raises(ConfigError, match=r"\[\[item\]\] takes parts from nests, or to them: give \[nest\]"):
        load_job(path)
    path.write_text(path.read_text(encoding="utf-8").replace('name = "pot"', 'name = "pot#1"'))
    with pytest.raises(ConfigError, match='"pot#1" is no name'):
        load_job(path)


def test_an_item_at_another_stop_has_its_board_way_and_obstacles_and_knows_where_the_first_one_stands():
    left, right = (load_job(f"two-stations#{k}")[0] for k in (1, 2))
    assert (left.at_stop, right.at_stop, load_job("tray4")[0].at_stop) == ("left", "right", None)
    assert (left.board.spec, right.board.spec) == ("marked_dots:9x7:20mm", "marked_dots:11x9:16mm")
    assert left.approach == right.approach, "what a stop leaves out is as [approach] has it"
    assert ([o.name for o in left.obstacle], [o.name for o in right.obstacle]) == ([], ["rack"])
    assert right.of_item(1) == left and left.of_item(2) == right, "whichever item it is asked of"
    (first,), (second,) = right.other_stops, left.other_stops
    assert (first.name, second.name, first.board) == ("left", "right", left.board)
    assert first.place_from_stop.isApprox(second.place_from_stop.inverse())
    # The corner is turned to the right: the first stop is behind and to the left of the second.
    assert first.place_from_stop.translation == pytest.approx((-2.75, 2.75, 0.0))
    place = first.place_from_stop * left.surface.place_from_surface.se3() * left.place.surface_from_part.se3()
    assert right.other_items[0][2].isApprox(place)
    assert load_job("pot")[0].other_stops == []


def changed_copy(name: str, folder: Path, old: str, new: str) -> Path:
    """A shipped job with its first `old` exchanged; its meshes stay where they are."""
    shipped = job_path(name)
    text = re.sub(r'"([\w-]+\.ply)"', rf'"{shipped.parent}/\1"', shipped.read_text(encoding="utf-8"))
    (folder / "mine.toml").write_text(text.replace(old, new, 1), encoding="utf-8")
    return folder / "mine.toml"


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('stop = "right"', 'stop = "middle"', r'item\.stop "middle" is no \[\[stop\]\] \(there: left, right\)'),
        ('stop = "right"', 'stop = "left"', "stop right has no item"),
        ('name = "right"', 'name = "left"', "stop left is there twice"),
        ("place_from_stop", "# place_from_stop", "stop right: give place_from_stop; it tells.*frame of left"),
        ('name = "left"\n', 'name = "left"\nplace_from_stop = POSE\n', "stop left: leave out place_from_stop"),
        ("11x9:16mm", "9x7:16mm", "stops left and right have boards of 9 x 7 points.*board of other counts"),
        ("11x9:16mm", "7x9:16mm", "stops left and right have boards of 9 x 7 points.*board of other counts"),
    ],
)
def test_stops_that_cannot_be_told_apart_or_found_are_refused(tmp_path, old: str, new: str, told: str):
    pose = '{ translation = ["0 mm", "0 mm", "0 mm"], rotation = ["0 deg", "0 deg", "0 deg"] }'
    with pytest.raises(ConfigError, match=told):
        load_job(changed_copy("two-stations", tmp_path, old, new.replace("POSE", pose)))
