"""Which test files run on one worker."""

import re

from tests.conftest import HERE, VIRTUAL_JOB, place


def test_files_that_share_the_virtual_job_are_in_its_groups():
    """Each worker that is asked for it makes it anew, which takes 20 s: add the file to one of `VIRTUAL_JOB`."""
    asks = re.compile(r"^def .*\b(placed_pot|unloaded_part|station|lying_part|ends|calibrated_folder): ", re.MULTILINE)
    share = [file for file in HERE.rglob("test_*.py") if asks.search(file.read_text(encoding="utf-8"))]
    assert share
    assert [file.name for file in share if place(file)[0] not in VIRTUAL_JOB] == []
