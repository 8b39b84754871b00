"""The place by the job's step: a carriage that droops is in its covariance, and what is known too little is told."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import difference
from cell.measure.inversion import NominalSurface, PlacePose
from cell.measure.inversion.effects.between_sweeps import Creep
from cell.measure.inversion.effects.during_sweep import LEAST_SAG, Droop, Head, bow
from cell.measure.reconstruction.cloud import Cloud
from cell.procedures.part_error import stated_bound
from cell.procedures.steps.invert_pose import LineTimes, inverted
from cell.procedures.steps.invert_pose import invert_pose as step
from cell.procedures.steps.place import carried_on
from cell.run.report.report import place_error
from drivers.errors import NotObservable, RefusedError
from lab.bench.job.scan_errors import own_base, surface_at_middle
from lab.bench.job.whole_job import JobRecord, run_whole_job
from tests.support.at_station import AtStation, Station
from tests.support.report_runs import CONFIG, NAMES, changed, pot


def head_of(record: JobRecord, cloud: Cloud) -> Head:
    scan, sweep = record.calibration.scan, record.results["laser_sweep"]
    travel = CONFIG.rail.travel[1]
    return Head.of(cloud, sweep.base_from_flange, scan.flange_from_camera, scan.rail_direction, travel)


def drooped(record: JobRecord, sag: float) -> Cloud:
    """The record's cloud, with the carriage sunk by `sag` m at the end of its travel."""
    cloud = record.results["reconstruct"].cloud
    lines, rows = np.nonzero(cloud.valid)
    points = cloud.points.copy()
    points[lines, rows] -= Droop(sag, 0.0, head_of(record, cloud)).motions(cloud, lines, rows).sum(axis=2)
    return replace(cloud, points=points)


def inverted_of_droop(record: JobRecord, sag: float) -> PlacePose:
    """By the job's step, with the carriage sunk by `sag` m at the end of its travel."""
    made, (job, nominal) = record.results, pot()
    sweep, bent = made["laser_sweep"], drooped(record, sag)
    vehicle = CONFIG.arm.vehicle_from_base.se3().inverse()
    taken = LineTimes(sweep.times, vehicle, head_of(record, bent))
    return step(replace(made["reconstruct"], cloud=bent), made["board_photo"], job, nominal, record.kinematic, taken)


@pytest.mark.parametrize("sag", [0.15e-3, -0.1e-3])
def test_a_carriage_that_droops_is_told_and_in_the_stated_covariance(placed_pot: JobRecord, sag: float):
    good, found = placed_pot.results["invert_pose"], inverted_of_droop(placed_pot, sag)
    (note,) = found.notes
    assert "bowed along the rail, as if its carriage had sunk by" in note and "cell calibrate" in note
    off = difference(good.base_from_surface, found.base_from_surface)
    assert np.linalg.norm(off[3:]) > 0.5e-3
    assert off @ np.linalg.solve(good.covariance, off) > 12.6
    assert off @ np.linalg.solve(found.covariance, off) < 12.6


def test_without_a_droop_nothing_is_added_and_too_large_a_one_is_refused(placed_pot: JobRecord):
    good, found = placed_pot.results["invert_pose"], inverted_of_droop(placed_pot, 0.0)
    assert found.notes == good.notes == ()
    np.testing.assert_array_equal(found.covariance, good.covariance)
    with pytest.raises(NotObservable, match=r"not determined.*as if its carriage had sunk by 0\.[3-5]"):
        inverted_of_droop(placed_pot, 0.4e-3)


def test_a_rail_that_ends_at_its_zero_goes_to_its_other_end(placed_pot: JobRecord, station: Station):
    made, work = placed_pot.results, station(folded=False).work
    rail = work.config.rail.model_copy(update={"travel": (-0.1, 0.0)})
    work.config = work.config.model_copy(update={"rail": rail})
    scan = replace(made["reconstruct"], cloud=drooped(placed_pot, 0.15e-3))
    (note,) = inverted(work, made["laser_sweep"], scan, made["board_photo"]).notes
    assert "as if its carriage had sunk by 0.1" in note


def test_a_place_that_is_carried_on_for_a_creep_keeps_what_the_droop_adds(placed_pot: JobRecord, station: Station):
    made, work = placed_pot.results, station(folded=False).work
    good, sweep = made["invert_pose"], made["laser_sweep"]
    rate, origin = np.array([6e-6, 0, 0, 0, 3e-6, 0]), good.base_from_surface.translation
    creep = Creep(rate, np.diag(np.full(6, 0.1e-6**2)), origin, float(sweep.times.mean()))
    creeping = replace(creep, rate=-rate).undone(drooped(placed_pot, 0.1e-3), sweep.times)
    scan = replace(made["reconstruct"], cloud=creeping)
    found = carried_on(work, sweep, scan, made["board_photo"], creep)
    (note,) = found.notes
    assert "as if its carriage had sunk by" in note
    assert (found.sigma > 0.99 * inverted_of_droop(placed_pot, 0.1e-3).sigma).all()
    assert (found.sigma / good.sigma).max() > 3


def rolling(record: JobRecord, folder: Path, angle: float) -> AtStation:
    """Where the record placed, in a world whose vehicle rolls by ±`angle` rad."""

    def rolls(cell: VirtualCell) -> None:
        scene = cell.world.scene
        workshop = replace(scene.workshop, rocking=np.array([angle, 0.0]), rocking_hz=3.0)
        cell.world.remake(replace(scene, workshop=workshop), cell.world.station)

    return AtStation(record, folder, changed=rolls)


def test_a_vehicle_that_rolls_is_in_the_stated_covariance_though_no_height_of_the_scan_shows_it(
    placed_pot: JobRecord, tmp_path
):
    site = rolling(placed_pot, tmp_path, 0.3e-3)
    pose, found = site.do(*NAMES[1:]).pose, site.ended
    # ±.3 mrad at .6 m above the ground, one standard deviation.
    assert pose.sigma[1] == pytest.approx(0.3e-3 * 0.6 / np.sqrt(2), rel=0.25)
    error = place_error(site.job, site.nominal, found.at_end)["d_p95"]
    assert error < stated_bound(site.job, site.nominal, pose, found.placing)["d"]


def test_a_vehicle_that_rolls_too_much_is_refused_by_the_photographs(placed_pot: JobRecord, tmp_path):
    told = r"the vehicle rocks by ±0\.[56]\d mrad, which moves the board by ±0\.[45]\d mm"
    with pytest.raises(RefusedError, match=told):
        rolling(placed_pot, tmp_path, 0.6e-3).do("board_photo")


@pytest.mark.campaign
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("name", ["pot", "seat", "panel"])
def test_a_droop_since_the_calibration_is_in_the_stated_covariance_or_refused(name: str, seed: int):
    """Prints the bow without a droop, and with one of .1 mm how far the place is off against its covariance."""
    job, mesh = load_job(name)
    nominal = NominalSurface.load(mesh, unit=job.surface.mesh_unit)
    good = run_whole_job(CONFIG, job, nominal, seed, "nominal")
    assert (good.outcome, good.reason) == ("placed", "")
    found, cloud = good.results["invert_pose"], good.results["reconstruct"].cloud
    untouched = bow(cloud, nominal, found.base_from_surface, head_of(good, cloud))
    told = " ".join(found.notes)
    print(f"{name} {seed}: bow {1e6 * untouched[0]:.1f} ± {1e6 * untouched[1]:.1f} µm {told}")
    worn = run_whole_job(CONFIG, job, nominal, seed, "nominal+droop", calibrated=good)
    if worn.outcome == "placed":
        found = worn.results["invert_pose"]
        off = difference(found.base_from_surface, own_base(worn) * surface_at_middle(worn))
        distance = float(off @ np.linalg.solve(found.covariance, off))
        print(f"{name} {seed}: droop, m² {distance:.1f} {' '.join(found.notes)}")
        assert distance <= 12.6
    else:
        print(f"{name} {seed}: droop, {worn.outcome}: {worn.reason}")
        assert "as if its carriage had sunk by" in worn.reason
    assert abs(untouched[0]) < LEAST_SAG and "bowed" not in told


@pytest.mark.parametrize("doubts", [(), ("nobody looked where the laser points",)])
def test_where_the_place_is_known_too_little_what_was_noted_of_the_sweep_is_told(
    placed_pot: JobRecord, station: Station, doubts: tuple[str, ...]
):
    job, made = changed(pot()[0], "place", tolerance=0.05e-3), placed_pot.results
    workplace = station(job, folded=False).work
    sweep = replace(made["laser_sweep"], doubts=doubts)
    with pytest.raises(NotObservable) as caught:
        inverted(workplace, sweep, made["reconstruct"], made["board_photo"])
    assert ("Before: nobody looked where the laser points" in str(caught.value)) == bool(doubts)
