"""A surface that lies elsewhere than where it was swept is seen before the part is put down."""

import math
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.stats import chi2

from cell.devices.simulated.direct import VirtualCell
from cell.measure.geometry.poses import difference
from cell.measure.inversion import PlacePose
from cell.measure.inversion.effects.between_sweeps import Creep, SurfaceMotion, surface_motion
from cell.measure.reconstruction.build import flange_motions
from cell.measure.reconstruction.cloud import Cloud, Filled, merge
from cell.procedures.arm.touch import felt_touch
from cell.procedures.steps import laser_sweep as sweep_step
from cell.procedures.steps import place as place_step
from cell.procedures.steps.laser_sweep import LINES, sparse
from cell.procedures.sweep import second_look
from cell.procedures.sweep.second_look import SecondLook, by_times, require_in_place, require_points
from cell.procedures.sweep.swath import MAX_LOST_FRACTION
from drivers.errors import CellError, DeviceFault, LimitError, NotObservable, RefusedError
from lab.bench.job.scan_errors import own_base
from lab.bench.job.whole_job import JobRecord
from sim_backends.world.world import World
from statemachine.runner import Event
from tests.support.at_station import AtStation, Station, lose_few_steps_after_the_look
from tests.support.report_runs import NAMES, changed, pot


def slid(cell: VirtualCell, shift: tuple[float, float], turn: float = 0.0) -> None:
    """Push the surface over its table, m and rad; the board stays."""
    world = cell.world
    pose = world.scene.world_from_surface.copy()
    c, s = math.cos(turn), math.sin(turn)
    pose[:3, :3] = pose[:3, :3] @ [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
    pose[:2, 3] += shift
    world.scene = replace(world.scene, world_from_surface=pose)
    world._cameras.show(world.scene, world.station)


def look_again(site: AtStation) -> SecondLook:
    made = (site.made[name] for name in ("board_photo", "laser_sweep", "reconstruct", "invert_pose"))
    return require_in_place(site.work, *made, site.context("place"))


def looked(
    record: JobRecord, folder: Path, shift: tuple[float, float] = (0.0, 0.0), turn: float = 0.0, further: float = 0.0
) -> SecondLook:
    """A look at the surface of `record`, slid by so much, from a vehicle so many metres from where it stood."""
    site = AtStation(record, folder, further=further)
    slid(site.cell, shift, turn)
    return look_again(site)


def test_one_that_lies_where_it_lay_is_told_so(placed_pot: JobRecord, tmp_path):
    look = looked(placed_pot, tmp_path)
    found = look.moved
    assert look.notes == () and look.creep is None and not look.counted
    assert np.linalg.norm(found.motion[:3]) < 0.2e-3 and np.linalg.norm(found.motion[3:]) < 0.5e-3
    assert not found.moved and found.times < 0.9
    assert found.matched == pytest.approx(1.0, abs=0.1)
    # What the run itself saw is in its journal.
    placing = placed_pot.results["place"]
    result = placing.summary()["surface_moved"]
    sigmas = np.sqrt(np.diag(placing.look.moved.covariance))
    np.testing.assert_allclose(result["sigma_mm"], 1e3 * sigmas[:3], atol=1e-4)
    assert np.abs(result["mm"]).max() < 0.2 and np.abs(result["mrad"]).max() < 0.5


@pytest.mark.parametrize(
    ("shift", "turn", "further"),
    [((0.5e-3, 0.0), 0.0, 0.0), ((0.0, 0.0), 3e-3, 0.0), ((0.0, 0.0), 0.0, 0.5e-3), ((0.0, 4e-3), 0.0, 0.0)],
    ids=["along", "turned", "the vehicle was pushed", "far"],
)
def test_one_that_slid_over_its_table_is_refused(
    placed_pot: JobRecord, tmp_path, shift: tuple[float, float], turn: float, further: float
):
    with pytest.raises(RefusedError, match=r"run the job again") as refused:
        looked(placed_pot, tmp_path, shift, turn, further)
    (told,) = re.findall(
        r"the surface has moved by (\d\.\d\d) mm and (\d\.\d\d\d) deg since it was swept", str(refused.value)
    )
    pushed = 1e3 * (math.hypot(*shift) + further)
    assert float(told[0]) == pytest.approx(pushed, abs=0.2)
    assert np.radians(float(told[1])) == pytest.approx(abs(turn), abs=0.6e-3)
    (number,) = refused.value.numbers
    assert number.value > number.most == 1.0


def test_a_way_back_is_too_blunt_where_it_is_not_known_how_late_the_stamps_come(station: Station):
    site = station()
    site.work.looks_again = True
    assert site.do("laser_sweep").back is None


@pytest.mark.parametrize(("shift", "late"), [(0.0, 0.0), (0.25e-3, 0.0), (0.25e-3, 6.0)])
def test_the_way_back_of_a_sweep_is_its_second_look_unless_it_is_too_long_ago(
    station: Station, shift: float, late: float
):
    begun: list[str] = []

    def push(event: Event) -> None:
        text = event.data.get("text", "")
        # One that was pushed before the way back, or, when that is too long ago, after it.
        if "whether the surface lies" in text and not begun and (late > 0.0) == ("lies where it did" in text):
            begun.append(text)
            slid(site.cell, (shift, 0.0))

    site = station(notify=push, timed=True)
    site.work.looks_again = True
    back = site.do("laser_sweep").back
    assert back is not None and LINES - 4 < len(back.swaths[0].lines) < LINES + 4
    assert (back.swaths[0].rail[0] > back.swaths[0].rail[-1]) != (
        site.made["laser_sweep"].swaths[0].rail[0] > site.made["laser_sweep"].swaths[0].rail[-1]
    )
    site.do("reconstruct", "invert_pose")
    site.cell.clock.sleep(late)
    if shift:
        with pytest.raises(RefusedError, match=r"the surface has moved by 0\.2\d mm"):
            look_again(site)
    else:
        look = look_again(site)
        assert look.counted and not look.moved.moved and look.notes == ()
    assert begun


def test_one_that_is_not_there_any_more_is_refused(placed_pot: JobRecord, tmp_path):
    with pytest.raises(RefusedError, match="does not lie any more where it was swept"):
        looked(placed_pot, tmp_path, (0.0, 0.045))


@pytest.mark.parametrize(
    "error",
    [
        LimitError("scan_camera", "30 Hz"),
        DeviceFault("scan_camera", "camera.setting", "it took 30 Hz", recoverable=False, hint=""),
    ],
    ids=["limit", "setting"],
)
def test_a_camera_of_a_few_frame_rates_takes_all_lines_again(station: Station, monkeypatch, error: CellError):
    site = station()
    camera, rates = site.cell.scan_camera, []
    usual = camera.configure

    def configure(exposure: float, frame_rate: float) -> None:
        if frame_rate != 30.0:
            raise error
        rates.append(frame_rate)
        usual(exposure, frame_rate)

    monkeypatch.setattr(camera, "configure", configure)
    assert not look_again(site).moved.moved
    assert set(rates) == {30.0}


def test_a_second_look_takes_few_lines_of_one_strip_twice_as_fast_where_there_is_room(
    placed_pot: JobRecord, station: Station
):
    workplace, (swath,) = station().work, placed_pot.results["laser_sweep"].swaths
    scan = workplace.job.scan
    few = sparse(workplace, scan.swath[0], swath)
    assert few.speed == pytest.approx(min(sweep_step.HURRY * scan.speed, workplace.config.rail.max_speed), rel=0.01)
    assert few.length / few.speed * few.frame_rate == pytest.approx(LINES) and len(few.swath) == 1
    # A sweep that was repeated went half as fast.
    slow = replace(swath, times=2.0 * swath.times)
    assert sparse(workplace, scan.swath[0], slow).speed == pytest.approx(sweep_step.HURRY * sweep_step.pace(slow))
    # The arm repeats it slower rather than faster; a camera that is slow stays so.
    workplace.job = changed(workplace.job, "scan", mode="arm", frame_rate=5.0, speed=0.02)
    by_arm = sparse(workplace, scan.swath[0], swath)
    assert (by_arm.speed, by_arm.frame_rate) == (0.02, 5.0)


def test_stamps_that_come_late_shift_the_faster_look_farther(station: Station):
    site = station()
    sweep, workplace = site.made["laser_sweep"], site.work
    look_again(site)
    site.made["laser_sweep"] = replace(sweep, rest=site.cell.devices.interlocks.situation.last)
    workplace.calibration = replace(workplace.calibration, scan=replace(workplace.calibration.scan, timing=None))
    (swath,), spread = sweep.swaths, []
    along = swath.builder.sweep_direction(swath.base_from_flange)
    faster = sparse(workplace, workplace.job.scan.swath[0], swath).speed - workplace.job.scan.speed
    for late in (0.0, 0.02):
        config, by = workplace.config, {"rail": 0.0, "scan_camera": late}
        workplace.config = config.model_copy(
            update={name: getattr(config, name).model_copy(update={"late": seconds}) for name, seconds in by.items()}
        )
        spread.append(float(along @ look_again(site).moved.covariance[:3, :3] @ along))
    assert spread[1] - spread[0] == pytest.approx((0.02 / math.sqrt(3.0) * faster) ** 2, rel=0.2)


def test_a_look_that_loses_frames_tells_as_much(station: Station):
    lost: list[int] = []

    def losing(event: Event) -> None:
        if event.data.get("text", "").endswith("3 profiles"):
            site.cell.scan_camera.model.fault("camera.frame_loss", 4)
            lost.append(4)

    site = station(notify=losing)
    assert not look_again(site).moved.moved
    assert sum(lost) > MAX_LOST_FRACTION * LINES


def test_what_late_replies_and_the_lines_leave_open_is_known(station: Station):
    job, nominal = pot()
    site = station(changed(job, "place", tolerance=2e-3), nominal)
    site.do(*NAMES[1:-1])
    assert {"table", "board"} <= {body.name for body in site.work.mover._station}, "met as the board was seen"
    slid(site.cell, (0.25e-3, 0.0))
    with pytest.raises(RefusedError, match=r"has moved by 0\.2\d mm .* times as far as chance brings"):
        look_again(site)
    # Replies that came late may have shifted the sweep as far.
    sweep = site.made["laser_sweep"]
    (swath,) = sweep.swaths
    loose = replace(swath, shift=0.15e-3)
    site.made["laser_sweep"] = replace(sweep, swaths=(loose,), rest=site.cell.devices.interlocks.situation.last)
    look = look_again(site)
    assert not look.moved.moved and look.notes == ()
    # A place that is wanted more exactly than that is asked of the board, too.
    site.work.job = changed(job, "place", tolerance=0.2e-3)
    taken = len(site.cell.target_camera.shots)
    (note,) = look_again(site).notes
    assert len(site.cell.target_camera.shots) > taken
    assert re.search(r"translation along the x axis of the surface frame shows from 0\.\d+ mm on.* nobody touch", note)


def test_what_late_replies_leave_open_lies_along_the_sweep_and_is_even(placed_pot: JobRecord):
    (swath,) = placed_pot.results["laser_sweep"].swaths
    along = 0.15e-3 * swath.builder.sweep_direction(swath.base_from_flange)
    expected = np.zeros((6, 6))
    expected[:3, :3] = np.outer(along, along) / 3
    np.testing.assert_allclose(by_times(replace(swath, shift=0.15e-3)), expected)


@pytest.mark.parametrize("photographed", [False, True])
def test_after_a_pause_it_is_looked_at_anew(station: Station, photographed: bool, monkeypatch):
    """Also after one within a look, before a photograph of the board that it takes after its sweep."""
    held: list[bool] = []
    if photographed:
        monkeypatch.setattr(SurfaceMotion, "hidden", lambda *_: ["(a motion that does not show)"])
        monkeypatch.setattr(second_look, "require_board_unmoved", lambda *_: site.context("place").safe_point())

    def notify(event: Event) -> None:
        if "9 profiles" in event.data.get("text", "") and not held:
            site.control.pause()

    def reach_in() -> None:
        held.append(True)
        slid(site.cell, (0.0, 1e-3))
        site.control.go_on()

    site = station(notify=notify, check=reach_in)
    with pytest.raises(RefusedError, match=r"the surface has moved by (0\.9|1\.0)"):
        site.do("place")
    assert held == [True]


def test_a_few_steps_that_the_rail_lost_are_found_before_the_part_touches(station: Station, monkeypatch):
    """As few do not show in the lines: the count is looked at while the arm comes down."""
    heard: list[str] = []
    site = station(notify=lambda event: heard.append(str(event.data.get("text"))))
    lose_few_steps_after_the_look(monkeypatch, lambda: site.cell)
    with pytest.raises(DeviceFault, match="lost steps"):
        site.do("place")
    assert "descending" in heard and "feeling for contact" not in heard
    assert site.cell.world.part.held


# --- two clouds, one beside the other ---


def lines_of(cloud: Cloud, lines: slice, kept: float = 1.0) -> Cloud:
    """Some lines of a cloud of one sweep, and a share of their points."""
    names = ("points", "stripe_spread", "rail_spread", "centres", "rail", "rejected", "flanges")
    some = {name: getattr(cloud, name)[lines].copy() for name in names}
    some["points"][np.random.default_rng(1).random(some["points"].shape[:2]) > kept] = np.nan
    return replace(cloud, **some, sweeps=np.zeros(len(some["rail"]), dtype=np.intp), filled=Filled())


def compared(record: JobRecord, first: Cloud, second: Cloud) -> SurfaceMotion:
    """A motion between two clouds of arms that stood where they say."""
    by_poses = tuple(partial(flange_motions, cloud, covariances=[np.zeros((6, 6))]) for cloud in (first, second))
    return surface_motion(first, second, pot()[1], record.results["invert_pose"].base_from_surface, by_poses)


@pytest.mark.parametrize(("every", "kept"), [(5, 1.0), (1, 0.01)], ids=["lines 5 mm apart", "few points in all"])
def test_a_first_sweep_that_was_coarse_is_one_to_compare_with(placed_pot: JobRecord, every: int, kept: float):
    cloud = placed_pot.results["reconstruct"].cloud
    first, second = lines_of(cloud, slice(0, None, every), kept), lines_of(cloud, slice(2, None, max(2, every)))
    found = compared(placed_pot, first, second)
    assert found.matched == pytest.approx(1.0, abs=0.15)
    assert np.linalg.norm(found.motion[:3]) < 0.1e-3


def test_one_strip_of_several_is_held_against_itself(placed_pot: JobRecord):
    cloud = placed_pot.results["reconstruct"].cloud
    aside = replace(cloud, points=cloud.points + np.array([0.0, 0.0, 0.3e-3]))
    strips = merge([cloud, aside])
    assert strips.of_sweep(0).size == cloud.size
    assert np.array_equal(strips.of_sweep(1).points, aside.points, equal_nan=True)
    assert strips.of_sweep(1).each_sweep() == [slice(0, cloud.shape[0])]


def test_a_second_sweep_that_sees_nothing_says_so(placed_pot: JobRecord):
    nothing = lines_of(placed_pot.results["reconstruct"].cloud, slice(0, 30), 0.0)
    with pytest.raises(RefusedError, match=r"0 points were seen in 30 profiles .* gone, or the laser"):
        require_points(nothing)
    assert compared(placed_pot, nothing, nothing).moved


# --- what creeps ---


def test_a_vehicle_that_creeps_is_seen_and_the_place_carried_on(station: Station, monkeypatch):
    rate = np.array([2.2e-6, -6e-6, -4.8e-6, -3.8e-6, 2.8e-6, 1.8e-6])
    touched, stands = [], World.world_from_base

    def creeping(world: World, t: float) -> np.ndarray:
        return stands(world, t) @ pin.SE3(pin.exp3(rate[3:] * t), rate[:3] * t).homogeneous

    def felt(*given: object) -> object:
        touched.append(site.cell.clock.now())
        return felt_touch(*given)

    monkeypatch.setattr(World, "world_from_base", creeping)
    monkeypatch.setattr(place_step, "felt_touch", felt)
    site = station(pot(speed=0.015)[0])
    placing = site.do(*NAMES[1:])
    world, record = site.cell.world, site.ended
    assert any("creeps against the arm by" in note for note in placing.notes)
    # It is the station that moves, seen from the arm.
    assert placing.look.creep.rate[:3] == pytest.approx(-rate[:3], abs=5e-6)
    surface = np.linalg.inv(creeping(world, touched[-1])) @ world.scene.world_from_surface
    true = own_base(record) * pin.SE3(surface)

    def distance(pose: PlacePose) -> float:
        off = difference(pose.base_from_surface, true)
        return float(off @ np.linalg.solve(pose.covariance, off))

    assert distance(placing.pose) < chi2.ppf(0.95, 6) < distance(record.results["invert_pose"])


def test_a_place_that_creeps_is_carried_on_to_the_time_of_the_contact(station: Station, monkeypatch):
    site, until = station(), []
    monkeypatch.setattr(Creep, "carried", lambda creep, pose, time: until.append(time) or pose)
    site.work.pace.share = 0.5
    made = (site.made[name] for name in ("laser_sweep", "reconstruct", "board_photo"))
    place_step.carried_on(site.work, *made, Creep(np.zeros(6), 1e-16 * np.eye(6), np.zeros(3), 0.0))
    plan, now = site.job.place, site.cell.clock.now()
    descent = plan.contact_travel / plan.contact_speed
    assert until == [pytest.approx(now + (place_step.APPROACH_S + descent) / 0.5)]


def test_a_place_that_creeps_and_is_not_known_any_more_is_refused(station: Station):
    site = station()
    made = [site.made[name] for name in ("laser_sweep", "reconstruct", "board_photo")]
    unknown = Creep(np.zeros(6), np.diag([30e-6**2] * 3 + [1e-12] * 3), np.zeros(3), float(made[0].times.mean()))
    with pytest.raises(NotObservable, match=r"known to \d+\.\d+ tolerances"):
        place_step.carried_on(site.work, *made, unknown)
