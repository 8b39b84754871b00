"""Frames as if recorded, made by OpenCV's projection and by nothing of this project: boards, stripes, flange poses."""

import os
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pinocchio as pin
import pytest

from cell.apps.recordings.frames import RecordedFrame
from cell.apps.recordings.result import RecordedResult
from cell.apps.recordings.solution import camera_of, solve_frames
from cell.measure.geometry.camera import CameraModel
from cell.measure.vision.board.board import board_pose
from cell.measure.vision.board.view import BoardView, parse_board
from cell.measure.vision.stripe.profile import StripeProfile
from tests.support import ROOT

SIZE = (1280, 1024)
MATRIX = np.array([[1400.0, 0.0, 655.0], [0.0, 1405.0, 500.0], [0.0, 0.0, 1.0]])
LENS = np.array([-0.12, 0.10, 3e-4, -2e-4, 0.0])
NORMAL = np.array([0.80, 0.05, -0.6]) / np.linalg.norm([0.80, 0.05, -0.6])
DISTANCE = float(NORMAL @ [0.0, 0.0, 0.40])
SECOND_NORMAL, SECOND_FURTHER = cv2.Rodrigues(np.array([0.0, 0.15, 0.0]))[0] @ NORMAL, 0.012
BOARD = parse_board("chessboard:7x6:18mm")
TRUTH = CameraModel(*SIZE, MATRIX[0, 0], MATRIX[1, 1], MATRIX[0, 2], MATRIX[1, 2], tuple(LENS))
EDGE = 5
DOTS_PX, STRIPE_PX = 0.08, 0.15

RECORDED = Path(os.environ.get("CELL_RECORDED_DATA", ROOT.parent / "shared" / "data"))


def recording(name: str) -> Path:
    """A folder of the recorded data; the test is skipped without them."""
    folder = RECORDED / name
    if not folder.is_dir():
        pytest.skip(f"recorded data are missing: {folder} (set CELL_RECORDED_DATA)")
    return folder


def pose(turn: tuple[float, float, float], place: tuple[float, float, float]) -> pin.SE3:
    """A pose from a rotation vector and a translation."""
    return pin.SE3(cv2.Rodrigues(np.array(turn))[0], np.array(place))


FLANGE_FROM_CAMERA = pose((0.02, -0.03, 1.5), (0.06, -0.04, 0.11))
BASE_FROM_BOARD = pose((np.pi - 0.02, 0.03, 0.2), (0.55, 0.1, 0.02))


def scene(
    seed: int = 0, count: int = 9, arm_mm: float = 0.05, arm_mrad: float = 0.1, bend: float = 0.0, axes: int = 3,
    second: tuple[int, ...] = (), laser: bool = True, board: str = BOARD.name, focal: float = 1.0, tilt: float = 0.45,
    spread: float = 1.0,
) -> list[RecordedFrame]:  # fmt: skip
    """Frames with poses. `bend` in m at the board's edge; turns about `axes` axes; `second`: frames of another line.

    `focal`: the boards are seen with so many times the focal length. `tilt`: at most, rad, each way. `spread`: of the
    board's place before the camera; an arm that goes round the board leaves it in one place.
    """
    rng = np.random.default_rng(seed)
    spec = parse_board(board)
    points = spec.points()
    middle = points.mean(axis=0)
    real = points.copy()
    real[:, 2] += bend * ((points[:, 0] - middle[0]) / (np.ptp(points[:, 0]) / 2)) ** 2
    frames = []
    for k in range(count):
        angles = rng.uniform((-tilt, -tilt, -0.9), (tilt, tilt, 0.9)) * (axes > 1, axes > 1, axes > 0)
        angles += (0.25, 0.1, 0.3) if axes < 2 else (0.0, 0.0, 0.0)
        turn = _turn(2, angles[2]) @ _turn(0, angles[0]) @ _turn(1, angles[1])
        at = np.array([rng.uniform(-0.05, 0.05), rng.uniform(-0.035, 0.035), 0.4 + rng.uniform(-0.06, 0.06)])
        at = (0.0, 0.0, 0.4) + spread * (at - (0.0, 0.0, 0.4))
        camera_from_board = pin.SE3(turn, at - turn @ middle)
        frame = RecordedFrame(Path(f"frame{k:04d}.png"), f"frame{k:04d}.png")
        frame.view = _view(spec, real, camera_from_board, rng, focal)
        exact = BASE_FROM_BOARD * (FLANGE_FROM_CAMERA * camera_from_board).inverse()
        off = cv2.Rodrigues(rng.normal(0, 1e-3 * arm_mrad, 3))[0]
        frame.base_from_flange = pin.SE3(off @ exact.rotation, exact.translation + rng.normal(0, 1e-3 * arm_mm, 3))
        if laser:
            frame.profile = _profile(camera_from_board, points, k in second, rng)
        frames.append(frame)
    return frames


def _turn(axis: int, angle: float) -> np.ndarray:
    return cv2.Rodrigues(angle * np.eye(3)[axis])[0]


def _view(spec, real: np.ndarray, camera_from_board: pin.SE3, rng: np.random.Generator, focal: float) -> BoardView:
    turn = cv2.Rodrigues(camera_from_board.rotation)[0]
    matrix = MATRIX * np.array([[focal], [focal], [1.0]])
    matrix[:2, 2] = MATRIX[:2, 2]
    pixels = cv2.projectPoints(real, turn, camera_from_board.translation, matrix, LENS)[0].reshape(-1, 2)
    pixels += rng.normal(0, DOTS_PX, pixels.shape)
    seen = np.flatnonzero(((pixels > EDGE) & (pixels < np.array(SIZE) - EDGE)).all(axis=1))
    return BoardView(spec, SIZE, seen, pixels[seen], np.full(len(seen), DOTS_PX), spec.symmetric)


def _profile(
    camera_from_board: pin.SE3, points: np.ndarray, second: bool, rng: np.random.Generator
) -> StripeProfile | None:
    """The stripe where light plane and board meet, one column for each row."""
    normal = SECOND_NORMAL if second else NORMAL
    distance = DISTANCE + (SECOND_FURTHER if second else 0.0)
    out = camera_from_board.rotation[:, 2]
    along = np.cross(normal, out)
    middle = camera_from_board.act(points.mean(axis=0))
    start = np.linalg.solve(
        np.array([normal, out, along]), np.array([distance, out @ camera_from_board.translation, along @ middle])
    )
    line = start + np.linspace(-0.2, 0.2, 4001)[:, None] * along / np.linalg.norm(along)
    pixels = cv2.projectPoints(line, np.zeros(3), np.zeros(3), MATRIX, LENS)[0].reshape(-1, 2)
    local = ((line - camera_from_board.translation) @ camera_from_board.rotation)[:, :2]
    low, high = points[:, :2].min(axis=0) - 0.01, points[:, :2].max(axis=0) + 0.01
    there = ((local > low) & (local < high)).all(axis=1)
    there &= ((pixels > EDGE) & (pixels < np.array(SIZE) - EDGE)).all(axis=1)
    if there.sum() < 50:
        return None
    pixels = pixels[there][np.argsort(pixels[there][:, 1])]
    rows = np.arange(int(np.ceil(pixels[0, 1])), int(pixels[-1, 1]))
    centres, sigma = np.full(SIZE[1], np.nan), np.full(SIZE[1], np.nan)
    centres[rows] = np.interp(rows, pixels[:, 1], pixels[:, 0]) + rng.normal(0, STRIPE_PX, len(rows))
    sigma[rows] = STRIPE_PX
    known, nowhere = np.isfinite(centres), np.zeros(SIZE[1], dtype=np.bool_)
    return StripeProfile(
        "rows", centres, sigma, np.where(known, 50.0, np.nan), np.where(known, 1.5, np.nan), nowhere, nowhere.copy()
    )


Z = 3.5
PLACE = 0.40
"""Where on the optical axis the light plane is looked at, m."""


def solved(frames: list[RecordedFrame], given: CameraModel | None = None) -> dict[str, Any]:
    result = RecordedResult()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        solve_frames(frames, camera_of(frames, given), result, given=given)
    return result.as_dict()


def right(result: dict[str, Any]) -> bool:
    """All that is not refused lies within what is stated about it."""
    camera, hand, plane = result["intrinsics"], result["hand_eye"], result["light_plane"]
    if camera is not None:
        truth = {"fx": MATRIX[0, 0], "fy": MATRIX[1, 1], "cx": MATRIX[0, 2], "cy": MATRIX[1, 2]}
        if any(abs(camera[name] - value) > Z * camera["sigma_px"][name] for name, value in truth.items()):
            return False
    if hand is not None:
        off = np.array(hand["translation_mm"]) - 1e3 * FLANGE_FROM_CAMERA.translation
        turn = np.degrees(pin.log3(np.array(hand["rotation"]) @ FLANGE_FROM_CAMERA.rotation.T))
        if np.any(np.abs(off) > Z * np.array(hand["sigma_mm"])) or np.any(
            np.abs(turn) > Z * np.array(hand["sigma_deg"])
        ):
            return False
    if plane is not None:
        at = np.array([(DISTANCE - NORMAL[2] * PLACE) / NORMAL[0], 0.0, PLACE])
        off_mm = abs(1e3 * at @ np.array(plane["normal"]) - plane["distance_mm"])
        tilt = np.degrees(np.arccos(min(1.0, abs(np.array(plane["normal"]) @ NORMAL))))
        if off_mm > Z * plane["sigma_place_mm"] or tilt > Z * plane["sigma_normal_deg"]:
            return False
    return True


def given_pairs(frames: list[RecordedFrame]) -> list[tuple[pin.SE3, pin.SE3]]:
    """The frames' flange poses, and their boards as the true camera sees them."""
    return [(f.base_from_flange, board_pose(f.view, TRUTH).camera_from_board) for f in frames]
