"""A sweep counts its steps afterwards; a repeated one is slower, with its lines as close as before."""

from contextlib import nullcontext

import pytest

from cell.config.job import LONGEST_SWEEP_S, load_job
from cell.measure.calibration.drift.reference_plate import Pointing
from cell.procedures.steps.laser_sweep import laser_sweep, slowed_down, sparse
from cell.procedures.steps.workplace import HeadLook, PartsBefore
from cell.procedures.sweep.sweeping import UNCHECKED
from drivers.errors import DeviceFault
from lab.bench.job.whole_job import JobRecord
from statemachine.runner import Event
from tests.support.at_station import Station


@pytest.mark.parametrize(("attempt", "share"), [(1, 1.0), (2, 0.5), (3, 0.25)])
def test_each_repetition_is_half_as_fast_with_the_lines_as_close(attempt: int, share: float):
    scan = load_job("pot")[0].scan
    again = slowed_down(scan, attempt)
    assert again.speed == pytest.approx(share * scan.speed)
    assert again.speed / again.frame_rate == pytest.approx(scan.speed / scan.frame_rate)
    assert again.length == scan.length


def test_a_repetition_is_no_slower_than_its_step_has_time_for():
    scan = load_job("pot")[0].scan
    slow = scan.model_copy(update={"speed": scan.length / 80.0})
    assert scan.length / slowed_down(slow, 3).speed == pytest.approx(LONGEST_SWEEP_S)


@pytest.mark.parametrize(("fault", "mode"), [("", 5), ("rail.lost_steps", 5), ("", 1)])
def test_after_a_sweep_the_rails_count_is_compared_with_its_reference_switch(
    placed_pot: JobRecord, station: Station, fault: str, mode: int, monkeypatch
):
    """Lost steps refuse what was swept; a rail that does not show its switch leaves a doubt."""
    site, told = station(), []
    rail = site.cell.devices.rail
    rail.home().wait(60.0)
    if fault:
        site.cell.fault(fault)
    if mode == 1:
        monkeypatch.setattr(rail, "check_zero", lambda: None)
    few = sparse(site.work, site.job.scan.swath[0], placed_pot.results["laser_sweep"].swaths[0])
    with pytest.raises(DeviceFault, match="lost steps") if fault else nullcontext() as met:
        swept = laser_sweep(
            site.work, site.work.base_from_surface(site.made["board_photo"]), site.work.calibration.scan, few,
            keep_frame=lambda frame, cut: None, check=lambda: None, progress=lambda share, text: told.append(text),
        )  # fmt: skip
        assert swept.doubts == ((UNCHECKED,) if mode == 1 else ())
    if fault:
        assert (met.value.code, met.value.recoverable) == ("rail.lost_steps", True)
        assert not rail.state().homed_here
    assert "looking whether the rail has lost steps" in told


def test_steps_lost_in_a_sweep_with_a_second_look_are_found_after_its_way_back(station: Station):
    def lose(event: Event) -> None:
        if "whether the surface lies still: preparing" in event.data.get("text", ""):
            site.cell.fault("rail.lost_steps")

    site = station(timed=True, notify=lose)
    site.work.looks_again = True
    with pytest.raises(DeviceFault, match="lost steps"):
        site.do("laser_sweep")


@pytest.mark.parametrize(
    ("ago", "seen", "attempt", "held", "shared"),
    [
        (590.0, True, 1, False, True), (601.0, True, 1, False, False), (5.0, False, 1, False, False),
        (5.0, True, 2, False, False), (5.0, True, 1, True, False),
    ],
)  # fmt: skip
def test_a_part_goes_by_the_look_at_the_head_of_a_part_before_for_ten_minutes(
    placed_pot: JobRecord, station: Station, ago: float, seen: bool, attempt: int, held: bool, shared: bool,
    monkeypatch,
):  # fmt: skip
    """Where nobody looks at the placed parts, not at all."""
    site = station()
    site.work.shares_look, kept = seen, list[str]()
    monkeypatch.setattr(site.work.frames, "keep", lambda name, frame, cut=None: kept.append(name.split("-")[0]))
    pointing = Pointing(0.5e-3, 0.02e-3)
    look = HeadLook(site.cell.clock.now() - ago, pointing, placed_pot.results["laser_sweep"].slip)
    site.work.parts_before = PartsBefore(look=look)
    context = site.context("drive_to_target")
    site.work.whereabouts.enter(site.job)
    site.made["drive_to_target"] = site.kind.work(site.work)["drive_to_target"](context)
    assert (site.made["drive_to_target"].head is None) == (shared or attempt > 1 or held)
    if held:
        site.control.pause()
        site.control.safe_point(site.control.token, lambda stays: site.control.go_on() if stays else None)
    swept = site.kind.work(site.work)["laser_sweep"](site.context("laser_sweep", attempt))
    assert ("witness" in kept) == (not shared) and ("interim" in kept) == (not shared and attempt == 1 and not held)
    assert (swept.pointing is pointing) == shared
    assert swept.summary().get("head_looked_s_ago", 0.0) == pytest.approx(ago + 30.0 if shared else 0.0, abs=30.0)
    if shared:
        assert swept.summary()["laser_turned_mrad"] == 0.5
