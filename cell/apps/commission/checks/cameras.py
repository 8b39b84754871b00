"""The two cameras: light and focus, how each is mounted, and whether its board is as large as its name says."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pinocchio as pin

from cell.apps.commission.check import CommissionCheck, Result
from cell.apps.commission.measuring import Eye, RoughMounting, against_drawing, eye_of, find_view, measure
from cell.apps.commission.workplace import CommissionWorkplace
from cell.measure.vision.board.view import BoardSpec
from drivers.interfaces import Image

PITCH_OFF = 0.025
"""By how much, relative, a board has to be larger or smaller than its name before it is another board."""
FOCAL_OFF = 0.05
MOST_RESIDUAL = {"scan_camera": 1.5, "target_camera": 5.0}
"""How far apart, mm RMS, views may put the board: a lens that is not calibrated bends its picture by a few pixels."""
MOST_MOVED = 0.030
"""How far the board on the deck may be from where it is drawn, m: calibration looks for it within that."""
WIDEST_EDGE = 8.0
LEAST_CONTRAST = 25.0
MOST_SATURATED = 1.0


def _look(name: str, workplace: CommissionWorkplace, result: Result) -> None:
    eye = eye_of(workplace, name)
    seen = find_view(workplace, result, eye)
    workplace.keep(result, f"{name}-focus", seen.frame, seen.view.pixels)
    picture_figures(result, seen.frame.image, seen.view.pixels, eye)
    result.measure("points of the board in the picture", len(seen.view.ids), "", least=12)


def picture_figures(result: Result, image: Image, points: object, eye: Eye) -> None:
    """Brightness, contrast and sharpness of the board in a picture, each with its limit."""
    low, high = np.floor(np.min(points, axis=0)).astype(int), np.ceil(np.max(points, axis=0)).astype(int)  # type: ignore[call-overload]
    (x0, y0), (x1, y1) = np.maximum(low, 0), high
    board = image[y0 : y1 + 1, x0 : x1 + 1].astype(float)
    dark, bright = np.percentile(board, [3, 97])
    exposure = f"{eye.name}.photo_exposure"
    remedy = f"Change {exposure} or the light."
    result.measure("brightness of the board", bright, "DN", least=60.0, most=250.0, remedy=remedy)
    remedy = f"Raise {exposure}, or light the board evenly."
    result.measure("contrast of the board", bright - dark, "DN", least=LEAST_CONTRAST, remedy=remedy)
    saturated = 100.0 * float((board >= 255).mean())
    result.measure("saturated pixels", saturated, "%", most=MOST_SATURATED, remedy=f"Lower {exposure}.")
    across = np.abs(board[:, 2:] - board[:, :-2]) / 2.0
    down = np.abs(board[2:, :] - board[:-2, :]) / 2.0
    steepest = float(np.percentile(np.concatenate([across.ravel(), down.ravel()]), 99.7))
    result.measure(
        "width of an edge in the picture", (bright - dark) / max(steepest, 1e-9), "px", most=WIDEST_EDGE,
        remedy=f"Turn the lens until it is smallest at {1e3 * eye.depth:.0f} mm, then lock the lens.",
    )  # fmt: skip


def _mounting(name: str, workplace: CommissionWorkplace, result: Result) -> None:
    eye = eye_of(workplace, name)
    axes, found = measure(workplace, result, eye)
    drawn = eye.config.flange_from_camera.se3()
    words, right = against_drawing(found.flange_from_camera, drawn, _carriage(workplace, name))
    angle = np.linalg.norm(pin.log3(drawn.rotation.T @ found.flange_from_camera.rotation))
    result.measure("board by the arm's measure over its name", axes.across, "")
    result.measure("depth by the arm's measure over the picture's", axes.along, "")
    result.measure("turned against the drawing", math.degrees(angle), "deg")
    way = drawn.rotation.T @ (found.flange_from_camera.translation - drawn.translation)
    for axis, off in zip("xyz", way, strict=True):
        result.measure(f"away from the drawing, along the camera's {axis}", 1e3 * float(off), "mm")
    result.measure(
        "views disagree about the board's place, RMS", 1e3 * found.residual, "mm", most=MOST_RESIDUAL[name],
        remedy="Tighten the camera and the board, and see that nothing moved meanwhile.",
    )  # fmt: skip
    if words:
        result.find(
            f"{name}.flange_from_camera", words, pose_words(drawn), pose_words(found.flange_from_camera),
            remedy="Have the configuration say so, or turn the camera as it is drawn.",
            write={f"{name}.flange_from_camera": pose_toml(right)},
        )  # fmt: skip
    _board(eye, result, axes.across, axes.along, found)


def _carriage(workplace: CommissionWorkplace, name: str) -> tuple[float, float]:
    """Between which ways along its x axis the camera may be from where it is drawn, m: at rail position 0."""
    if name != "scan_camera":
        return 0.0, 0.0
    state = workplace.devices.rail.state()
    low, high = workplace.config.rail.travel
    return (state.position, state.position) if state.homed_here else (min(low, 0.0), max(high, 0.0))


def _board(eye: Eye, result: Result, across: float, along: float, found: RoughMounting) -> None:
    """The board's pitch, the lens, and where the board lies."""
    if abs(along / across - 1.0) > FOCAL_OFF:
        focal = eye.config.focal_length * across / along
        result.find(
            f"{eye.name}.focal_length",
            "ways along the optical axis are seen longer or shorter than ways across it",
            f"{1e3 * eye.config.focal_length:.2f} mm", found=f"{1e3 * focal:.2f} mm",
            remedy="Read the focal length on the lens and the pixel's size in the camera's data sheet.",
            write={f"{eye.name}.focal_length": f'"{1e3 * focal:.1f} mm"'},
        )  # fmt: skip
        return
    if abs(across - 1.0) > PITCH_OFF:
        key, named = f"{eye.key}.board", renamed(eye.board, across)
        result.find(
            key, "the board has another pitch than its name says, by the ways of the arm",
            f"{1e3 * eye.board.pitch:g} mm", found=f"{1e3 * eye.board.pitch * across:.2f} mm",
            remedy="Measure from the first to the last point with a ruler, and name the board so.",
            write={key: f'"{named}"'} if named != eye.board.name else {},
        )  # fmt: skip
        return
    drawn = eye.plate.base_from_board.se3()
    off = found.base_from_board.translation - drawn.translation
    result.measure("board away from its drawn place", 1e3 * float(np.linalg.norm(off)), "mm")
    if np.linalg.norm(off) > MOST_MOVED:
        key = f"{eye.key}.base_from_board"
        result.find(
            key, "the board lies elsewhere on the deck", pose_words(drawn), found=pose_words(found.base_from_board),
            remedy="Put it where it is drawn, or have the configuration say where it is.",
            write={key: pose_toml(found.base_from_board)},
        )  # fmt: skip


def renamed(board: BoardSpec, times: float) -> str:
    """The name of a board that is so many times as large as its name says."""
    pitch = board.pitch * times
    half = round(pitch / 0.5e-3) * 0.5e-3
    pitch = half if abs(half / pitch - 1.0) < 0.02 else round(pitch / 0.05e-3) * 0.05e-3
    return replace(board, pitch=pitch, marker=board.marker * pitch / board.pitch).name


def pose_words(pose: pin.SE3) -> str:
    """A pose in mm and degrees, as the configuration has it."""
    at, turned = _numbers(pose)
    return f"({', '.join(f'{v:.4g}' for v in at)}) mm, ({', '.join(f'{v:.4g}' for v in turned)}) deg"


def pose_toml(pose: pin.SE3) -> str:
    """A pose as the configuration writes it."""
    at, turned = _numbers(pose)
    texts = [", ".join(f'"{v:g} {unit}"' for v in values) for values, unit in ((at, "mm"), (turned, "deg"))]
    return f"{{ translation = [{texts[0]}], rotation = [{texts[1]}] }}"


def _numbers(pose: pin.SE3) -> tuple[list[float], list[float]]:
    at = [round(1e3 * float(v), 1) + 0.0 for v in pose.translation]
    turned = [round(math.degrees(float(v)), 1) + 0.0 for v in pin.rpy.matrixToRpy(pose.rotation)]
    return at, turned


def _camera_check(name: str, other: tuple[str, ...]) -> list[CommissionCheck]:
    kind = name.removesuffix("_camera")
    plate = "calibration.fine" if kind == "scan" else "calibration.large"
    depth = "130" if kind == "scan" else "650"
    keys = (name, plate, "arm.model", "arm.vehicle_from_base", "rail.travel")[: 5 if kind == "scan" else 4]
    return [
        CommissionCheck(
            f"{kind}_picture", f"{name}: light, focus and board in the picture",
            "the arm, in planned ways, until the board is seen", far=f"to {depth} mm above the board on the deck",
            fast="15 deg/s, 150 mm/s", limit="board found; brightness, contrast and sharpness in their limits",
            keys=keys, needs=other, work=partial(_look, name),
        ),
        CommissionCheck(
            f"{kind}_mounting", f"{name}: its mounting, and the board's pitch, from shifted and turned views",
            "the flange by small steps before the board", "5 mm and 12 deg" if kind == "scan" else "30 mm and 12 deg",
            fast="15 deg/s, 150 mm/s", limit="within 8 deg and 20 mm of the drawing, board within 2.5 % of its name",
            keys=keys, needs=(f"{kind}_picture",), work=partial(_mounting, name),
        ),
    ]  # fmt: skip


CHECKS = [*_camera_check("target_camera", ("payload",)), *_camera_check("scan_camera", ("target_mounting",))]
