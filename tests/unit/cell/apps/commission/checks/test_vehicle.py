"""What the board of a station says of the job and of the wheels."""

from contextlib import closing

from typer.testing import CliRunner

from cell.apps.cli.app import app
from cell.apps.commission.check import Result
from cell.apps.commission.checks.vehicle import judge_board
from cell.apps.commission.sequence import by_name
from cell.config.job import load_job
from cell.measure.vision.board.view import parse_board
from tests.support.commissioning import Shown, files, opened
from tests.support.described_cells import described


def test_a_station_board_of_another_pitch_is_written_into_a_job_of_ones_own_and_not_into_one_that_ships(tmp_path):
    files(tmp_path)
    _, job = described(tmp_path / "own")
    check, shown = by_name("station"), Shown()
    for name, written in (("pot", {}), (str(job), {"board.spec": '"marked_dots:9x7:24mm"'})):
        made, result = opened(tmp_path, shown, job=name), Result()
        with closing(made.workplace):
            judge_board(name, parse_board(made.workplace.job.board.spec), 1.201, result)
            (finding,) = result.findings
            assert finding.write_job == written
            assert 'write spec = "marked_dots:9x7:24mm"' in str(finding) or "own.toml it has to read" in str(finding)
            made.progress.keep(check, made.workplace.config, Result(), 1.0, "")
            assert made._mend(check, result) is bool(written)
            assert made.progress.standing(check, made.workplace.config) == ("stale" if written else "good")
    assert load_job(job)[0].board.spec == "marked_dots:9x7:24mm"
    assert len(list(job.parent.glob("own.toml.before-*"))) == 1


def test_the_board_of_one_of_several_stops_is_left_to_a_person(here):
    CliRunner().invoke(app, ["init", "own", "--job", "two-stations"])
    job, result = "own/two-stations.toml#2", Result()
    judge_board(job, parse_board(load_job(job)[0].board.spec), 1.201, result)
    (finding,) = result.findings
    assert not finding.write_job and "or the board of stop right, in " in finding.remedy
