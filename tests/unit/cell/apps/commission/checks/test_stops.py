"""Each cause stops what moves or shines in a simulated cell, and a stop that comes late is measured."""

from contextlib import closing

import pytest

from cell.apps.commission.check import Result
from cell.apps.commission.checks.stops import MOST_S, MOST_WAY
from cell.apps.commission.sequence import by_name
from tests.support.commissioning import Shown, files, opened


@pytest.mark.parametrize("late_s", [0.0, 1.5])
def test_time_and_way_until_rest_are_measured_for_each_cause(tmp_path, monkeypatch, late_s: float):
    files(tmp_path)
    made, result = opened(tmp_path, Shown()), Result()
    with closing(made.workplace):
        cell, stop = made.workplace.cell, made.workplace.cell.stop
        monkeypatch.setattr(cell, "stop", lambda: (cell.devices.clock.sleep(late_s), stop()))
        by_name("stops").work(made.workplace, result)
    rows = {row.what: row for row in result.readings}
    for name in ("rail", "arm", "vehicle"):
        for cause in ("Cell.stop()", "`cell abort`"):
            time, way = rows[f"{name}, {cause}: time to rest, at most"], rows[f"{name}, {cause}: way"]
            assert (time.most, way.most) == (MOST_S, MOST_WAY[name])
            assert time.ok is not (late_s > 0.0 and cause == "Cell.stop()")
    late = {row.what for row in rows.values() if not row.ok}
    assert late >= {"rail, Cell.stop(): time to rest, at most", "laser, Cell.stop(): off after, at most"} or not late_s
    assert result.verdict == ("wrong" if late_s else "good")
