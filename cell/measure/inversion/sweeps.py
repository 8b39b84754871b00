"""Several sweeps in one scan: the pose of each is off by an error of its own, which is found along with the surface's.

Fitted as if they lay right, two strips side by side turn what their heights differ by into a tilt. But every sweep sees
the same surface, and how much its pose may be off is known: both together tell the errors apart. Least squares with
one more unknown for each of them, known beforehand to its standard deviation (docs/explanation/theory.md, section 8).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cell.measure.geometry.poses import difference, perturbed
from cell.measure.inversion.closest import Array
from cell.measure.inversion.correspondences import Scan
from cell.measure.inversion.registration import Prior, Registration, by_lines


def balance(found: Registration, scan: Scan, moved: Array, prior: Prior) -> Registration:
    """The registration `found` in `scan`, with the sweeps' own errors told apart from the pose.

    `moved` (n, 3, m): how one standard deviation of each of m independent errors displaces the n used points, m, base
    axes. One step from where the registration has converged. What the errors leave behind in the pose is not part of
    the covariance: as for any displacement of the points, `follow` says it.
    """
    by_pose = np.concatenate([found.normals, np.cross(found.arms, found.normals)], axis=1)
    columns = np.concatenate([by_pose, np.einsum("ni,nim->nm", found.normals, moved)], axis=1)
    weighted = columns / found.sigmas[:, None] ** 2
    known = np.eye(columns.shape[1])
    known[:6, :6] = prior.information()
    towards = np.zeros(len(known))
    towards[:6] = prior.information() @ difference(prior.base_from_surface, found.base_from_surface)
    total = np.linalg.inv(weighted.T @ columns + known)[:6]
    follow = total @ weighted.T
    by_prior = total[:, :6]
    lines = by_lines(follow, scan, found)
    return replace(
        found,
        base_from_surface=perturbed(found.base_from_surface, follow @ found.heights + total @ towards),
        covariance=np.asarray(
            (follow * found.sigmas**2) @ follow.T + by_prior @ known[:6, :6] @ by_prior.T + lines @ lines.T
        ),
        follow=follow,
    )
