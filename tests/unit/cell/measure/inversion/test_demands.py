"""A figure that is no number passes no gate: each asks whether it is good, not whether it is bad."""

from collections.abc import Callable
from types import SimpleNamespace as Told
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from cell.config.job import load_job
from cell.measure.inversion import Demands, NominalSurface, Tolerance
from cell.measure.inversion.demands import require_agreement, require_board, require_fit, require_whole
from cell.measure.inversion.effects.between_sweeps import SurfaceMotion
from cell.measure.inversion.effects.during_sweep import require_firm
from cell.measure.inversion.nominal import Scan
from cell.procedures.arm.photograph import _require
from cell.procedures.sweep.second_look import require_surface_unmoved
from cell.procedures.sweep.swath import SweepErrors, TimeBound, shift_by_times
from drivers.errors import DeviceFault, RefusedError

ONE, ALLOWED = np.eye(6), Demands()
TOLERANCE, PHOTO = Tolerance(translation=0.0006, rotation=0.006), load_job("pot")[0].photo
Gate = Callable[[Any], object]
GATES: dict[str, tuple[float, Gate]] = {
    "coverage": (0.9, lambda v: require_fit(Told(share=0.9, rms=1e-4), v, ALLOWED)),
    "share": (0.9, lambda v: require_fit(Told(share=v, rms=1e-4), 0.9, ALLOWED)),
    "rms": (1e-4, lambda v: require_fit(Told(share=0.9, rms=v), 0.9, ALLOWED)),
    "excess": (
        0.1,
        lambda v: require_agreement(Told(excess=v, middle=ONE[0, :3], shift=v, turn=v), TOLERANCE, ALLOWED),
    ),
    "off the board": (0.1, lambda v: require_board(0 * ONE, Told(covariance=ONE), np.full(6, v))),
    "obliquity": (0.1, lambda v: _require(Told(obliquity=v, rms_px=0.01), PHOTO)),
    "residual": (0.01, lambda v: _require(Told(obliquity=0.1, rms_px=v), PHOTO)),
    "motion": (0.0, lambda v: require_surface_unmoved(SurfaceMotion(np.full(6, v), ONE, 1.0, ONE))),
    "matched": (1.0, lambda v: require_surface_unmoved(SurfaceMotion(0 * ONE[0], ONE, v, ONE))),
    "times": (1e-3, lambda v: shift_by_times([TimeBound("rail", "rail", v)], 0.01, SweepErrors(ONE, 1e-5, 1e-4))),
    "rocking": (1e-5, lambda v: require_firm(v, 1e-5, "the place")),
}  # type: ignore[dict-item, arg-type]


@pytest.mark.parametrize(("good", "gate"), GATES.values(), ids=GATES)
def test_a_figure_that_is_no_number_is_refused(good: float, gate: Gate):
    gate(good)
    with pytest.raises((RefusedError, DeviceFault)):
        gate(float("nan"))


def test_a_wide_surface_is_as_whole_as_it_was_seen():
    """As few points to its area as 10,000 are on 0.6 m by 0.3 m: one to a square of 4 mm."""
    corners = np.array([[0.0, 0.0, 0.0], [0.06, 0.0, 0.0], [0.06, 0.03, 0.0], [0.0, 0.03, 0.0]])
    plate, nothing = NominalSurface(corners, np.array([[0, 1, 2], [0, 2, 3]])), np.zeros((120, 3))
    points = np.random.default_rng(0).uniform((0.001, 0.001, 0.0), (0.059, 0.029, 0.0), (120, 3))
    scan = Scan(points, nothing, nothing, np.arange(120))
    require_whole(scan, pin.SE3.Identity(), plate, TOLERANCE, ALLOWED)
    points[points[:, 0] < 0.03, 2] = 1e-3
    with pytest.raises(RefusedError, match=r"[45]\d % of the scanned area lies more than"):
        require_whole(scan, pin.SE3.Identity(), plate, TOLERANCE, ALLOWED)
