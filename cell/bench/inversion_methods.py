"""The registrations that are compared: ours and, where they are installed, small_gicp's and Open3D's.

Each peer gets the model's own surface as its target, made once and not timed, and the usual coarse-to-fine schedule of
correspondence distances; all run in one thread from the same start on the same points.
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
from cell.inversion.registration import Scan, register

Method = Callable[[Scan, Prior], pin.SE3]
"""From a scan and the prior, whose pose is the start, to base_from_surface."""

DISTANCES = (0.004, 0.0015, 0.0005)
"""Correspondence distances of the peers, m, coarse to fine."""
ITERATIONS = 30
PEERS = ("small_gicp plane", "small_gicp GICP", "Open3D plane, Tukey")


def methods(nominal: NominalSurface, peers: bool = True) -> dict[str, Method | str]:
    """By name a method, or the reason why it cannot run here; without `peers` only ours."""
    found: dict[str, Method | str] = {
        "ours": lambda scan, prior: register(scan, nominal, prior).base_from_surface,
    }
    if not peers:
        return found
    for name, build in zip(PEERS, (_gicp("PLANE_ICP"), _gicp("GICP"), _open3d), strict=True):
        try:
            found[name] = build(nominal)
        except (ImportError, OSError) as error:
            found[name] = f"not installed ({error})"
    return found


def _target(nominal: NominalSurface) -> tuple[Array, Array]:
    """Points of the model and its own normals at them."""
    return nominal.samples, nominal.normals[nominal.sample_triangles]


def _gicp(kind: str) -> Callable[[NominalSurface], Method]:
    def build(nominal: NominalSurface) -> Method:
        gicp: Any = import_module("small_gicp")
        target = gicp.PointCloud(_target(nominal)[0])
        tree = gicp.KdTree(target)
        gicp.estimate_normals_covariances(target, tree)

        def run(scan: Scan, prior: Prior) -> pin.SE3:
            source = gicp.PointCloud(scan.points)
            if kind == "GICP":
                gicp.estimate_covariances(source)
            guess = np.asarray(prior.base_from_surface.inverse().homogeneous)
            for distance in DISTANCES:
                guess = gicp.align(
                    target, source, tree, guess, registration_type=kind, max_correspondence_distance=distance,
                    num_threads=1, max_iterations=ITERATIONS, rotation_epsilon=1e-6, translation_epsilon=1e-7,
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
        source = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(scan.points))
        guess = np.asarray(prior.base_from_surface.inverse().homogeneous)
        for distance in DISTANCES:
            guess = icp.registration_icp(
                source, target, distance, guess,
                icp.TransformationEstimationPointToPlane(icp.TukeyLoss(k=distance / 2.5)),
                icp.ICPConvergenceCriteria(1e-7, 1e-9, ITERATIONS),
            ).transformation  # fmt: skip
        return from_matrix(guess).inverse()

    return run
