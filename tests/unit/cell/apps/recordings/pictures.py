"""A recording of a chessboard from eight poses: warped by OpenCV, written by numpy and scipy, by nothing under test."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from cell.apps.recordings.command import Options, attach_poses
from cell.apps.recordings.frames import RecordedFrame
from cell.apps.recordings.series import list_folder, match_series, read_series
from cell.measure.geometry.camera import CameraModel
from cell.measure.vision.board.view import parse_board

BOARD = parse_board("chessboard:7x5:20mm")
SIZE = (640, 480)
CAMERA = CameraModel(*SIZE, 700.0, 700.0, 322.0, 238.0)
FLANGE_FROM_CAMERA = np.eye(4)
FLANGE_FROM_CAMERA[:3, :3] = Rotation.from_euler("xyz", (4, -7, 93), degrees=True).as_matrix()
FLANGE_FROM_CAMERA[:3, 3] = 0.05, -0.03, 0.08
BASE_FROM_BOARD = np.eye(4)
BASE_FROM_BOARD[:3, :3] = Rotation.from_euler("xyz", (178, 3, 20), degrees=True).as_matrix()
BASE_FROM_BOARD[:3, 3] = 0.45, -0.1, 0.02
VIEWS = (
    (0, 0, 0), (25, 5, 10), (-20, 15, -30), (8, -28, 60), (-15, -18, 120), (20, 22, -75), (-28, 4, 35), (5, 30, -140),
)  # fmt: skip


def flange_poses() -> list[np.ndarray]:
    """base_from_flange (4, 4) of each view of the board, in m."""
    poses = []
    for k, angles in enumerate(VIEWS):
        camera_from_board = np.eye(4)
        camera_from_board[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
        middle = camera_from_board[:3, :3] @ (0.06, 0.04, 0)
        camera_from_board[:3, 3] = np.array([0.01 * (k % 3 - 1), 0.008 * (k % 2), 0.42 + 0.02 * (k % 4)]) - middle
        poses.append(BASE_FROM_BOARD @ np.linalg.inv(camera_from_board) @ np.linalg.inv(FLANGE_FROM_CAMERA))
    return poses


POSES = flange_poses()


def photograph(base_from_flange: np.ndarray) -> np.ndarray:
    """The board as CAMERA sees it, warped at four times the size and averaged."""
    cell = 40
    squares = np.indices((6, 8)).sum(axis=0) % 2 * 200 + 25
    sheet = np.full((6 * cell + 2 * cell, 8 * cell + 2 * cell), 225, np.uint8)
    sheet[cell:-cell, cell:-cell] = np.kron(squares, np.ones((cell, cell)))
    camera_from_board = np.linalg.inv(FLANGE_FROM_CAMERA) @ np.linalg.inv(base_from_flange) @ BASE_FROM_BOARD
    # Pixels of the sheet to metres on the board: its first inner corner lies at (2, 2) squares, edges between pixels.
    metres = np.diag([0.02 / cell, 0.02 / cell, 1.0])
    metres[:2, 2] = -0.04 + 0.5 * 0.02 / cell
    into = CAMERA.matrix @ camera_from_board[:3, [0, 1, 3]] @ metres
    large = np.diag([4.0, 4.0, 1.0])
    large[:2, 2] = 1.5
    wide = cv2.warpPerspective(sheet, large @ into, (4 * SIZE[0], 4 * SIZE[1]), flags=cv2.INTER_LINEAR, borderValue=90)
    return cv2.resize(cv2.GaussianBlur(wide, (0, 0), 2.5), SIZE, interpolation=cv2.INTER_AREA)


def matched(folder: Path):
    """The listing, the series of its pictures, and the links and what was not read of a folder."""
    listing = list_folder(folder)
    series, links, unread = read_series(listing)
    belonging, strange = match_series(series, listing, links)
    return listing, belonging, links, [*listing.unread, *unread, *strange]


def understand(folder: Path, seen: dict[str, RecordedFrame], **said: str):
    """Frames with their poses as the product understands them, what it says about them, and what it did not read."""
    listing, belonging, _, unread = matched(folder)
    frames = [RecordedFrame(p, listing.name(p), seen[p.name].view) for p in listing.pictures]
    return frames, attach_poses(frames, belonging, CAMERA, Options(**said)), unread


def quaternion(pose: np.ndarray, order: str = "xyzw") -> list[float]:
    q = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return (q if order == "xyzw" else q[[3, 0, 1, 2]]).tolist()


def one_file_each(folder: Path, text: Callable[[np.ndarray], str], name: str = "pose{:02d}.txt") -> None:
    for k, pose in enumerate(POSES):
        path = folder / name.format(k + 3)
        path.parent.mkdir(exist_ok=True)
        path.write_text(text(pose))


def row(values, separator: str = " ") -> str:
    return separator.join(f"{v:.9f}" for v in np.ravel(values))


def angles(pose: np.ndarray, kind: str = "rotvec", degrees: bool = False) -> np.ndarray:
    rotation = Rotation.from_matrix(pose[:3, :3])
    return rotation.as_rotvec() if kind == "rotvec" else rotation.as_euler(kind, degrees=degrees)


def tuples(folder: Path) -> None:
    one_file_each(folder, lambda p: str((tuple(p[:3, 3]), tuple(quaternion(p)))))


def of_each(text: Callable[[int, np.ndarray], str], between: str = "\n") -> str:
    """The text of each pose with the number of its picture."""
    return between.join(text(k + 3, p) for k, p in enumerate(POSES))


def lit(image: np.ndarray, red: float) -> np.ndarray:
    """A picture (h, w) with a red laser line on it, in colour, blue first; on white it is as bright as the paper."""
    across = np.arange(image.shape[1]) - (300 + 0.1 * np.arange(image.shape[0]))[:, None]
    stripe = np.exp(-0.5 * (across / 2.0) ** 2)
    colour = np.repeat(image[:, :, None].astype(float), 3, axis=2)
    colour[:, :, 2] += red * stripe
    colour[:, :, :2] -= 0.35 * red * stripe[:, :, None]
    return np.clip(np.rint(colour + np.random.default_rng(5).normal(0, 1, colour.shape)), 0, 255).astype(np.uint8)
