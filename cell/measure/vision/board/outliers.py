"""Points of a board that do not lie where their neighbours say: a laser line, a glint or a finger moved them.

A flat board is seen through a homography and a smooth lens; what departs from both is dropped.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from cell.measure.vision.board.view import BoardView

OUTLYING = 6.0
LEAST_PX = 0.2
ROUNDS = 6
# Median length of two Gaussian variables.
MEDIAN_LENGTH = 1.177
# So many points tell a lens, which bends by third powers, from points that lie astray.
LENS_POINTS = 28


def without_outliers(view: BoardView) -> BoardView:
    """The view without the points whose place disagrees with the smooth picture of the others."""
    flat = view.object_points[:, :2] / view.spec.pitch
    terms = 10 if len(flat) >= LENS_POINTS else 6 if len(flat) >= 20 else 3
    homography, _ = cv2.findHomography(flat, view.pixels, cv2.RANSAC, 3.0)
    if homography is None or len(flat) < 12:
        return view
    mapped = np.column_stack([flat, np.ones(len(flat))]) @ np.asarray(homography, dtype=np.float64).T
    residual = view.pixels - mapped[:, :2] / mapped[:, 2:]
    x, y = ((flat - flat.mean(axis=0)) / np.ptp(flat, axis=0).max()).T
    powers = (np.ones_like(x), x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3)
    design = np.column_stack(powers[:terms])
    weight = 1.0 / view.sigma
    keep = np.ones(len(flat), dtype=np.bool_)
    for _ in range(ROUNDS):
        # Weighted: points that a laser line moved alike are many, but their edges were seen to be doubtful.
        inverse = np.linalg.pinv((weight[:, None] * design)[keep]) * weight[keep]
        # A point at the board's corner draws the fit to itself: what counts is its distance from the fit without it.
        own = np.zeros(len(flat))
        own[keep] = np.einsum("nk,kn->n", design[keep], inverse)
        away = np.linalg.norm(residual - design @ (inverse @ residual[keep]), axis=1) / np.maximum(1 - own, 0.05)
        limit = max(LEAST_PX, OUTLYING * float(np.median(away[keep])))
        new = away < limit
        if new.sum() < terms + 4 or (new == keep).all():
            break
        keep = new
    sigma = view.sigma[keep]
    if view.spec.kind == "aprilgrid":
        # What is printed inside a blurred tag draws its sides alike, which their own straightness does not show.
        more = float(np.median(away[keep] / sigma)) / MEDIAN_LENGTH
        sigma = sigma * max(1.0, more)
    return replace(view, ids=view.ids[keep], pixels=view.pixels[keep], sigma=sigma)
