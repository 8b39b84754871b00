"""A whole job whose scan camera is on GigE Vision: as accurate as over the frame stream."""

import json

import pytest

from tests.support.wire.cells import cell, named
from tests.support.wire.gige_bench import require_aravis

pytestmark = [pytest.mark.wire, pytest.mark.campaign]


def test_a_dry_run_with_the_scan_camera_on_gige_vision_ends_placed(tmp_path):
    require_aravis()
    named(tmp_path, "gige", 'address = "192.0.2.20"')
    done = cell("dry-run", "-c", "cell.toml", "--seed", "1", "--json", folder=tmp_path, timeout=900.0)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["outcome"] == "placed"
    error = report["truth"]["error_mm"]["d"]
    # Over the frame stream the mean of nominal worlds is 0.02 to 0.09 mm.
    assert error["mean"] < 0.12
