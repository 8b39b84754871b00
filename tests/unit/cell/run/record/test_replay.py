"""Perception fed again with what a run kept gives the same bits, and what was changed is found."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from cell.run.record.replay import FILE as PERCEPTION
from cell.run.record.replay import _pictures, replay
from drivers.errors import CellError, ConfigError
from lab.bench.job.whole_job import JobRecord
from tests.support import Typed


@pytest.fixture
def copied(folder: Path, tmp_path) -> Path:
    """The run's folder, to be changed."""
    copy = tmp_path / folder.name
    shutil.copytree(folder, copy, ignore=lambda where, names: [n for n in names if n == "record.mcap"])
    return copy


def test_perception_fed_again_gives_the_same_bits(folder: Path, placed_pot: JobRecord):
    compared = replay(folder)
    assert [each.difference for each in compared] == [""] * len(compared)
    names = [each.what for each in compared]
    assert names[:4] == ["board's pose", "cloud", "place pose", "its covariance"]
    assert 10 < int(names[4].split()[0]) < len(list((folder / "frames").iterdir()))


def test_a_pixel_or_a_reading_that_changed_is_found_and_exits_1(copied: Path, typed: Typed):
    kept = json.loads((copied / PERCEPTION).read_text(encoding="utf-8"))
    kept["photograph"]["flange"][0] += 1e-9
    (copied / PERCEPTION).write_text(json.dumps(kept), encoding="utf-8")
    stripes = sorted((copied / "frames").glob("stripe-*.png"))
    middle = stripes[len(stripes) // 2]
    image = cv2.imread(str(middle), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(middle), np.roll(image, 1, axis=1))
    code, out, _ = typed("replay", str(copied), "--json")
    assert code == 1
    told = json.loads(out)
    assert not told["same"]
    by_name = {row["what"]: row["difference"] for row in told["compared"]}
    assert by_name["board's pose"].startswith("off by 1e-06 mm")
    assert "points" in by_name["cloud"]
    assert by_name["place pose"].startswith("off by")


def test_a_picture_of_the_record_that_is_not_the_file_is_found(folder: Path, tmp_path):
    """Without the rest of perception: the run's folder has no pictures here."""
    (tmp_path / "frames").mkdir()
    shutil.copy(folder / "record.mcap", tmp_path)
    for path in (folder / "frames").iterdir():
        shutil.copy(path, tmp_path / "frames")
    assert _pictures(tmp_path)[0].same
    victim = min((tmp_path / "frames").glob("board-*"))
    victim.write_bytes(victim.read_bytes()[:-1] + b"\0")
    assert _pictures(tmp_path)[0].difference == f"not those in frames/: {victim.name}"


def test_a_run_that_came_to_no_cloud_says_that_it_cannot_be_replayed(tmp_path):
    with pytest.raises(ConfigError, match=r"holds no perception\.json"):
        replay(tmp_path)


def test_a_run_that_kept_no_pictures_says_how_to_have_them(copied: Path):
    shutil.rmtree(copied / "frames")
    with pytest.raises(ConfigError, match=r"it kept no pictures\. Set cell\.frames = true"):
        replay(copied)


@pytest.mark.parametrize("text", ["{}", "[]", '{"format": 1}', '{"format": 1, "photograph": []}', "{"])
def test_a_file_that_does_not_tell_what_perception_got_is_named(tmp_path, text: str):
    (tmp_path / PERCEPTION).write_text(text)
    with pytest.raises(CellError, match=r"perception\.json cannot be read"):
        replay(tmp_path)
