"""How late the scan camera's stamps come against the rail's positions, and its shutter, from sweeps over a board.

What a camera holds back before it stamps a frame looks, in one sweep, like a shift of the whole scan. Swept the other
way it is a shift to the other side, and it grows with the speed, which the play of a screw does not. Both figures hold
for the settings of camera and rail with which they were found. docs/explanation/theory.md, section 10.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from cell.measure.calibration.archive import ScanObservation
from cell.measure.calibration.drift.evidence import dots_of
from cell.measure.calibration.solve.normal import BOARD, POSITION, dots_block
from cell.measure.geometry.camera import Array
from cell.measure.vision.board.view import BoardView
from drivers.errors import CalibrationStale, Measured, RefusedError

if TYPE_CHECKING:
    from cell.measure.calibration.solve.results import ScanCalibration


@dataclass(frozen=True)
class Shutter:
    """The scan camera's last row is exposed `readout` ± `sigma` s after its first one, set up as `link` says."""

    readout: float
    sigma: float
    link: dict[str, str]

    @classmethod
    def read(cls, data: dict[str, Any] | None) -> Shutter | None:
        """From storage; KeyError, TypeError, AttributeError or ValueError when it is none."""
        if data is None:
            return None
        made = cls(float(data["readout"]), float(data["sigma"]), _link(data))
        if not (np.isfinite(made.readout) and 0 < made.sigma < np.inf):
            raise ValueError(f"a readout of {made.readout} ± {made.sigma} s")
        return made

    def summary(self) -> dict[str, float]:
        """For reports and people, units in the names."""
        return {"readout_ms": round(1e3 * self.readout, 4), "sigma_ms": round(1e3 * self.sigma, 4)}


@dataclass(frozen=True)
class StampTiming:
    """The camera's stamps come `late` ± `sigma` s after the exposures that the rail's positions are told for.

    `play` ± `play_sigma` m is by how much the carriage stands otherwise when it came from the other side; `readout` ±
    `readout_sigma` s from the first row's exposure to the last one's; `by_exposure` s of lateness per s of exposure.
    `made` is in seconds since the epoch, `link` how camera and rail were set up.
    """

    late: float
    sigma: float
    play: float
    play_sigma: float
    readout: float
    readout_sigma: float
    by_exposure: float
    made: float
    link: dict[str, str]

    @classmethod
    def read(cls, data: dict[str, Any] | None) -> StampTiming | None:
        """From storage; KeyError, TypeError, AttributeError or ValueError when it is none."""
        if data is None:
            return None
        figures = {name: float(data[name]) for name in cls.__dataclass_fields__ if name != "link"}
        made = cls(**figures, link=_link(data))
        if not (np.isfinite(list(figures.values())).all() and made.sigma > 0):
            raise ValueError(f"time stamps that are {made.late} ± {made.sigma} s late")
        return made

    @property
    def date(self) -> str:
        """When it was made, for people."""
        return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(self.made))

    def summary(self) -> dict[str, object]:
        """For reports and people, units in the names."""
        return {
            "late_ms": round(1e3 * self.late, 4), "sigma_ms": round(1e3 * self.sigma, 4),
            "play_um": round(1e6 * self.play, 2), "play_sigma_um": round(1e6 * self.play_sigma, 2),
            "readout_ms": round(1e3 * self.readout, 4), "readout_sigma_ms": round(1e3 * self.readout_sigma, 4),
            "late_per_exposure": round(self.by_exposure, 4), "date": self.date,
        }  # fmt: skip


def _link(data: dict[str, Any]) -> dict[str, str]:
    return {str(name): str(value) for name, value in data["link"].items()}


LEAST_FRAMES = 4
"""Of one sweep."""
WANTED_S = 0.2e-3
"""One standard deviation at most: with more, one goes on with what the configuration says."""
SURE = 5.0
"""Standard deviations beyond which a shutter or a stamp is told to be another than the cell reckons with."""
LEAST_READOUT_S = 0.5e-3
BY_EXPOSURE = 0.25
"""Cameras stamp the beginning, the middle or the end of an exposure: 0, 0.5 or 1 of its length later."""
USUAL_PLAY_M = 30e-6
"""One standard deviation of the play of a screw that nobody has measured."""
_TIME_S, _PLACE_M = 0.15e-3, 1e-6
"""About what a sweep's times and its places scatter by: only their ratio counts, what they are shows in the sweeps."""
_ROUNDS = 3


class TimesRefused(RefusedError):
    """The scan camera's pictures do not show what was there when their stamps say: no calibration of it holds."""


@dataclass(frozen=True, eq=False)
class TimedFrame:
    """A picture of the board from a moving rail: what it shows, and the rail's reading, m, at its stamped middle."""

    view: BoardView
    rail: float


@dataclass(frozen=True, eq=False)
class TimedSweep:
    """The frames of one sweep over the board at `velocity` m/s, negative backwards, each exposed for `exposure` s; the
    camera's clock was known to ±`bound` s, the times of the rail's readings to ±`rail_bound` s."""

    velocity: float
    exposure: float
    bound: float
    frames: Sequence[TimedFrame]
    rail_bound: float = 0.0


def find_shutter(
    scan: ScanCalibration, base_from_flange: pin.SE3, sweeps: Sequence[TimedSweep], link: dict[str, str]
) -> Shutter:
    """From sweeps to and fro, the arm standing at `base_from_flange`, camera and rail set up as `link` says. Raises
    `RefusedError` where the sweeps do not tell; whether the shutter will do is for `refuse_rolling` to say."""
    _require_frames(sweeps)
    _, slopes, _ = _displacements(scan, base_from_flange, sweeps)
    readout, sigma = _readout(slopes, sweeps)
    if sigma > WANTED_S:
        raise RefusedError(
            f"how the scan camera's rows are exposed is known to ±{1e3 * sigma:.2f} ms only",
            Measured("readout of the scan camera, one sigma", 1e3 * sigma, "ms", most=1e3 * WANTED_S),
        )
    return Shutter(readout, sigma, link)


def roughly_late(scan: ScanCalibration, base_from_flange: pin.SE3, sweeps: Sequence[TimedSweep]) -> tuple[float, float]:
    """How late the stamps come, s, and its deviation, from sweeps at one speed, to and fro. One speed does not tell
    lateness from the play of a screw: what a usual one makes of it is in the deviation."""
    _require_frames(sweeps)
    shifts, _, _ = _displacements(scan, base_from_flange, sweeps)
    velocities = np.array([sweep.velocity for sweep in sweeps for _ in sweep.frames])
    (_, late), (_, sigma), _ = _least_squares(
        np.column_stack([np.ones(len(shifts)), velocities]), shifts, np.ones(len(shifts))
    )
    by_play = 0.5 * USUAL_PLAY_M / float(np.mean(np.abs(velocities)))
    by_clocks = np.sqrt(np.mean([sweep.bound**2 + sweep.rail_bound**2 for sweep in sweeps]) / 3.0)
    return float(late), float(np.sqrt(sigma**2 + by_play**2 + by_clocks**2))


def find_timing(
    scan: ScanCalibration, base_from_flange: pin.SE3, sweeps: Sequence[TimedSweep], most_late: float, lead: float,
    link: dict[str, str],
) -> StampTiming:  # fmt: skip
    """From sweeps at two speeds and two exposures, to and fro, the arm standing at `base_from_flange`.

    The rail's screw moves the carriage by `lead` m a turn; camera and rail are set up as `link` says.

    Raises `RefusedError` for a rolling shutter, for stamps that depend on the exposure, for ones later than `most_late`
    s, and when the sweeps differ among themselves by more than `WANTED_S` leaves room for.
    """
    _require_frames(sweeps)
    shifts, slopes, places = _displacements(scan, base_from_flange, sweeps)
    of = np.repeat(np.arange(len(sweeps)), [len(sweep.frames) for sweep in sweeps])
    velocities = np.array([sweep.velocity for sweep in sweeps])
    exposures = np.array([sweep.exposure for sweep in sweeps])
    # What the calibration is off by, and the screw in each of its turns, is the same whichever way a place is passed.
    turn = 2 * np.pi * places / lead
    slow = np.column_stack([np.vander((places - places.mean()) / np.ptp(places), 3)[:, :2], np.sin(turn), np.cos(turn)])
    each = (of[:, None] == np.arange(len(sweeps))).astype(np.float64)
    offsets = np.linalg.lstsq(np.column_stack([each, slow]), shifts, rcond=None)[0][: len(sweeps)]
    weights = 1.0 / np.hypot(_TIME_S * velocities, _PLACE_M)
    columns = np.column_stack([np.ones(len(sweeps)), velocities, 0.5 * np.sign(velocities)])
    (_, late, play), (_, sigma, play_sigma), noise = _least_squares(columns, offsets, weights)
    # Of what a comparison of the clocks leaves open, the sweeps' scatter shows what differs from one to the next.
    common = np.mean([sweep.bound**2 for sweep in sweeps]) / 3.0 - noise * _TIME_S**2
    sigma = np.sqrt(sigma**2 + max(0.0, common))
    longer = np.column_stack([columns, velocities * (exposures - exposures.mean())])
    by_exposure, by_sigma = (float(v[3]) for v in _least_squares(longer, offsets, weights)[:2])
    found = float(late), float(sigma), float(play), float(play_sigma), *_readout(slopes, sweeps), by_exposure
    made = StampTiming(*found, time.time(), link)
    _require(made, by_sigma, most_late)
    return made


def refuse_rolling(readout: float, sigma: float) -> None:
    """Raise `TimesRefused` for a last row that is exposed `readout` ± `sigma` s after the first one."""
    if abs(readout) > max(LEAST_READOUT_S, SURE * sigma):
        raise TimesRefused(
            f"the scan camera has a rolling shutter: its last row is exposed {1e3 * readout:.1f} ms after its "
            f"first one, allowed are {1e3 * LEAST_READOUT_S:g} ms. Switch it to a global shutter, or take another one",
            Measured("readout of the scan camera", 1e3 * readout, "ms", most=1e3 * LEAST_READOUT_S),
        )


def _require_frames(sweeps: Sequence[TimedSweep]) -> None:
    for sweep in sweeps:
        if len(sweep.frames) < LEAST_FRAMES:
            raise RefusedError(
                f"{len(sweep.frames)} pictures of the sweep at {1e3 * sweep.velocity:+.0f} mm/s show the fine board, "
                f"{LEAST_FRAMES} are needed: clean it, see that it is lit, and run `cell calibrate timing` again"
            )


def _readout(slopes: Array, sweeps: Sequence[TimedSweep]) -> tuple[float, float]:
    """The readout and its deviation, s, from how much farther the last row of each frame has the carriage, m."""
    velocities = np.array([sweep.velocity for sweep in sweeps for _ in sweep.frames])
    by_row = np.column_stack([np.ones(len(velocities)), velocities])
    found, sigma, _ = _least_squares(by_row, slopes, np.ones(len(velocities)))
    return float(found[1]), float(sigma[1])


def _displacements(
    scan: ScanCalibration, base_from_flange: pin.SE3, sweeps: Sequence[TimedSweep]
) -> tuple[Array, Array, Array]:
    """For each frame how much farther the carriage is read to be than the picture has it, m, how much farther on the
    last row has it than the first, m, and the reading, m."""
    if scan.reference is None:
        raise CalibrationStale(
            "the stored calibration holds no reference, an older program made it; run `cell calibrate`"
        )
    state = scan.state(scan.reference.base_from_board)
    frames = [frame for sweep in sweeps for frame in sweep.frames]
    looks = [dots_of(ScanObservation(frame.view, None, base_from_flange, frame.rail)) for frame in frames]
    # The board's place as all of them see it: in the mean over to and fro.
    for _ in range(_ROUNDS):
        normal, right = np.zeros((6, 6)), np.zeros(6)
        for look in looks:
            off, jacobian = dots_block(state, look, base_from_flange, look.rail)
            by_board = jacobian[:, :, BOARD].reshape(-1, 6)
            normal, right = normal + by_board.T @ by_board, right + by_board.T @ off.ravel()
        step = np.zeros(BOARD.stop)
        step[BOARD] = np.linalg.solve(normal, right)
        state = state.moved(step)
    shifts, slopes = [], []
    for look in looks:
        off, jacobian = dots_block(state, look, base_from_flange, look.rail)
        by_rail = jacobian[:, :, POSITION].reshape(-1)
        row = np.repeat(look.pixels[:, 1] / scan.camera.height - 0.5, 2)
        shift, slope = np.linalg.lstsq(np.column_stack([by_rail, by_rail * row]), off.ravel(), rcond=None)[0]
        shifts.append(shift)
        slopes.append(slope)
    return -np.array(shifts), np.array(slopes), np.array([frame.rail for frame in frames])


def _least_squares(columns: Array, values: Array, weights: Array) -> tuple[Array, Array, float]:
    """Estimates, their standard deviations from what is left, and the weighted mean square of that."""
    columns, values = columns * weights[:, None], values * weights
    inverse = np.linalg.inv(columns.T @ columns)
    found = inverse @ columns.T @ values
    left = values - columns @ found
    noise = float(left @ left) / (len(values) - columns.shape[1])
    return np.asarray(found), np.sqrt(np.diag(inverse) * noise), noise


def _require(made: StampTiming, by_sigma: float, most_late: float) -> None:
    """Raise `RefusedError` for what no correction of the stamps mends."""
    refuse_rolling(made.readout, made.readout_sigma)
    if abs(made.by_exposure) > max(BY_EXPOSURE, SURE * by_sigma):
        raise RefusedError(
            f"the scan camera's time stamps come later by {made.by_exposure:.2f} times what an exposure is longer, "
            "where they have to be those of its beginning (1.00 are those of its end): set the camera, or its "
            "driver, to stamp the start of the exposure",
            Measured("lateness per exposure", made.by_exposure, "", most=BY_EXPOSURE),
        )
    if made.sigma > WANTED_S or SURE * by_sigma > BY_EXPOSURE:
        raise RefusedError(
            f"the sweeps differ by more than time stamps do: these are known to ±{1e3 * made.sigma:.2f} ms, wanted are "
            f"±{1e3 * WANTED_S:g} ms. See that nothing shakes the cell and the rail runs evenly, then run `cell "
            "calibrate timing` again; until then jobs go on with scan_camera.late",
            Measured("time stamps, one sigma", 1e3 * made.sigma, "ms", most=1e3 * WANTED_S),
        )
    refuse_late(made.late, made.sigma, most_late)


def refuse_late(late: float, sigma: float, most_late: float) -> None:
    """Raise `TimesRefused` for stamps that come `late` ± `sigma` s late, which is more than `most_late` s."""
    if abs(late) > most_late + 3 * sigma:
        raise TimesRefused(
            f"the scan camera's time stamps come {1e3 * late:.2f} ms late, scan_camera.late allows "
            f"{1e3 * most_late:g} ms: see the camera's and its driver's settings, or, if that is how this camera is, "
            f'write scan_camera.late = "{np.ceil(1e3 * abs(late)):g} ms", calibrate again and run `cell calibrate '
            "timing`",
            Measured("time stamps are late by", 1e3 * late, "ms", most=1e3 * most_late),
        )
