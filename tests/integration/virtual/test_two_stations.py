"""A job with two stations: a part is placed at each, and a run that was cut short is resumed at its own stop."""

from pathlib import Path

import numpy as np
import pytest

from cell import Cell
from cell.devices.simulated.direct import VirtualCell
from cell.run.record.replay import replay
from lab.bench.job.whole_job import JobRecord
from sim_backends.world.drawing import inverse
from statemachine.step import Event
from tests.support.described_cells import UNDRAWN, described, quick_job


def test_a_part_is_placed_at_each_stop_also_when_the_second_run_was_cut_short(
    placed_pot: JobRecord, calibrated_folder: Path
):
    fast, told = quick_job("two-stations", calibrated_folder), list[str]()
    cell_file, _ = described(calibrated_folder, UNDRAWN)
    with Cell.open(cell_file, sim="all", seed=placed_pot.seed, clock="virtual", job=fast) as cell:
        assert isinstance(cell.simulated, VirtualCell)
        world = cell.simulated.world

        def end(event: Event) -> None:
            told.append(f"{event.step}: {event.data.get('text')}")
            run = cell.current
            if event.step == "laser_sweep" and run is not None and sum("leaving stop left" in text for text in told):
                run.abort("seen enough")

        batch = cell.run_batch(fast, observer=end)
        assert [run.outcome for run in batch.runs] == ["placed", "aborted"], batch.reason
        assert [run.report["stop"] for run in batch.runs] == ["left", "right"]
        assert batch.runs[1].report["part"] == "held"
        done = cell.resume()
        assert (done.outcome, done.report["stop"], done.report["job"]) == ("placed", "right", "two-stations#2")
        assert world.collisions.found == () and all(each.same for each in replay(done.folder))
        for item in world._items:
            lies = inverse(item.scene.world_from_surface) @ item.part.part_pose(np.eye(4))
            assert not item.part.held and np.linalg.norm(lies[:3, 3]) < 0.6e-3
        apart = np.linalg.norm(np.subtract(*(item.part.part_pose(np.eye(4))[:2, 3] for item in world._items)))
        assert apart == pytest.approx(2.75 * np.sqrt(2), abs=0.1), "one at each"
