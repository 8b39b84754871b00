"""The registrations that are compared: ours and, where they are installed, small_gicp's and Open3D's.

Each peer gets the model's own surface as its target, made once and not timed, and the usual coarse-to-fine schedule:
large correspondence distances on a thinned cloud, the smallest on all points. All run in one thread from the same start
on the same cloud. small_gicp estimates normals from neighbours and takes none; Open3D is given the model's own.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
import pinocchio as pin

from cell.geometry.poses import from_matrix
from cell.inversion import NominalSurface, Prior
from cell.inversion.closest import Array
from cell.inversion.correspondences import Scan
from cell.inversion.registration import COARSE_POINTS, register

Method = Callable[[Scan, Prior], pin.SE3]
"""From a scan and the prior, whose pose is the start, to base_from_surface."""

LEVELS = ((0.004, COARSE_POINTS), (0.0015, COARSE_POINTS), (0.0005, None))
"""The peers' schedule: correspondence distance, m, and at most so many points. As ours does, they search with few."""
ITERATIONS = 30
STILL = (1e-6, 1e-5)
"""A peer has converged when a step is smaller than this, m and rad: a fifth of what noise leaves."""
OURS = "ours"
PEERS = ("small_gicp plane", "small_gicp GICP", "Open3D plane, Tukey")


def methods(nominal: NominalSurface, peers: bool = True) -> dict[str, Method | str]:
    """By name a method, or the reason why it cannot run here; without `peers` only ours."""
    found: dict[str, Method | str] = {
        OURS: lambda scan, prior: register(scan, nominal, prior).base_from_surface,
    }
    if not peers:
        return found
    for name, build in zip(PEERS, (_gicp("PLANE_ICP"), _gicp("GICP"), _open3d), strict=True):
        try:
            found[name] = build(nominal)
        except ModuleNotFoundError as error:
            found[name] = f"not shown: {error.name} is not installed (pip install -e '.[bench]')"
        except (ImportError, OSError) as error:
            found[name] = f"not shown: it is installed but does not load ({error}); install the library that it names"
    return found


def _target(nominal: NominalSurface) -> tuple[Array, Array]:
    """Points of the model and its own normals at them."""
    return nominal.samples, nominal.normals[nominal.sample_triangles]


def _at_most(scan: Scan, most: int | None) -> Array:
    return scan.points if most is None else scan.thinned(most).points


def _gicp(kind: str) -> Callable[[NominalSurface], Method]:
    def build(nominal: NominalSurface) -> Method:
        gicp: Any = import_module("small_gicp")
        target = gicp.PointCloud(_target(nominal)[0])
        tree = gicp.KdTree(target)
        gicp.estimate_normals_covariances(target, tree)

        def run(scan: Scan, prior: Prior) -> pin.SE3:
            guess = np.asarray(prior.base_from_surface.inverse().homogeneous)
            for distance, most in LEVELS:
                source = gicp.PointCloud(_at_most(scan, most))
                if kind == "GICP":
                    gicp.estimate_covariances(source)
                guess = gicp.align(
                    target, source, tree, guess, registration_type=kind, max_correspondence_distance=distance,
                    num_threads=1, max_iterations=ITERATIONS, translation_epsilon=STILL[0], rotation_epsilon=STILL[1],
                ).T_target_source  # fmt: skip
            return from_matrix(guess).inverse()

        return run

    return build


def _open3d(nominal: NominalSurface) -> Method:
    o3d: Any = import_module("open3d")
    icp = o3d.pipelines.registration
    points, normals = _target(nominal)
    target = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    target.normals = o3d.utility.Vector3dVector(normals)

    def run(scan: Scan, prior: Prior) -> pin.SE3:
        guess = np.asarray(prior.base_from_surface.inverse().homogeneous)
        for distance, most in LEVELS:
            source = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(_at_most(scan, most)))
            guess = icp.registration_icp(
                source, target, distance, guess,
                icp.TransformationEstimationPointToPlane(icp.TukeyLoss(k=distance / 2.5)),
                icp.ICPConvergenceCriteria(1e-7, 1e-9, ITERATIONS),
            ).transformation  # fmt: skip
        return from_matrix(guess).inverse()

    return run
