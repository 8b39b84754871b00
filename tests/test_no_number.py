"""A figure that is no number passes no gate: each asks whether it is good, not whether it is bad."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cell.inversion import Demands, Tolerance
from cell.inversion.demands import require_agreement, require_board, require_fit
from cell.inversion.moved import SurfaceMotion
from cell.inversion.observability import judge
from cell.inversion.rocking import require_firm
from cell.job import load_job
from cell.steps.photograph import _require
from cell.steps.swath import SweepErrors, TimeBound, shift_by_times
from drivers.errors import DeviceFault, RefusedError

NAN, ONE = float("nan"), np.eye(6)
TOLERANCE = Tolerance(translation=0.0006, rotation=0.006)


def fit(coverage: float = 0.9, share: float = 0.9, rms: float = 1e-4) -> None:
    require_fit(SimpleNamespace(share=share, rms=rms), coverage, Demands())  # type: ignore[arg-type]


def agreement(excess: float = 0.1) -> None:
    found = SimpleNamespace(excess=excess, middle=np.zeros(3), shift=1e-4, turn=1e-3)
    require_agreement(found, TOLERANCE, Demands())  # type: ignore[arg-type]


def board(off: float = 0.1) -> None:
    require_board(0 * ONE, SimpleNamespace(covariance=ONE), np.array([off, *5 * [0.0]]))  # type: ignore[arg-type]


def photographed(obliquity: float = 0.1, rms_px: float = 0.01) -> None:
    pose: Any = SimpleNamespace(obliquity=obliquity, rms_px=rms_px)
    _require(pose, load_job("pot")[0].photo)


def unmoved(motion: float = 0.0, matched: float = 1.0) -> None:
    if SurfaceMotion(np.full(6, motion), ONE, matched, ONE).moved:
        raise RefusedError("it has moved")


def timed(bound: float = 1e-3) -> None:
    shift_by_times([TimeBound("rail", "rail", bound)], 0.01, SweepErrors(ONE, 1e-5, 1e-4))


def firm(angle: float = 1e-5) -> None:
    require_firm(angle, 1e-5, "the place")


@pytest.mark.parametrize(
    ("gate", "figure"),
    [(fit, "coverage"), (fit, "share"), (fit, "rms"), (agreement, "excess"), (board, "off"), (firm, "angle"),
     (photographed, "obliquity"), (photographed, "rms_px"), (unmoved, "motion"), (unmoved, "matched"),
     (timed, "bound")],
)  # fmt: skip
def test_a_figure_that_is_no_number_is_refused(gate: Callable[..., None], figure: str) -> None:
    gate()
    with pytest.raises((RefusedError, DeviceFault)):
        gate(**{figure: NAN})


def test_what_is_known_of_a_pose_is_no_number() -> None:
    with pytest.raises((RefusedError, np.linalg.LinAlgError)):
        judge(NAN * ONE, ONE, 1e-9, 100, 0.1, TOLERANCE).require()
