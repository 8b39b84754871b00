"""Promises of `cell.apps.new_job.sweeps`."""

import re

import numpy as np
import pytest

from drivers.errors import RefusedError
from tests.unit.cell.apps.new_job.meshes import from_options, relief


def test_a_surface_that_repeats_itself_is_refused_by_its_pitch(tmp_path):
    pattern = relief(tmp_path / "p.stl", lambda x, y: 6 + np.cos(2 * np.pi * x / 6) + np.cos(2 * np.pi * y / 6))
    with pytest.raises(RefusedError, match=r"looks the same elsewhere: shifted by .*6\.0") as refused:
        from_options(tmp_path, mesh=str(pattern))
    assert re.search(r'--prior "0\.(89|9) mm" or less', str(refused.value))
