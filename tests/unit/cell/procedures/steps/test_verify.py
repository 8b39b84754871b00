"""The placed part as the scan head sees it: against where it truly lies, and against a fit that others wrote."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import scipy
import trimesh

from cell import Cell
from cell.config.cell_config import NO_FILES
from cell.config.job import FeatureSection, load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import difference, from_matrix, from_parts, transform
from cell.measure.inversion import NominalSurface
from cell.procedures.placed_part import COVERED, LIKELY, NO_FLUSH, OFF_DRAWING, PlacedPart
from cell.procedures.steps.kinds import PLACE, kind_of
from cell.procedures.steps.verify import CLOUD
from cell.run.record.replay import replay
from cell.run.report.page.make import make_page
from drivers.errors import ConfigError, DeviceFault, MisplacedError
from lab.bench.job.part_effects import EFFECTS, Change, head_slipped, laser_turned, motion, opened
from lab.bench.job.part_jobs import ALL, MIDDLE, job_with_part
from lab.bench.job.whole_job import JobRecord, run_whole_job
from sim_backends.models import rail
from sim_backends.optics.mesh import Mesh
from sim_backends.world.world import World
from tests.support.described_cells import quick
from tests.support.lying_part import Lying, LyingPart, creeps, moved
from tests.support.report_runs import CONFIG, changed

FRONT = ["0 mm", "18 mm", "26.3 mm"]
"""On the front rim of the top of the part that `job_with_part` draws on `pot`."""
OFF = moved(0.2e-3, -0.1e-3, 0.2e-3, turn=(0.002, -0.003, 0.003))


@pytest.fixture(scope="module")
def lying(placed_pot: JobRecord, tmp_path_factory) -> tuple[PlacedPart, LyingPart]:
    """A part that lies `OFF` its place and might lie better, swept as finely as shipped."""
    site = LyingPart(placed_pot, tmp_path_factory.mktemp("lying"), also="corrections = 1", faster=1.0)
    return site.looked(OFF), site


def require_seen(found: PlacedPart, off: pin.SE3) -> None:
    """Seen to hundredths of a millimetre where it is `off` its place, within what is stated."""
    error = difference(found.seen.surface_from_part, off)
    assert found.seen.beside > 1000 and found.unseen == ()
    assert np.linalg.norm(error[:3]) < 0.025e-3 and np.abs(error[3:]).max() < 0.25e-3
    # Chi-squared of 6 at 0.999.
    assert error @ np.linalg.solve(found.covariance, error) < 22.5
    # Most of it is where the laser points, which the plate on the claw shows to .1 mrad.
    assert found.unsure < 0.045e-3
    true = np.linalg.norm(transform(off, found.points) - found.points, axis=1)
    assert 1e3 * np.percentile(true, 95) < found.bound["d"] < 1e3 * np.percentile(true, 95) + 0.07


def test_where_the_placed_part_lies_is_seen_beside_the_surface_to_hundredths(lying: tuple[PlacedPart, LyingPart]):
    require_seen(lying[0], OFF)


def test_a_part_in_its_place_is_left_there_although_it_might_lie_better(lying: tuple[PlacedPart, LyingPart]):
    found, site = lying
    assert found.before == () and site.parts == []


def test_a_fit_that_others_wrote_finds_the_part_in_the_same_place(
    placed_pot: JobRecord, lying: tuple[PlacedPart, LyingPart]
):
    """Samples of the meshes by trimesh, least squares by scipy, on the cloud and the meshes as files."""
    found, site = lying
    cloud = np.asarray(trimesh.load(site.folder / CLOUD).vertices)
    pose = placed_pot.results["invert_pose"].base_from_surface
    local = (cloud - pose.translation) @ pose.rotation
    high = local[:, 2] > 0.012
    poses = []
    for points, file in ((local[high], "pot-part.ply"), (local[~high], "pot.ply")):
        mesh = trimesh.load(site.folder / file)
        chosen = points[np.random.default_rng(0).permutation(len(points))[:4_000]]
        poses.append(fitted(chosen, mesh))
    apart = poses[1].inverse() * poses[0]
    assert np.linalg.norm(apart.translation - found.seen.surface_from_part.translation) < 0.01e-3
    assert np.linalg.norm(pin.log3(apart.rotation.T @ found.seen.surface_from_part.rotation)) < 0.3e-3


def fitted(points: np.ndarray, mesh: trimesh.Trimesh) -> pin.SE3:
    """Where the mesh lies by points on its faces that look up; those at a rim are left out."""
    samples, faces = trimesh.sample.sample_surface(mesh, 200_000, seed=0)
    up = mesh.face_normals[faces][:, 2] > 0.3
    samples, normals = samples[up], mesh.face_normals[faces[up]]
    tree, start, used = scipy.spatial.cKDTree(samples), pin.SE3.Identity(), points
    for gate in (0.3e-3, 0.1e-3, 0.1e-3):
        here = (points - start.translation) @ start.rotation
        apart, nearest = tree.query(here)
        rim = np.abs(np.abs(samples[nearest, 0]) - MIDDLE[0]) < 0.8e-3
        high = np.abs(np.einsum("ni,ni->n", here - samples[nearest], normals[nearest]))
        used = points[(apart < 1e-3) & (high < gate) & ~rim]

        def left(v: np.ndarray, used: np.ndarray = used, start: pin.SE3 = start) -> np.ndarray:
            pose = start * from_parts(v[:3], pin.exp3(v[3:]))
            there = (used - pose.translation) @ pose.rotation
            _, nearest = tree.query(there)
            return np.asarray(np.einsum("ni,ni->n", there - samples[nearest], normals[nearest]))

        found = scipy.optimize.least_squares(left, np.zeros(6), loss="soft_l1", f_scale=0.02e-3, x_scale=1e-4)
        start = start * from_parts(found.x[:3], pin.exp3(found.x[3:]))
    return start


def test_the_flush_along_its_edge_is_by_how_much_its_pose_lifts_it(lying: tuple[PlacedPart, LyingPart]):
    flush = lying[0].flush
    assert flush is not None and len(flush.higher) > 15 and flush.seen > 0.8
    error = flush.higher - lifted(flush.places, OFF)
    # Where the surface is, beside the part, is known to about .005 mm.
    assert np.sqrt(np.mean(error**2)) < 0.025e-3 and abs(error.mean()) < 0.02e-3
    assert (np.abs(error) < flush.noise).all()


def lifted(places: np.ndarray, off: pin.SE3) -> np.ndarray:
    """How much higher (n,) m what lies at `places` (n, 3) is than where it belongs."""
    return np.asarray((places - transform(off.inverse(), places))[:, 2])


@pytest.mark.parametrize("much", [1.0, 1.5])
def test_a_vehicle_that_rocks_moves_what_is_seen_no_farther_than_is_stated(lying_part: Lying, much: float):
    """As much as 1.5 the quarters of the part disagree, but for its waves."""

    def rocks(cell: VirtualCell) -> None:
        scene = cell.world.scene
        rocking = replace(
            scene.workshop, rocking=much * np.array([4e-5, 8e-5]), rocking_hz=3.9, rocking_phase=np.zeros(2)
        )
        cell.world.remake(replace(scene, workshop=rocking), cell.world.station)

    found = lying_part(changed=rocks, faster=1.5).looked(moved(0.1e-3, z=0.05e-3))
    error = difference(found.seen.surface_from_part, moved(0.1e-3, z=0.05e-3))
    assert np.linalg.norm(error[:3]) < 0.03e-3 and np.abs(error[3:]).max() < 0.3e-3
    assert error @ np.linalg.solve(found.covariance, error) < 22.5
    assert any("rocked by 0.1" in note or "rocked by 0.08" in note for note in found.notes)
    if found.flush is None:
        assert much > 1.0 and NO_FLUSH in found.notes
        return
    assert (np.abs(found.flush.higher - lifted(found.flush.places, moved(0.1e-3, z=0.05e-3))) < found.flush.noise).all()


def test_a_vehicle_that_was_pushed_since_the_sweep_does_not_make_the_part_look_turned(lying_part: Lying):
    pushed = list[str]()

    def push(cell: VirtualCell, text: str) -> None:
        if not pushed:
            stands, surface = cell.world.vehicle.world_from_vehicle, cell.world.scene.world_from_surface
            turn = surface @ motion(turn=(0, 0, 12)) @ np.linalg.inv(surface)
            cell.world.vehicle.world_from_vehicle = lambda t: turn @ stands(t)
        pushed.append(text)

    site = lying_part(heard=push, also='corrections = 1\naccept = "0.05 mm"')
    found = site.looked(moved(0.1e-3, z=0.05e-3))
    error = difference(found.seen.surface_from_part, moved(0.1e-3, z=0.05e-3))
    assert np.linalg.norm(error[:3]) < 0.03e-3 and np.abs(error[3:]).max() < 0.3e-3
    assert re.search("surface or vehicle was pushed: it stands 0.* mm and 1[12].. mrad from", str(site.notes))
    assert not found.before and "nobody looked where the claw would go" in str(site.notes)


def test_where_nothing_of_the_surface_shows_the_earlier_sweep_tells_where_it_lies(lying_part: Lying):
    found = lying_part(half=(1.0, 1.0)).looked(moved(0.2e-3))
    error = difference(found.seen.surface_from_part, moved(0.2e-3))
    assert found.seen.beside == 0 and "against the surface as swept before" in found.words
    assert error @ np.linalg.solve(found.covariance, error) < 22.5
    assert 0.1e-3 < found.unsure < 0.25e-3


def test_a_part_that_is_not_as_drawn_about_its_features_is_told_though_it_lies_in_its_place(lying_part: Lying):
    """Of its top 12 mm are .5 mm lower, and its front ends .5 mm sooner."""

    def other(cell: VirtualCell) -> None:
        [item] = cell.world._items
        drawn = item.station.part_seen
        corners, triangles = trimesh.remesh.subdivide_to_size(drawn.vertices, drawn.triangles, 2e-3)
        top = corners[:, 2] > 0.012
        corners[top & (np.hypot(*corners[:, :2].T) < 6e-3), 2] -= 0.5e-3
        corners[top & (corners[:, 1] > 17.9e-3), 1] -= 0.5e-3
        cell.world._items = [replace(item, station=replace(item.station, part_seen=Mesh(corners, triangles)))]

    named = [
        {"name": "front", "kind": "edge", "at": FRONT, "axis": [1, 0, 0], "tolerance": "0.3 mm"},
        {"name": "top", "kind": "flat", "at": ["0 mm", "0 mm", "27 mm"], "axis": [0, 0, 1], "tolerance": "0.3 mm"},
        {"name": "pin", "kind": "pin", "at": ["9 mm", "0 mm", "27 mm"], "axis": [0, 0, 1], "tolerance": "0.3 mm"},
    ]
    features = tuple(map(FeatureSection.model_validate, named))
    with pytest.raises(MisplacedError, match=r"lies 0.0\d ± 0.0\d mm off") as told:
        lying_part(changed=other, features=features).looked(pin.SE3.Identity())
    for out in ("edge front is 0.2", "flat top is 0.4", OFF_DRAWING):
        assert out in str(told.value)
    assert str(told.value).count("Out of tolerance") == 2


def spoiled(cell: VirtualCell, covered: bool) -> None:
    """Have a corner of 10 mm broken off the part, or something stand on it there."""
    [item] = cell.world._items
    drawn = item.station.part_seen
    corners, triangles = trimesh.remesh.subdivide_to_size(drawn.vertices, drawn.triangles, 1e-3)
    middle = corners[triangles].mean(axis=1)
    there = (middle[:, 2] > 0.012) & (middle[:, 0] > 5e-3) & (middle[:, 1] > 5e-3)
    if covered:
        corners = corners + np.isin(np.arange(len(corners)), triangles[there])[:, None] * [0.0, 0.0, 4e-3]
    else:
        triangles = triangles[~there]
    cell.world._items = [replace(item, station=replace(item.station, part_seen=Mesh(corners, triangles)))]


@pytest.mark.parametrize("covered", [False, True])
def test_a_part_of_which_a_piece_broke_off_or_that_is_covered_is_told_though_the_rest_lies_in_its_place(
    lying_part: Lying, covered: bool
):
    """The job names no feature: a robust fit passes over a corner of 10 mm, and over what lies there. Nor is it gripped
    again."""
    site = lying_part(also="corrections = 2", changed=lambda cell: spoiled(cell, covered))
    with pytest.raises(MisplacedError, match=r"lies 0.\d\d ± 0.0\d mm off") as told:
        site.looked(pin.SE3.Identity())
    assert (COVERED if covered else OFF_DRAWING) in str(told.value), str(told.value)
    assert re.search(r"\d+ mm² of its face about \(\d+, \d+, \d+\) mm in its own frame is", str(told.value))
    assert [number.name for number in told.value.numbers if not number.kept] == [
        "placed part's face, not there or covered"
    ]
    (why,) = [note for note in site.notes if note.startswith("no correction")]
    assert site.parts == [] and "of its face about" in why


def test_another_part_or_none_is_not_found(lying_part: Lying):
    with pytest.raises(MisplacedError, match="is not where it was put down, or is not the part as drawn"):
        lying_part().looked(moved(0.05, 0.03, 0.02))


def test_what_the_parts_faces_do_not_show_is_not_taken_as_seen(lying_part: Lying):
    site = lying_part(flat=True, verify="seen")
    found = site.looked(moved(0.2e-3, z=0.1e-3))
    assert any("not seen of the placed part: translation" in note for note in site.notes)
    error = difference(found.seen.surface_from_part, moved(0.2e-3, z=0.1e-3))
    assert abs(error[2]) < 0.02e-3, "what shows is seen"
    # What does not is as it was stated before, and so is the bound.
    assert 0.05e-3 < math.sqrt(found.covariance[0, 0]) < 0.3e-3 and found.bound["d"] > 0.2


@pytest.mark.parametrize("share", [0.002, 0.10])
def test_steps_that_the_rail_lost_over_the_placed_part_are_found(lying_part: Lying, monkeypatch, share: float):
    """Few show at the reference switch alone; many look like a part that moved."""
    monkeypatch.setattr(rail, "_LOST", share)

    def lost(cell: VirtualCell) -> None:
        cell.devices.rail.home().wait(60.0)
        cell.fault("rail.lost_steps")

    with pytest.raises(DeviceFault, match="lost steps"):
        lying_part(changed=lost).looked(moved())


def test_a_sweep_over_the_part_that_lost_frames_is_done_again_twice(lying_part: Lying):
    """It moves nothing of the part, so nobody has to come for that."""
    again = "the part is swept again"

    def lossy(cell: VirtualCell, text: str = again) -> None:
        for _ in range(12 if text.startswith(again) else 0):
            cell.fault("camera.frame_loss")

    site = lying_part(changed=lossy, heard=lossy)
    with pytest.raises(DeviceFault, match="frames came from the sweep and 12 were lost"):
        site.looked(moved())
    assert sum(note.startswith(again) for note in site.notes) == 2


def test_a_sweep_over_the_part_whose_replies_came_too_late_is_done_again(lying_part: Lying):
    def late(cell: VirtualCell) -> None:
        cell.rail.late = 0.05

    def in_time(cell: VirtualCell, text: str) -> None:
        if text.startswith("the part is swept again: rail: replies come so late"):
            cell.rail.late = 0.0

    site = lying_part(changed=late, heard=in_time)
    assert site.looked(moved()).seen.beside > 1000
    assert sum("replies come so late" in note for note in site.notes) == 1


@pytest.mark.parametrize(
    ("happened", "half", "told"),
    [
        (laser_turned(0.6), MIDDLE, r"not seen where it lies: laser turned by 0\.[56]\d mrad"),
        (head_slipped(motion(0.3)), ALL, "not seen where it lies: the scan head has slipped"),
    ],
)
def test_a_head_that_moved_after_the_sweep_is_neither_a_push_nor_a_part_that_lies_aside(
    lying_part: Lying, happened: Change, half: tuple[float, float], told: str
):
    site = lying_part(half=half, changed=lambda cell: happened(cell.world))
    with pytest.raises(MisplacedError, match=told):
        site.looked(moved())


def test_a_laser_that_has_turned_since_the_calibration_leaves_open_no_more_than_one_that_has_not(
    placed_pot: JobRecord, lying: tuple[PlacedPart, LyingPart], tmp_path
):
    sweep = placed_pot.results["laser_sweep"]
    pointing = replace(sweep.pointing, turn=-0.25e-3)
    record = replace(placed_pot, results={**placed_pot.results, "laser_sweep": replace(sweep, pointing=pointing)})
    found = LyingPart(record, tmp_path, changed=lambda cell: laser_turned(0.25)(cell.world)).looked(moved())
    height, before = (np.sqrt(each.covariance[2, 2]) for each in (found, lying[0]))
    assert height == pytest.approx(before, rel=0.2)
    # The part is 20 mm nearer to the laser than the surface: of what turns both, that much is left between them.
    assert 0.01e-3 < before < 0.02e-3


def test_a_part_whose_upper_side_lies_elsewhere_than_drawn_is_not_moved_by_it(placed_pot: JobRecord, tmp_path):
    """Its underside lies where it belongs: what was seen of it would have it placed .3 mm aside."""
    aside, (job, mesh) = EFFECTS["upper side .3 mm aside in x"], load_job("pot")
    site = LyingPart(
        placed_pot, tmp_path, also="corrections = 1",
        changed=lambda cell: aside.put_into(cell.world, job, mesh, MIDDLE, tmp_path),
    )  # fmt: skip
    with pytest.raises(MisplacedError, match=r"would go into the surface by .*Most likely the part is not as drawn"):
        site.looked(moved())
    assert site.parts == [] and np.linalg.norm(site.lies().translation) < 1e-6
    assert any("no correction" in note and "would go into the surface" in note for note in site.notes)


@pytest.mark.parametrize(
    "rate",
    [
        pytest.param(moved(turn=(0.0, 0.0, 1e-3)), id="turns"),
        pytest.param(moved(x=0.05e-3), id="slides", marks=pytest.mark.campaign),
        pytest.param(moved(z=-0.02e-3), id="sinks", marks=pytest.mark.campaign),
    ],
)
def test_a_part_that_does_not_come_to_rest_is_misplaced(lying_part: Lying, rate: pin.SE3):
    """At first each lies within its tolerances, and one sweep says no more."""
    site = lying_part(changed=lambda cell: creeps(cell, rate))
    with pytest.raises(MisplacedError, match="does not lie still: in the last of 3 sweeps to and fro") as met:
        site.looked(moved())
    assert not met.value.numbers[0].kept
    assert sum("swept again: it moved by" in note for note in site.notes) == 2


def test_a_part_that_comes_to_rest_is_swept_again_and_lies_where_the_last_sweep_saw_it(lying_part: Lying):
    # It rides up the slopes of the surface, through which no part goes.
    rate = moved(0.02e-3, 0.03e-3, 0.015e-3, turn=(0.0, 0.0, 0.5e-3))
    site = lying_part(changed=lambda cell: creeps(cell, rate, 4.0))
    found = site.looked(moved())
    assert sum("swept again: it moved by" in note for note in site.notes) == 1
    require_seen(found, site.lies())


def test_a_vehicle_that_creeps_takes_part_and_surface_along(lying_part: Lying, monkeypatch):
    stands, rate = World.world_from_base, pin.Motion(np.array([8e-6, -9e-6, 5e-6, 4e-6, 6e-6, -9e-6]))
    monkeypatch.setattr(World, "world_from_base", lambda world, t: stands(world, t) @ pin.exp6(t * rate).homogeneous)
    site = lying_part()
    assert site.looked(moved()).in_tolerance(load_job("pot")[0].place)
    assert not any("swept again" in note for note in site.notes)


def test_a_job_looks_at_its_part_where_it_names_one_and_does_not_say_no(tmp_path):
    job, _ = load_job("pot")
    assert kind_of(job) is PLACE
    for verify, looks in (("all", ["verify"]), ("seen", ["verify"]), ("none", [])):
        job, _ = load_job(job_with_part(tmp_path, "pot", verify=verify))
        assert (kind_of(job).name, kind_of(job).names) == ("place", (*PLACE.names, *looks))
    assert kind_of(load_job("load")[0]).names == (PLACE.names[0], "pick", *PLACE.names[1:], "verify")


def test_what_is_accepted_is_no_farther_off_than_is_allowed(tmp_path):
    with pytest.raises(ConfigError, match=r"accept 0\.7 mm is more than tolerance 0\.6 mm"):
        load_job(job_with_part(tmp_path, "pot", verify="all", also='accept = "0.7 mm"'))


def test_a_run_tells_how_its_part_lies_in_report_page_and_picture_and_is_replayed(calibrated_folder: Path):
    job = job_with_part(calibrated_folder, "pot", verify="all", half=MIDDLE)
    text = quick(job.read_text(encoding="utf-8"))
    job.write_text(
        f'{text}[[part.feature]]\nname = "left"\nkind = "edge"\nat = {FRONT}\naxis = [1, 0, 0]\ntolerance = "0.4 mm"\n',
        encoding="utf-8",
    )
    with Cell.open(sim="all", seed=2, clock="virtual", job=job) as cell:
        done = cell.run(job=job)
    assert (done.outcome, done.exit_code) == ("placed", 0)
    assert re.fullmatch(
        r"in place: 0\.\d\d ± 0\.0\d mm off, gap [0-9.-]+ to [0-9.]+, flush [0-9.+-]+ to [0-9.+-]+ mm", done.reason
    )
    report = json.loads((done.folder / "report.json").read_text(encoding="utf-8"))
    told = report["steps"][-1]
    assert (told["name"], told["result"]["unseen"]) == ("verify", [])
    assert report["place_bound_95"]["d"] < 0.2
    assert max(map(abs, report["truth"]["seen_error"]["translation_mm"])) < 0.03
    assert report["truth"]["d_p95"] < report["place_bound_95"]["d"]
    rows = {row["name"]: row for row in report["measured"]}
    assert rows["placed part off its place, stated bound"]["kept"]
    (feature,) = told["result"]["features"]
    assert feature["off_mm"] < feature["bound_mm"] < feature["tolerance_mm"]
    for own in (feature["own_higher_mm"], feature["own_farther_mm"]):
        assert -0.4 < own[0] < 0.0 < own[1] < 0.4
    assert rows["edge left, stated bound"]["value"] == pytest.approx(feature["bound_mm"], abs=1e-3)
    assert "place error, stated 95 % bound" not in rows
    assert report["part_mesh"]["file"] == str(calibrated_folder / "pot-part.ply")
    assert rows["part into the surface"]["kept"] and rows["part into the surface"]["value"] < 0.05
    page = make_page(done.folder)
    assert "placed part off its place" in page and "part into the surface" in page
    assert all(compared.same for compared in replay(done.folder))
    assert (done.folder / CLOUD).stat().st_size > 100_000
    assert (done.folder / "picture.png").is_file()


def test_a_part_that_slips_as_the_claw_opens_ends_the_run_as_misplaced(placed_pot: JobRecord, tmp_path):
    job, mesh = load_job(job_with_part(tmp_path, "pot", verify="all", half=MIDDLE))
    job = changed(job, "scan", speed=0.039)
    slips = opened(motion(y=0.9, turn=(0, 0, 4)))
    nominal = NominalSurface.load(mesh, unit=job.surface.mesh_unit)
    done = run_whole_job(
        CONFIG.model_copy(update={"cell": CONFIG.cell.model_copy(update=NO_FILES)}), job, nominal, placed_pot.seed,
        placed_pot.level, calibrated=placed_pot, runs=tmp_path, changed=lambda cell: slips(cell.world),
    )  # fmt: skip
    assert (done.outcome, done.stage) == ("misplaced", "verify")
    assert "the part is already down" in done.reason and LIKELY["shifted"] in done.reason
    assert re.search(r"lies \d\.\d\d ± 0\.0\d mm off", done.reason) and "Allowed are 0.6 mm and 6 mrad" in done.reason
    report = json.loads((done.folder / "report.json").read_text(encoding="utf-8"))
    assert (report["outcome"], report["code"], report["part"]) == ("misplaced", "MisplacedError", "released")
    assert report["refusal"]["step"] == "verify" and report["refusal"]["placed"]["off_mm"] > 0.6
    assert report["truth"]["d_p95"] < report["place_bound_95"]["d"], "where it lies is stated all the same"
    true = from_matrix(done.at_end["poses"]["surface_from_part"])
    assert np.allclose(report["refusal"]["placed"]["shift_mm"][1], 1e3 * true.translation[1], atol=0.2)
    assert max(map(abs, report["truth"]["seen_error"]["translation_mm"])) < 0.03
    assert not all(row["kept"] for row in report["measured"])
