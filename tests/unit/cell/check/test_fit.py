"""A way between two stops that the vehicle cannot go is refused; the other refusals: `test_wrong_inputs.py`."""

import pytest

from cell.check.fit import require_fit
from cell.config.cell_config import load_config
from cell.config.job import load_job
from drivers.errors import ConfigError
from tests.unit.cell.config.test_job import changed_copy


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('-2750 mm", "0 mm"', '-750 mm", "0 mm"', "from stop left to stop right: .* within .* of the table at x"),
        ('-2750 mm", "0 mm"', '-2300 mm", "0 mm"', "right: at approach.staging the vehicle is still .* beside"),
        ('-2750 mm", "0 mm"', '-2750 mm", "50 mm"', "from stop left to stop right the floor rises by"),
        ("0.4 m/s", "0.025 m/s", r"from stop left to stop right takes \d+ s \(allowed: at most 150 s\)"),
    ],
)
def test_a_way_between_two_stops_that_the_vehicle_cannot_go_is_refused(tmp_path, old: str, new: str, words: str):
    job, mesh = load_job(f"{changed_copy('two-stations', tmp_path, old, new)}#2")
    with pytest.raises(ConfigError, match=words):
        require_fit(job, load_config(None), mesh)


def test_a_plate_that_the_rail_does_not_take_the_camera_to_is_refused():
    config, (job, mesh) = load_config(None), load_job("pot")
    far = config.model_copy(update={"laser": config.laser.model_copy(update={"witness": 0.9})})
    with pytest.raises(ConfigError, match=r"laser\.witness 900 mm is outside rail\.travel, 0 to 100 mm"):
        require_fit(job, far, mesh)
