"""A file that is no TOML of ours is refused by name, with the line and what to do about it."""

import os
from typing import Annotated

import pytest

from cell.base.toml_file import read_toml, restored, validate
from drivers.common.units import quantity
from drivers.errors import CellError, ConfigError
from drivers.make import Table


class Rail(Table):
    lead: Annotated[float, quantity("mm", 0.1, 50)]


class File(Table):
    rail: Rail
    name: str = ""


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (bytes(range(256)), "no text in UTF-8"),
        ('name = "Prüfzelle"\n'.encode("latin-1"), "no text in UTF-8 .*save it as UTF-8"),
        (b"#" * 1_000_001, "larger than 1 MB"),
        (b'[cell]\nname = "cell\n', "line 2, .*name ="),
        (b"[cell\n", "not valid TOML"),
        (b'[cell]\nname = """cell', "not valid TOML.*close every quote"),
        (b"[cell]\nname =\n", "line 2, .*KEY = VALUE"),
        (b'[cell]\nname = "a"\nname = "b"\n', "line 3, .*remove one"),
        (b"[cell]\n[cell]\n", "line 2, .*remove one"),
        (b"a = " + b"[" * 5000, "not valid TOML"),
    ],
)
def test_a_file_that_is_no_toml_is_refused_with_its_line(tmp_path, content: bytes, says: str):
    path = tmp_path / "wrong.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=rf"(?s)wrong\.toml.*{says}"):
        read_toml(path, "configuration", "cell init")


def test_what_is_no_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, says in ((tmp_path, "is a folder"), (tmp_path / "pipe", "no regular file"), (tmp_path / "x", "`cell in")):
        with pytest.raises(ConfigError, match=says):
            read_toml(path, "configuration", "cell init")


def test_all_mistakes_are_told_at_once_each_by_its_key():
    with pytest.raises(ConfigError) as caught:
        validate(File, {"rail": {"lead": 2, "laed": "2 mm"}, "name": 7}, "cell.toml")
    head, *lines = str(caught.value).splitlines()
    assert head == "cell.toml is not valid:"
    assert [line.split(":")[0].strip() for line in lines] == ["rail.lead", "rail.laed", "name"]


def test_a_record_that_was_kept_is_restored_to_the_last_digit(tmp_path):
    path = tmp_path / "kept.json"
    path.write_text('{"rail": {"lead": 0.0020000000000000005}}')
    assert restored(File, path).rail.lead == 0.0020000000000000005
    path.write_text('{"rail": {}}')
    with pytest.raises(CellError, match="cannot be read as what the run was done with"):
        restored(File, path)


def test_a_mark_of_the_order_of_bytes_is_no_part_of_the_text(tmp_path):
    path = tmp_path / "x.toml"
    path.write_bytes("\ufeffkey = 1\n".encode())
    assert read_toml(path, "job", "") == {"key": 1}
