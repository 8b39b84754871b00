"""What several test files need and what takes long to make, once for all of them; and which files run beside which.

Three workers share the two cores: tests over the wires mostly wait, and what only computes gets what they leave. Files
of a group run on one worker, one after the other, because they share what is made once for a worker, or because devices
over wires would disturb each other's time.
"""

import os
from functools import cache, partial
from pathlib import Path

import pytest
import typer.main
from xdist.scheduler import LoadFileScheduling

from cell.apps.cli import main
from cell.config.calibrations.store import save_calibration
from cell.devices.simulated.direct import VirtualCell
from lab.bench.job.whole_job import JobRecord, run_whole_job
from tests.support import Typed
from tests.support.at_station import AtStation, Station
from tests.support.lying_part import Lying, LyingPart
from tests.support.report_runs import CONFIG, Ended, Ends, Make, pot
from tests.support.unloading import unloaded

GROUPS = (
    # One cell at a time, as an engineer runs it; those first that need little of what the job compiles.
    ("integration/wire/cell/test_commands.py", "unit/sim_backends/test_serve.py",
     "integration/wire/cell/test_whole_job.py", "integration/browser/test_screen.py"),
    # One device at a time; they mostly wait.
    ("unit/drivers/rail/tmcl/test_rail.py", "integration/wire/vehicle/test_vehicle_driver.py",
     "unit/drivers/rail/modbus/test_rail.py", "unit/cell/devices/contracts/test_test_configured.py",
     "unit/drivers/vehicle/cia402/test_vehicle.py", "integration/wire/vehicle/test_canopen_contract.py"),
    # The arm; last those whose times are compared most closely: at first others still compile.
    ("integration/wire/arm/test_arm_others.py", "integration/wire/arm/test_factory_kinematics.py",
     "unit/drivers/test_last_words.py", "integration/wire/safety/test_safe_stop_over_wires.py",
     "unit/drivers/arm/test_session.py", "unit/drivers/arm/test_ur.py", "unit/drivers/camera/test_stream.py",
     "unit/drivers/camera/genicam/test_camera.py", "unit/drivers/camera/genicam/test_aravis.py",
     "unit/drivers/relay/test_boards.py", "unit/drivers/claw/test_robotiq.py"),
    # The virtual job, what is told of its ends, and jobs that pick.
    ("integration/virtual/test_virtual_door.py", "unit/cell/run/report", "unit/cell/run/report/page",
     "unit/cell/run/test_job_run.py", "unit/cell/run/test_batch.py", "unit/cell/apps/console/host/test_part_queue.py",
     "unit/cell/apps/cli/test_display.py", "unit/cell/devices/simulated/test_direct.py",
     "integration/virtual/test_described_jobs.py", "integration/virtual/test_verify_job.py",
     "integration/virtual/test_two_stations.py", "schedules/test_schedules.py",
     "unit/cell/procedures/steps/test_pick.py", "unit/cell/procedures/steps/test_pick_nest.py",
     "unit/cell/procedures/steps/test_verify_nest.py"),
    # Its steps, one by one.
    ("unit/cell/procedures/arm/test_touch.py", "unit/cell/procedures/calibrate/test_verification.py",
     "unit/cell/procedures/calibrate/test_interim.py", "unit/cell/procedures/test_part_error.py",
     "unit/cell/procedures/calibrate/test_timing.py", "unit/cell/procedures/steps/test_board_photo.py",
     "unit/cell/procedures/steps/test_laser_sweep.py", "unit/cell/procedures/steps/test_reconstruct.py",
     "unit/cell/procedures/steps/test_invert_pose.py", "unit/cell/procedures/steps/test_gripping.py",
     "unit/cell/procedures/steps/test_place.py", "unit/cell/procedures/steps/test_verify.py",
     "unit/cell/procedures/steps/test_correction.py", "unit/cell/procedures/sweep/test_second_look.py",
     "unit/cell/measure/inversion/effects/test_between_sweeps.py",
     "unit/cell/measure/inversion/effects/test_causes.py", "unit/cell/measure/inversion/test_disagreement.py",
     "unit/cell/measure/inversion/test_mating.py", "unit/drivers/vehicle/test_fixed.py",
     "unit/lab/bench/job/test_cycle.py", "unit/cell/run/record"),
    # Each worker gets two groups at first: a short one for the first, the screens for that of the arm.
    ("unit/cell/measure/calibration/solve/test_joint.py",),
    ("unit/lab/bench/board/test_campaign.py",),
    (*(f"unit/cell/apps/console/{folder}" for folder in ("host", "server", "view")), "integration/console",
     "integration/browser"),
    # Long ones begin early, so that no worker is left with one of them at the end.
    ("integration/recorded/test_recorded_calibration.py", "unit/cell/apps/cli/calibration/test_calibrate.py"),
    ("unit/cell/measure/inversion/test_registration.py",),
    ("unit/cell/devices/gate/test_interlocks.py",),
    # They share what is solved of one head.
    tuple(f"unit/cell/measure/calibration/{name}.py" for name in (
        "test_archive", "judge/test_coverage", "judge/test_scale", "solve/test_results", "solve/test_adjustment")),
)  # fmt: skip
"""Groups of files or folders in the order in which they begin, the wires first. Any other file over the wires, wherever
it is, ends the group of its device, or the first; what only computes is a group of its own, after them."""

DEVICES = {"rail": 1, "vehicle": 1, "arm": 2, "camera": 2, "relay": 2, "claw": 2, "switches": 2}
"""The group of a file over the wires by the folder that it is in, such as `unit/drivers/rail`."""

VIRTUAL_JOB = (3, 4)
"""The groups whose files share `placed_pot`: on one worker they would end last."""

HERE = Path(__file__).parent
PLACES = {HERE / name: (number, k) for number, group in enumerate(GROUPS) for k, name in enumerate(group)}
WIRES = HERE / "integration" / "wire"
SCREENS = tuple(HERE / name for name in ("integration/browser", "integration/console", "unit/cell/apps/console"))
ON_THE_WALL = (*SCREENS, HERE / "unit" / "drivers" / "vehicle" / "test_agilex.py")
WHOLE_CELL, COMPUTES = 5, 19
"""How much nicer than a single device, whose times are compared to milliseconds, the others are: a whole cell keeps
deadlines of seconds on the wall, and what only computes gets what the others leave."""
MISSED = 75
"""The exit code of such a run where only tests with deadlines on the wall failed: EX_TEMPFAIL, try again."""
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Linear algebra of more workers than cores waits for itself where each has as many threads as there are cores."""


PUT_TOGETHER = cache(typer.main.get_command)


@cache
def over_wires(file: Path) -> bool:
    """Whether devices over their wires are in the file: it is in their folder, or says so with the marker `wire`."""
    return file.is_relative_to(WIRES) or "pytest.mark.wire" in file.read_text(encoding="utf-8")


def on_the_wall(file: Path) -> bool:
    """Whether the tests of the file keep deadlines on the wall."""
    return over_wires(file) or any(map(file.is_relative_to, ON_THE_WALL))


def place(file: Path) -> tuple[int, int]:
    """Which group a file belongs to, and where in it it comes."""
    for found in (file, file.parent):
        if found in PLACES:
            return PLACES[found]
    if not over_wires(file):
        return len(GROUPS), 0
    group = next((DEVICES[name] for name in file.relative_to(HERE).parts if name in DEVICES), 0)
    return group, len(GROUPS[group])


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with what lasts longest. Devices keep deadlines on the wall, which more workers than cores cannot always: a
    failure there is looked at again a little later, and listed. What is wrong fails each time."""
    items.sort(key=lambda item: place(item.path))
    again = config.pluginmanager.hasplugin("rerunfailures")
    for item in items:
        if again and on_the_wall(item.path):
            item.add_marker(pytest.mark.flaky(reruns=3, reruns_delay=5))


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """A run in which nothing but deadlines on the wall were missed ends with `MISSED`: `.ci/run` looks again, alone."""
    shown = session.config.pluginmanager.get_plugin("terminalreporter")
    if exitstatus != pytest.ExitCode.TESTS_FAILED or shown is None or not session.config.getoption("numprocesses"):
        return
    bad = [report.nodeid for kind in ("failed", "error") for report in shown.stats.get(kind, [])]
    if bad and all(on_the_wall(session.config.rootpath / name.split("::")[0]) for name in bad):
        session.exitstatus = MISSED


class Grouped(LoadFileScheduling):
    """Gives a worker a whole group of files at a time."""

    def _split_scope(self, nodeid: str) -> str:
        file = super()._split_scope(nodeid)
        group, _ = place(self.config.rootpath / file)
        return file if group == len(GROUPS) else f"group {group}"


def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> LoadFileScheduling | None:
    """Files by their groups where the tests are distributed by file."""
    return Grouped(config, log) if config.getvalue("dist") == "loadfile" else None


def pytest_configure(config: pytest.Config) -> None:
    """Before the workers start, which inherit it."""
    for name in ONE_THREAD:
        os.environ.setdefault(name, "1")
    if config.getoption("numprocesses"):
        # Without bytecode on disk each worker and each of the commands that tests start would compile all sources.
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """A worker gives way to those whose times matter more; it may not take that back, so its groups come in that order.
    By the place of the file and not by its marker: a file that only computes may stand among devices."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return
    group, _ = place(item.path)
    if group >= VIRTUAL_JOB[0]:
        wanted = COMPUTES
    else:
        wanted = WHOLE_CELL if group == 0 or any(map(item.path.is_relative_to, SCREENS)) else 0
    if os.nice(0) < wanted:
        os.nice(wanted - os.nice(0))


@pytest.fixture(scope="session")
def placed_pot(tmp_path_factory) -> JobRecord:
    """The job `pot` on the virtual clock, calibrated by itself: seed 2, nominal, swept twice as fast as shipped."""
    job, nominal = pot()
    record = run_whole_job(CONFIG, job, nominal, 2, "nominal", runs=tmp_path_factory.mktemp("placed"))
    assert (record.outcome, record.reason) == ("placed", "")
    return record


@pytest.fixture(scope="session")
def unloaded_part(placed_pot: JobRecord, tmp_path_factory) -> JobRecord:
    """The job `unload` in the world of `placed_pot`, with a part that clings to its surface."""

    def clings(cell: VirtualCell) -> None:
        cell.world.part.sticks = 10.0

    record = unloaded(placed_pot, clings, runs=tmp_path_factory.mktemp("unloaded"))
    assert (record.outcome, record.reason) == ("placed", "")
    return record


@pytest.fixture(scope="session")
def ends(placed_pot: JobRecord, tmp_path_factory) -> Ends:
    """Gives the run that ends as `tests.support.report_runs` says; each is made once."""
    root = tmp_path_factory.mktemp("cell") / "runs"
    made: dict[Make, Ended] = {}

    def get(make: Make) -> Ended:
        if make not in made:
            made[make] = make(placed_pot, root)
        return made[make]

    return get


@pytest.fixture
def station(placed_pot: JobRecord, tmp_path) -> Station:
    """Gives a cell that stands where `placed_pot` placed."""
    return partial(AtStation, placed_pot, tmp_path)


@pytest.fixture
def lying_part(placed_pot: JobRecord, tmp_path) -> Lying:
    """Gives a part that lies in the cell of `placed_pot`."""
    return partial(LyingPart, placed_pot, tmp_path)


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    """The present folder, which is a new one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def calibrated_folder(placed_pot: JobRecord, here: Path) -> Path:
    """The present folder, with the calibration of `placed_pot` among its own."""
    assert placed_pot.calibration is not None
    save_calibration(placed_pot.calibration, here / "calibrations" / f"{placed_pot.calibration.name}.json")
    return here


@pytest.fixture
def typed(capsys, monkeypatch) -> Typed:
    """Gives what a `cell` command comes to, run in this process and folder: exit code, output, complaints."""

    # A process runs one command; typer puts all of them together anew for each.
    monkeypatch.setattr("typer.main.get_command", PUT_TOGETHER)

    def run(*words: str) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["cell", *words])
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main()
        out, error = capsys.readouterr()
        return int(ended.value.code or 0), out, error

    return run
