"""Which fitted lines are believable stripes, and how far the stated deviation has to grow where the model misfits."""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.base.compiled import compiled
from cell.measure.vision.stripe.ordinary.find import CENTRE, CORE
from cell.measure.vision.stripe.ordinary.fit import AMPLITUDE, CHI2, FISHER, FIT_CENTRE, SIGMA, WIDTH

# A misfit that noise makes once in some hundred lines; beyond it, the deviation grows with the misfit.
MISFIT_SIGMAS = 3.0


@compiled
def believe(
    fitted: Any, start: Any, length: int, narrowest: float, widest: float, least: float, excess: float, double: Any,
    saturated: Any,
) -> None:  # fmt: skip
    """Put NaN into the lines of `fitted` (FITTED, lines) that are no stripe of a picture of `length` px a line.

    A stripe has a width in px within the range, an amplitude above `least` DN, its whole peak in the picture, and its
    centre near the start's. The variance of the others grows by `excess` and with their misfit. `double` and
    `saturated` (lines,) are True of no line that is none; the latter is told here.
    """
    for r in range(fitted.shape[1]):
        centre, width, fisher = fitted[FIT_CENTRE, r], fitted[WIDTH, r], fitted[FISHER, r]
        keep = width > narrowest and width < widest and fitted[AMPLITUDE, r] > least
        keep = keep and centre > 1.5 * width and centre < length - 1 - 1.5 * width
        keep = keep and abs(centre - start[r, 0, CENTRE]) < max(3.0, 2 * width)
        if keep and fisher < max(1.0, 0.5 * width):
            pixels = 8 * width + 2
            allowed = 1 + MISFIT_SIGMAS * np.sqrt(2 / pixels)
            fitted[SIGMA, r] *= np.sqrt(excess * max(1.0, fitted[CHI2, r] / allowed))
            saturated[r] = start[r, 0, CORE] > 0
        else:
            fitted[FIT_CENTRE, r] = fitted[SIGMA, r] = fitted[AMPLITUDE, r] = fitted[WIDTH, r] = np.nan
            double[r] = saturated[r] = False
