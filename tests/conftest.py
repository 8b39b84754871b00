"""What several test files need and what takes long to make: once for all of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from cell.lab.bench.whole_job import JobRecord, run_whole_job
from tests.report_runs import CONFIG, Ended, Ends, Make, pot

LONGEST = (
    "wire/test_whole_job.py",
    "recorded/test_recorded_calibration.py",
    "test_virtual_door.py",
    "wire/test_arm_endings.py",
    "wire/test_arm_driver.py",
    "wire/test_rail_driver.py",
    "test_inversion.py",
    "recorded/test_recorded_command.py",
    "test_end_screen.py",
)
"""Files that begin first, so that no worker is left with one of them at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what lasts longest."""
    ranks = {Path(__file__).parent / name: rank for rank, name in enumerate(LONGEST)}
    items.sort(key=lambda item: ranks.get(item.path, len(ranks)))


@pytest.fixture(scope="session")
def placed_pot() -> JobRecord:
    """The job `pot` on the virtual clock, calibrated by itself: seed 2, nominal, swept twice as fast as shipped."""
    job, nominal = pot()
    record = run_whole_job(CONFIG, job, nominal, 2, "nominal")
    assert (record.outcome, record.reason) == ("placed", "")
    return record


@pytest.fixture(scope="session")
def ends(placed_pot: JobRecord, tmp_path_factory: pytest.TempPathFactory) -> Ends:
    """Gives the run that ends as `tests.report_runs` says; each is made once."""
    root = tmp_path_factory.mktemp("cell") / "runs"
    made: dict[Make, Ended] = {}

    def get(make: Make) -> Ended:
        if make not in made:
            made[make] = make(placed_pot, root)
        return made[make]

    return get
