"""Sweeps to and fro over the fine board, laser off: they tell how late the camera's stamps come, and its shutter."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pinocchio as pin

from cell.config.calibrations.store import CellCalibration, link_of, most_late
from cell.config.cell_config import CellConfig
from cell.devices.devices import Devices
from cell.measure.calibration.drift import timing
from cell.measure.geometry.poses import from_ur
from cell.measure.vision.board.board import find_board
from cell.measure.vision.board.view import BoardSpec, parse_board
from cell.motion.kinematics import HOME
from cell.procedures.arm.moves import Mover
from cell.procedures.arm.photograph import rail_ends, references, verification_views
from cell.procedures.calibrate.boards import Check, Keep, Progress, move_to_view
from cell.procedures.sweep.swath import frames_of
from cell.procedures.sweep.sweeping import home_rail
from drivers.errors import DeviceFault, LimitError, RefusedError

SLOW_SHARE = 0.25
"""Of the rail's highest speed: what does not grow with the speed is no lateness."""
EXPOSURES = 0.25, 0.5
"""Of what photographs of a board at rest are exposed: short, for the board is smeared by what it moves meanwhile."""
MOST_SMEAR_M = 0.4e-3
"""What the board may move by during an exposure: less than its dots are apart."""
ROOM_M = 2e-3
"""To either side of a sweep and its run-up."""
FRAMES = 7
"""Of each sweep, about."""
STAGGER_M = 4e-3
"""By up to so much one sweep lies beside another along the rail."""
GOLDEN = 0.618
"""Multiples of it, less whole numbers, are spread evenly."""
MOST_MOVED_M = 1e-4


def collect_timing(
    config: CellConfig, devices: Devices, mover: Mover, calibration: CellCalibration, check: Check,
    progress: Progress, keep: Keep,
) -> timing.StampTiming:  # fmt: skip
    """Sweep over the fine board to and fro, fast and slowly, and say how late the stamps are. Raises what `find_timing`
    raises, and `RefusedError` when the board is not seen."""
    short, long = (share * config.scan_camera.photo_exposure for share in EXPOSURES)
    fast = min(config.rail.max_speed, MOST_SMEAR_M / long)
    slow = SLOW_SHARE * fast
    # The clocks are compared before each sweep, and differ by what that leaves open: many short sweeps, not few long.
    pairs = [(fast, long), (fast, short), (slow, long), (fast, long), (fast, short), (slow, short), (fast, long)]
    pairs.append((fast, short))

    def notify(k: int, count: int) -> None:
        check()
        progress(k / count, f"fine board, sweep {k + 1} of {count}")

    base_from_flange, sweeps = _sweeps(config, devices, mover, calibration, pairs=pairs, notify=notify, keep=keep)
    given = most_late(config), config.rail.lead, link_of(config)
    return timing.find_timing(calibration.scan, base_from_flange, sweeps, *given)


def look_at_shutter(
    config: CellConfig, devices: Devices, mover: Mover, calibration: CellCalibration, check: Check, keep: Keep
) -> CellCalibration:
    """A new `calibration` with what one sweep to and fro over the fine board tells of the scan camera's shutter.

    Where that tells nothing, a note says so. Raises `RefusedError` for a rolling shutter and for stamps that come later
    than the configuration allows: nothing of a job would show either.
    """
    exposure = min(EXPOSURES) * config.scan_camera.photo_exposure
    pairs = [(min(config.rail.max_speed, MOST_SMEAR_M / exposure), exposure)]
    scan = calibration.scan
    devices.interlocks.work_with(calibration.configuration)
    try:
        base_from_flange, sweeps = _sweeps(
            config, devices, mover, calibration=calibration, pairs=pairs, notify=lambda k, count: check(), keep=keep
        )
        shutter = timing.find_shutter(scan, base_from_flange, sweeps, link_of(config))
        late, sigma = timing.roughly_late(scan, base_from_flange, sweeps)
    except (RefusedError, LimitError) as unseen:
        note = f"whether the scan camera has a rolling shutter was not seen: {unseen}"
        return replace(calibration, scan=replace(scan, notes=(*scan.notes, note)))
    timing.refuse_rolling(shutter.readout, shutter.sigma)
    timing.refuse_late(late, sigma, most_late(config))
    return replace(calibration, scan=replace(scan, shutter=shutter))


def _sweeps(
    config: CellConfig, devices: Devices, mover: Mover, calibration: CellCalibration,
    pairs: Sequence[tuple[float, float]], notify: Callable[[int, int], None], keep: Keep,
) -> tuple[pin.SE3, list[timing.TimedSweep]]:  # fmt: skip
    """Where the flange stood, and sweeps to and fro for each of `pairs` of speed in m/s and exposure in s. `notify` is
    given each sweep's number and how many there are."""
    fine, large = parse_board(config.calibration.fine.board), parse_board(config.calibration.large.board)
    view, _ = verification_views(config, fine, large, calibration.scan, calibration.target)
    base_from_board = references(calibration.scan, calibration.target)[0].base_from_board
    # Within the travel the rail has to gain its speed, and to lose it.
    room = max(speed for speed, _ in pairs) ** 2 / (2 * config.rail.acceleration) + ROOM_M
    low, high = config.rail.travel
    ends = rail_ends(calibration.scan, base_from_board, view, fine, (low + room, high - room))
    home_rail(devices)
    mover.to_joints(HOME)
    move_to_view(devices, mover, view, 0)
    base_from_flange = from_ur(devices.arm.state().flange)
    plan = [(speed, exposure, way) for speed, exposure in pairs for way in (1, -1)]
    sweeps = []
    for k, (speed, exposure, way) in enumerate(plan):
        notify(k, len(plan))
        # Pictures at other places each time: an error of the screw that they share would pass for lateness.
        inner = STAGGER_M * (k * GOLDEN % 1.0)
        between = (ends[0] + inner, ends[1] - STAGGER_M + inner)[::way]
        sweeps.append(_swept(devices, fine, between, speed, exposure=exposure, keep=keep, what=f"timing-{k + 1:02d}"))
    moved = float(np.linalg.norm(from_ur(devices.arm.state().flange).translation - base_from_flange.translation))
    if moved > MOST_MOVED_M:
        raise DeviceFault(
            devices.arm.name, "arm.moved_in_sweep",
            f"the flange moved by {1e3 * moved:.2f} mm during the sweeps, allowed {1e3 * MOST_MOVED_M:.1f} mm",
            recoverable=True, hint="See what pushed the arm; the sweeps are of no use.",
        )  # fmt: skip
    return base_from_flange, sweeps


def _swept(
    devices: Devices, board: BoardSpec, ends: Sequence[float], speed: float, exposure: float, keep: Keep, what: str
) -> timing.TimedSweep:
    """One sweep from end to end, and what its pictures show of the board."""
    rail, camera = devices.rail, devices.scan_camera
    start, stop = ends
    rail.move_to(rail.sweep_start(start, stop, speed)).wait(30.0)
    camera.configure(exposure, min(FRAMES * speed / abs(stop - start), 0.8 / exposure))
    seen = []
    with camera.stream() as frames:
        sweep = rail.sweep(start, stop, speed)
        for frame in frames_of(sweep, frames):
            keep(what, frame)
            seen.append(frame)
    begin, end = sweep.window
    made, refused = [], ""
    for frame in seen:
        if not begin <= frame.mid_exposure <= end:
            continue
        try:
            made.append(timing.TimedFrame(find_board(frame.image, board), sweep.position_at(frame.mid_exposure)))
        except RefusedError as error:
            refused = str(error)
    if not made:
        raise RefusedError(
            f"no picture of a sweep over the fine board shows it ({refused or 'none came'}); clean it, see that it is "
            "lit, and that scan_camera.photo_exposure is enough for a quarter of it"
        )
    return timing.TimedSweep(speed if stop > start else -speed, exposure, camera.time_bound, made, sweep.time_bound)
