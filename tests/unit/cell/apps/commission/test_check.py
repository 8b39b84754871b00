"""What a check leaves: figures beside their limits, and a record that tells when it counts no more."""

import pytest

from cell.apps.commission.check import VERSION, Progress, Result
from cell.apps.commission.sequence import CHECKS
from cell.config.cell_config import load_config
from cell.config.job import load_job
from drivers.errors import ConfigError


def test_a_figure_outside_its_limits_and_a_demand_that_is_not_met_make_a_check_wrong():
    result = Result()
    result.measure("way", 4.96, "mm", least=4.95, most=5.05)
    result.require("claw shows the part", True)
    assert (result.verdict, result.notes) == ("good", [])
    result.measure("way", 4.9, "mm", least=4.95, most=5.05, remedy="See the screw.")
    assert (result.verdict, result.notes) == ("wrong", ["way: 4.9 mm, allowed 4.95 to 5.05 mm. See the screw."])
    other = Result()
    other.require("claw shows the part", False)
    assert (other.verdict, other.as_dict()["notes"]) == ("wrong", ["claw shows the part: 0, allowed ≥ 1."])


@pytest.mark.parametrize(
    "text", ['{"version": 99}', '{"version": V}', "[]", '{"version": V, "results": {"links": {}}, "mended": []}']
)
def test_a_file_that_is_no_record_is_not_overwritten(tmp_path, text: str):
    (tmp_path / "progress.json").write_text(text.replace("V", str(VERSION)))
    with pytest.raises(ConfigError, match="no record of a commissioning"):
        Progress(tmp_path, {"name": "x"}, load_job("pot")[0])


def test_a_changed_configuration_makes_stale_what_rests_on_it_and_no_more(tmp_path):
    job, _ = load_job("pot")
    progress, config = Progress(tmp_path, {"name": "x"}, job), load_config(None)
    for check in CHECKS:
        progress.keep(check, config, Result(), 1.0, "")
    again = Progress(tmp_path, {"name": "x"}, job)
    assert {again.standing(check, config) for check in CHECKS} == {"good"}
    wider = config.model_copy(update={"scan_camera": config.scan_camera.model_copy(update={"focal_length": 0.012})})
    stale = {check.name for check in CHECKS if again.standing(check, wider) == "stale"}
    assert {"scan_picture", "scan_mounting", "rail_direction", "outputs", "calibration"} <= stale
    assert not {"links", "arm_axes", "payload", "target_picture", "target_mounting"} & stale
    other = Progress(tmp_path, {"name": "y"}, job)
    assert {other.standing(check, config) for check in CHECKS} == {"stale"}
