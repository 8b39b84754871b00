"""Compiles, in a second process beside a first calibration, the loops that it and the job after it come to use.

On a fresh machine that is some 20 s of work for a core that has nothing to do. The loops are kept on disk: from then on
there is nothing to compile, and no second process.
"""

import logging
import os
import subprocess
import sys
import threading

import numpy as np
import pinocchio as pin

from cell.base.compiled import is_kept
from cell.measure.inversion import NominalSurface
from cell.measure.inversion.nominal import closest
from cell.measure.inversion.registration import candidates
from cell.measure.reconstruction.cloud import Cloud
from cell.measure.reconstruction.holes import fill_holes
from cell.measure.reconstruction.outliers import find_outliers
from cell.measure.vision.board.dot_edges import measure
from cell.measure.vision.board.dots import measure_dots
from cell.measure.vision.board.lattice import Blobs
from cell.measure.vision.stripe.extract import read_drawn

LINES = 40
"""Lines and rows of the drawn cloud."""
GIVING_WAY = 19
"""How nice the second process is: nothing that moves waits for it."""

log = logging.getLogger(__name__)


_second: list[subprocess.Popen[bytes]] = []
"""The second process, if one was begun. Kept: with its pipe it would end."""


def begin() -> None:
    """Compile in a second process what is not kept on disk yet. It ends with this one, if not before."""
    if _second or (is_kept(closest) and is_kept(measure)):
        return
    mine, nowhere = [sys.executable, "-m", "cell.run.session.warm_up"], subprocess.DEVNULL
    # Nothing is written to the pipe; it closes when this process ends, in whatever way.
    try:
        _second.append(subprocess.Popen(mine, stdin=subprocess.PIPE, stdout=nowhere, stderr=nowhere))
    except OSError as error:
        log.warning("nothing is compiled ahead: %s; the first job waits for it longer", error)


def compile_all() -> None:
    """What reads a stripe, makes a cloud, and finds a surface in it, in the order in which they come to be used."""
    read_drawn()
    measure_dots(np.zeros((9, 9), np.uint8), Blobs(np.full((1, 2), 4.0), np.eye(2)[None]))
    x, y = np.meshgrid(np.linspace(0.0, 0.02, LINES), np.linspace(0.0, 0.02, LINES))
    points = np.dstack([x, y, 20.0 * x * y])
    holed = points.copy()
    holed[LINES // 2, 3:-3] = np.nan
    find_outliers(holed[:, :, 2], np.full(x.shape, 1e-5))
    spread = np.zeros(points.shape, dtype=np.float32) + np.float32(1e-5)
    fill_holes(Cloud(holed, spread, np.zeros((LINES, 3)), x, rail=y[:, 0], rejected=np.zeros(x.shape, dtype=np.bool_)))
    flat, corners = points.reshape(-1, 3), np.arange(LINES**2).reshape(x.shape)[:-1, :-1].ravel()
    surface = NominalSurface(flat, np.stack([corners, corners + 1, corners + LINES], axis=1))
    candidates(pin.SE3.Identity(), flat, surface, shift=0.002, turn=0.05, most=1)
    surface.feet(flat)


def _end_with_the_other() -> None:
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    os.nice(GIVING_WAY)
    threading.Thread(target=_end_with_the_other, daemon=True).start()
    compile_all()
