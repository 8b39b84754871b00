"""The plate on the claw: where the laser's line lies on it, and where the rail takes the line over its edge."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cell.config.calibrations.store import CellCalibration
from cell.config.cell_config import CellConfig
from cell.devices.devices import Devices
from cell.measure.calibration.drift.reference_plate import LEAST_ROWS, Edge, PlateLine
from cell.measure.geometry.camera import Array
from cell.measure.vision.stripe.extract import extract
from cell.procedures.ambient import adapted, hidden
from cell.procedures.calibrate.boards import Keep
from cell.procedures.sweep.swath import frames_of
from cell.procedures.sweep.sweeping import check_lost_steps
from drivers.errors import DeviceFault, LimitError, Measured, RefusedError

PICTURES = 12
CREEP_M = 0.6e-3
"""So far the carriage goes meanwhile: 50 µm from picture to picture, about two grains of the speckle."""
KEPT_EACH = 4
"""Of the pictures over the plate's edge, every so many are kept for people."""
RATES_HZ = 30.0, 15.0, 10.0
"""The first that the camera can."""


def see_reference_plate(config: CellConfig, devices: Devices, keep: Keep) -> PlateLine | None:
    """The reference plate now, the carriage left there; None where the cell has none or it is not in the picture."""
    position = config.laser.witness
    if position is None:
        return None
    rail, camera = devices.rail, devices.scan_camera
    rail.move_to(position).wait(30.0)
    stands = rail.state().position
    rate = configure_fast(devices, config.calibration.stripe_exposure)
    profiles = []
    with devices.interlocks.purpose("calibration"), devices.laser.lit():
        adapted(camera, camera.grab())
        with camera.stream() as frames:
            # The speckle stays as it is while nothing moves, and a mean would keep it.
            creep = rail.move_to(position + _inward(config, position) * CREEP_M, CREEP_M * rate / PICTURES)
            for k, frame in zip(range(PICTURES), frames, strict=False):
                keep(f"witness-{k + 1}", frame)
                profiles.append(extract(frame.image))
        creep.wait(30.0)
    columns = np.array([np.where(profile.double, np.nan, profile.centres) for profile in profiles])
    return _on_the_plate(PlateLine(stands, columns.mean(axis=0)))


def _inward(config: CellConfig, position: float) -> float:
    """The direction away from the nearer end of the rail's travel."""
    low, high = config.rail.travel
    return 1.0 if high - position > position - low else -1.0


def configure_fast(devices: Devices, exposure: float, rates: Sequence[float] = RATES_HZ) -> float:
    """Set the scan camera to `exposure`, s, and the first of `rates`, Hz, that it takes; that rate, or what it raises
    at the last of them."""
    for rate in rates[:-1]:
        try:
            devices.scan_camera.configure(exposure, rate)
        except LimitError:
            continue
        except DeviceFault as fault:
            # A camera that says what it can only by what it makes of a wish.
            if fault.code != "camera.setting":
                raise
        else:
            return rate
    devices.scan_camera.configure(exposure, rates[-1])
    return rates[-1]


def require_reference_plate(config: CellConfig, devices: Devices, keep: Keep) -> PlateLine:
    """The reference plate now, for a calibration that has seen it; `RefusedError` when there is none to see."""
    if config.laser.witness is None:
        raise RefusedError(
            "the calibration saw the laser's witness, but the configuration has no laser.witness now: put it back, or "
            "run `cell calibrate` to work without one"
        )
    if (seen := see_reference_plate(config, devices, keep)) is None:
        if devices.bright:
            exposure = 1e3 * min(devices.scan_camera.longest_exposure, config.calibration.stripe_exposure)
            raise hidden(
                f"ambient light leaves an exposure of {exposure:.2f} ms, and the laser's line on the plate on the claw "
                "stands out in too few of the rows", 0.0
            )  # fmt: skip
        check_lost_steps(devices)  # A carriage that stands elsewhere sees it elsewhere.
        raise RefusedError(
            "the laser's witness, which the calibration saw, is not in the picture: see that the plate on the claw is "
            "in its place and clean, and that the laser is lit; if so, run `cell calibrate`"
        )
    return seen


def _on_the_plate(seen: PlateLine) -> PlateLine | None:
    """Only the longest run of rows without a step: what lies behind the plate moves with the arm."""
    rows = seen.rows
    if len(rows) < LEAST_ROWS:
        return None
    steps = (np.diff(rows) > 3) | (np.abs(np.diff(seen.columns[rows])) > 3.0)
    longest = max(np.split(rows, np.flatnonzero(steps) + 1), key=len)
    if len(longest) < LEAST_ROWS:
        return None
    columns = np.full_like(seen.columns, np.nan)
    # The plate's edges are left out: half of the line is beside them.
    kept = longest[5:-5]
    columns[kept] = seen.columns[kept]
    return replace(seen, columns=columns)


SPEED = 2e-3
SEARCH_SPEED = 5e-3
"""With the fastest camera; a slower one is taken over the edge as much slower, for the pictures to lie as close."""
ROOM_M = 1e-3
"""To an end of the rail's travel, beyond what it takes to gain speed."""
REACH_M = 10e-3
"""So far from the witness an edge is searched."""
BESIDE_M = 0.6e-3
"""To either side of where the edge is expected."""
INNER_PX, OUTER_PX = 8, 14
"""Half widths of the line as it shows on the plate, and of its surroundings."""
LEAST_FRAMES = 8
BRIGHTEST, LEAST_LIGHT_DN = 3, 2.0
"""So many pictures say about how bright a row of the line is; with less than that over its surroundings it is none."""
UNSEEN = (
    "whether the scan head slips on its mount will not be seen: the plate on the claw has no edge that the laser's "
    "line passes within 10 mm of laser.witness"
)
ALL, NONE = 0.85, 0.15
"""Share of the line's light on the plate, and beside it."""
GAP = 1.5
"""Pictures so many times further apart than usual have lost one between them."""
OPEN_M = 4e-6
"""What lost pictures may leave open of where the line leaves the plate: 2 ms."""
BRIGHTENS = 1.25
"""Surroundings that become so many times as bright as the line leaves the plate follow it: gain is not fixed."""
STEADY = 1.3
"""Of the line's light at a place of the plate, from passage to passage: speckle and noise leave a few per cent."""
DARK_DN = 0.1
"""Of a line that is out: what is beside it is as bright."""
Passage = tuple[Array, Array, Array]
"""Places (n,) of the rail, m, rising; the share (n,) of the line's light on the plate; and that light, DN."""
PASSES = 3
"""So often the rail takes the line over the edge when pictures are lost there."""


def with_edge(config: CellConfig, devices: Devices, keep: Keep, calibration: CellCalibration) -> CellCalibration:
    """A new `calibration` whose witness has the plate's edge, where there is one to find."""
    scan = calibration.scan
    if scan.witness is None:
        return calibration
    devices.interlocks.work_with(calibration.configuration)
    edge = look_at_edge(config, devices, keep, scan.witness, None)
    notes = scan.notes if edge is not None else (*scan.notes, UNSEEN)
    return replace(calibration, scan=replace(scan, witness=replace(scan.witness, edge=edge), notes=notes))


def require_edge(config: CellConfig, devices: Devices, keep: Keep, before: PlateLine, now: PlateLine) -> PlateLine:
    """`now` with the edge that the calibration saw `before`. Raises `RefusedError` where it is not about there."""
    assert before.edge is not None
    edge = look_at_edge(config, devices, keep, now, before.edge.place)
    if edge is None:
        check_lost_steps(devices)  # Lost steps are told as such.
        raise RefusedError(
            f"the edge of the plate on the claw is not within {1e3 * BESIDE_M:g} mm of where the calibration saw it, "
            f"with the rail at {1e3 * before.edge.place:.2f} mm: the scan head or the plate has slipped, the rail "
            "loses steps, or the plate is covered. Look at the screws of both, at the rail's motor, clean the plate, "
            "then run `cell calibrate`"
        )
    return replace(now, edge=edge)


def look_at_edge(
    config: CellConfig, devices: Devices, keep: Keep, witness: PlateLine, near: float | None
) -> Edge | None:
    """The plate's edge by the rail, m, as both ways over it show it; it is searched where no place `near` is given.
    None where the plate shows no edge there: it may be larger than the camera sees, or covered."""
    low, high = config.rail.travel
    room = SEARCH_SPEED**2 / (2 * config.rail.acceleration) + ROOM_M
    low, high = low + room, high - room
    rate = configure_fast(devices, config.calibration.stripe_exposure)
    speed, search = (share * rate / RATES_HZ[0] for share in (SPEED, SEARCH_SPEED))
    passed = partial(_passed, devices, keep, witness)
    way = _inward(config, witness.rail)
    if near is None:
        begin, end = (float(np.clip(witness.rail + way * far, low, high)) for far in (0.0, REACH_M))
        near = _crossing(passed((begin, end), search), way)
        if near is None:
            return None
    begin, end = (float(np.clip(near + way * beside, low, high)) for beside in (-BESIDE_M, BESIDE_M))
    passages = [_whole(partial(passed, ends, speed)) for ends in ((begin, end), (end, begin))]
    _require_steady(passages, way)
    fro, to = (_crossing(passage, way) for passage in passages)
    if fro is None or to is None:
        return None
    return Edge(0.5 * (fro + to), way * (fro - to) / (2.0 * speed))


def _whole(passed: Callable[[], Passage]) -> Passage:
    """What `passed` gives, again where pictures were lost at the edge; `RefusedError` when they always are."""
    left_open = 0.0
    for _ in range(PASSES):
        passage = passed()
        left_open = _left_open(*passage[:2])
        if left_open <= OPEN_M:
            return passage
    raise RefusedError(
        f"pictures were lost each of the {PASSES} times that the rail took the laser's line over the edge of the plate "
        f"on the claw: where the edge is stays open by {1e3 * left_open:.3f} mm, allowed are {1e3 * OPEN_M:g} mm. See "
        "why pictures of the scan camera or readings of the rail are lost (cable, packets, a busy computer), then try "
        "again",
        Measured("edge of the plate open by", 1e3 * left_open, "mm", most=1e3 * OPEN_M),
    )


def _passed(devices: Devices, keep: Keep, witness: PlateLine, ends: tuple[float, float], speed: float) -> Passage:
    """One passage of the line over the edge."""
    rail, camera, laser = devices.rail, devices.scan_camera, devices.laser
    rail.move_to(rail.sweep_start(*ends, speed)).wait(30.0)
    times: list[float] = []
    light, dark = [], []
    with devices.interlocks.purpose("calibration"), camera.stream() as frames, laser.lit():
        sweep = rail.sweep(*ends, speed)
        for frame in frames_of(sweep, frames):
            laser.renew()
            if len(times) % KEPT_EACH == 0:
                keep("witness-edge", frame)
            times.append(frame.mid_exposure)
            light.append(_light(frame.image, witness))
            some = np.sort(frame.image[::8, ::8].astype(np.float64), axis=None)
            dark.append(float(some[: len(some) * 3 // 4].mean()))
    begin, end = sweep.window
    inside = np.flatnonzero((np.array(times) >= begin) & (np.array(times) <= end))
    if len(inside) < LEAST_FRAMES:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    _require_fixed_gain(np.array(dark)[inside])
    places = np.array([sweep.position_at(times[k]) for k in inside])
    lit, order = np.array(light)[inside], np.argsort(places)
    level = lit.mean(axis=1)
    # Each row against its own light on the plate: the plate's colour and the laser's profile fall out.
    bright = np.sort(lit, axis=0)[-BRIGHTEST:].mean(axis=0)
    whole = np.ma.masked_less(lit, 0.75 * bright).mean(axis=0).filled(0.0)
    lit = lit / np.maximum(whole, LEAST_LIGHT_DN)
    return places[order], np.asarray(lit.mean(axis=1))[order], level[order]


def _require_fixed_gain(dark: Array) -> None:
    """Raise `RefusedError` where the surroundings (n,), DN, of a rail's passage follow the line's light."""
    low, high = max(1.0, float(dark.min())), float(dark.max())
    if high > BRIGHTENS * low:
        raise RefusedError(
            f"the scan camera's pictures become {high / low:.1f} times as bright beside the laser's line as that "
            f"leaves the plate on the claw, allowed are {BRIGHTENS:g} times: gain or exposure follow the picture, or "
            "the room's light changes. Switch the camera's auto gain and auto exposure off; only then look whether the "
            "scan head has slipped",
            Measured("pictures brighter beside the line", high / low, "times", most=BRIGHTENS),
        )


def _require_steady(passages: Sequence[Passage], way: float) -> None:
    """Raise `RefusedError` where the line is brighter in one of two passages than in the other at a place of the plate,
    which ends in direction `way`."""
    (here, _, light), (there, _, other) = passages

    def end(places: Array, lit: Array) -> float:
        """The last place with half of the passage's light, in direction `way`; without any, before all."""
        bright = lit > max(LEAST_LIGHT_DN, 0.5 * lit.max(initial=0.0))
        return float((way * places[bright]).max(initial=-np.inf))

    # Where a passage shows no light at all, that is told otherwise.
    on = way * here < min(end(here, light), end(there, other)) - BESIDE_M / 3
    pair = np.maximum([light[on], np.interp(here[on], there, other)], DARK_DN) if on.any() else np.ones((2, 1))
    if (times := float((pair.max(axis=0) / pair.min(axis=0)).max())) > STEADY:
        raise RefusedError(
            f"the laser's line on the plate on the claw is {times:.1f} times as bright in one passage over it as in "
            f"the next, allowed are {STEADY:g} times: the laser flickers, or the exposure changes. See its supply and "
            "its modulation input, and switch the camera's auto exposure off",
            Measured("line brighter from picture to picture", times, "times", most=STEADY),
        )


def _light(image: NDArray[np.generic], witness: PlateLine) -> Array:
    """The line's light (rows,) where the witness has it, over what is beside it."""
    rows = witness.rows
    offsets = np.arange(-OUTER_PX, OUTER_PX + 1)
    columns = np.round(witness.columns[rows]).astype(np.intp)[:, None] + offsets
    window = image[rows[:, None], np.clip(columns, 0, image.shape[1] - 1)].astype(np.float64)
    inner = np.abs(offsets) <= INNER_PX
    return np.asarray(window[:, inner].mean(axis=1) - window[:, ~inner].mean(axis=1))


def _left_open(places: Array, shares: Array) -> float:
    """How far, m, the area under `shares` at `places` may be off by what was lost in between; too few tell nothing."""
    if len(places) < LEAST_FRAMES:
        return 2.0 * BESIDE_M
    apart = np.diff(places)
    lost = apart > GAP * np.median(apart)
    return float(np.sum((0.5 * apart * np.abs(np.diff(shares)))[lost]))


def _crossing(passage: Passage, way: float) -> float | None:
    """Where the line leaves the plate, in direction `way`, by the area under its shares."""
    places, shares, _ = passage
    if len(places) < LEAST_FRAMES:
        return None
    on, off = (shares[:2], shares[-2:]) if way > 0 else (shares[-2:], shares[:2])
    if on.min() < ALL or off.max() > NONE:
        return None
    shown = float(np.sum(0.5 * (shares[1:] + shares[:-1]) * np.diff(places)))
    return float(places[0] + shown) if way > 0 else float(places[-1] - shown)
