"""Work outside a job leaves what it looked at: a refused calibration or verification can be judged by its pictures."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.base.lateness import Lateness
from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.vision.board.view import parse_board
from cell.motion.kinematics import HOME
from cell.procedures.arm.moves import Mover
from cell.procedures.calibrate import boards
from cell.procedures.calibrate.boards import collect_scan, look_for
from cell.run import recorded_work
from cell.run.recorded_work import RecordedWork, WorkContext, classify
from cell.run.runs import Run
from drivers.camera.folder import read_image
from drivers.errors import RefusedError

CONFIG = load_config(None)
FINE = parse_board(CONFIG.calibration.fine.board)


def recorded(root: Path, cell: VirtualCell, work: Any) -> tuple[dict[str, Any], Path]:
    """The report of a calibration that is refused, and its folder; nothing of the bench's health ends the work."""
    given = "calibration", cell.devices, root, {}, lambda devices: None
    run: Run[None] = Run("calibration", lambda run: RecordedWork(run, *given).perform(work))
    with pytest.raises(RefusedError):
        run.result(300.0)
    return json.loads((run.folder / "report.json").read_text()), run.folder


def test_a_refused_calibration_leaves_its_pictures_and_says_which_it_refused(tmp_path, monkeypatch):
    """Its lamp is out: the fine board is seen at no view."""
    views = boards.scan_calibration_views
    monkeypatch.setattr(boards, "scan_calibration_views", lambda *given: views(*given)[:13])
    dark = CONFIG.model_copy(update={"scan_camera": CONFIG.scan_camera.model_copy(update={"photo_exposure": 20e-6})})
    cell = VirtualCell(dark, seed=4, level="ideal")

    def work(context: WorkContext) -> None:
        cell.devices.vehicle.brake()
        mover = Mover(cell.devices.arm, cell.clock, dark, load_job("pot")[0])
        collect_scan(dark, cell.devices, mover, context.check, context.progress, context.keep)

    report, folder = recorded(tmp_path, cell, work)
    assert report["outcome"] == "refused" and "of 13 calibration views show the board" in report["reason"]
    kept = sorted((folder / "frames").glob("fine-*-refused-*.png"))
    assert {path.name.split("-")[1] for path in kept} == {f"{k:02d}" for k in range(1, 14)}
    assert len(report["last_frames"]) == 12
    assert all((folder / name).exists() for name in report["last_frames"])


def test_what_is_kept_is_the_very_picture(tmp_path):
    cell = VirtualCell(CONFIG, seed=4, level="ideal")
    pictures: list[np.ndarray] = []

    def work(context: WorkContext) -> None:
        def keep(what: str, frame: Any) -> None:
            pictures.append(frame.image)
            context.keep(what, frame)

        cell.devices.vehicle.brake()
        Mover(cell.devices.arm, cell.clock, CONFIG, None).to_joints(HOME)
        cell.devices.scan_camera.configure(CONFIG.scan_camera.photo_exposure, 10.0)
        assert look_for(cell.devices.scan_camera, FINE, Counter(), keep, "fine-01") is None
        raise RefusedError("no board")

    report, folder = recorded(tmp_path, cell, work)
    (name,) = report["last_frames"]
    assert name.startswith("frames/fine-01-refused-")
    assert np.array_equal(read_image(folder / name, pictures[0].shape), pictures[0])


def test_work_that_looks_at_nothing_leaves_no_folder_for_it(tmp_path):
    def work(context: WorkContext) -> None:
        raise RefusedError("not today")

    report, folder = recorded(tmp_path, VirtualCell(CONFIG, seed=4, level="ideal"), work)
    assert not (folder / "frames").exists()
    assert "last_frames" not in report


@pytest.mark.parametrize(
    ("rate", "late", "words"),
    [(3.0, 0.4, "woke up 400 ms late. The simulated cell keeps 3 times the wall's pace: `--speed 1`"), (3.0, 0.01, ""),
     (1.0, 0.4, "")],
)  # fmt: skip
def test_a_refusal_of_a_cell_that_outran_its_computer_says_so(rate: float, late: float, words: str, monkeypatch):
    lateness = Lateness()
    lateness.rate = rate
    monkeypatch.setattr(recorded_work, "LATENESS", lateness)
    monkeypatch.setattr(Lateness, "worst", late)
    reason = classify(RefusedError("the board is not seen")).reason
    assert reason.startswith("the board is not seen")
    assert words in reason and (bool(words) or "late" not in reason)
