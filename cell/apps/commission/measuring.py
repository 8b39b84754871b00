"""How a camera sits on the flange and how large its board on the deck is, from a few views.

First the camera is brought over its board, though nobody knows for sure how it is mounted. Then the flange is shifted,
and turned about the board, by a few millimetres and degrees.

The arm is the measure of length. Shifts of the flange by known ways show how the camera's axes lie on it, and how long
the board's picture takes these ways to be: a wrong pitch makes all ways wrong alike, a wrong focal length only those
along the optical axis. Turns of the flange then show where the camera sits. No drawn value is believed here."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from cell.apps.commission.check import Result
from cell.apps.commission.workplace import CommissionWorkplace
from cell.config.calibrations.store import nominal_camera
from cell.config.cell_config import CameraConfig, PlateConfig
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.poses import from_parts, from_ur, mean
from cell.measure.vision.board.board import board_pose, find_board
from cell.measure.vision.board.view import BoardSpec, BoardView, centre_of, parse_board
from drivers.errors import CellError, DeviceFault, RefusedError
from drivers.interfaces import Camera, Frame, Image

TILT = math.radians(15.0)
"""Of the board against the picture: a board that is seen square tells its own tilt badly."""
RAIL_STEP = 0.015
"""How far apart the places are, m, at which a rail that is not homed is thought to stand."""
PHOTO_RATE = 10.0
CENTRED_SHARE = 0.03
"""How far off its middle, in shares of the picture's width, the board may be."""
CENTRINGS = 3
"""How often the camera goes on towards what is bright in its picture."""
LEAST_CONTRAST, LEAST_WAY_SHARE = 25.0, 0.03
"""By how many DN something has to stand out, and by which share of the picture's width off its middle, to go there."""


@dataclass(frozen=True, eq=False)
class Eye:
    """A camera with the board on the deck that it calibrates by; `depth` (m) is how far off it looks, `step` (m) how
    far the flange is shifted at first."""

    name: str
    config: CameraConfig
    plate: PlateConfig
    key: str
    depth: float
    step: float

    @property
    def board(self) -> BoardSpec:
        """The board as its name in the configuration says it is."""
        return parse_board(self.plate.board)

    @property
    def model(self) -> CameraModel:
        """The camera as the configuration draws it."""
        return nominal_camera(self.config)


class SeenBoard(NamedTuple):
    """A picture of the board: `base_from_flange` as the arm told it, `camera_from_board` with the board as named."""

    base_from_flange: pin.SE3
    camera_from_board: pin.SE3
    view: BoardView
    frame: Frame


def eye_of(workplace: CommissionWorkplace, name: str) -> Eye:
    """The eye "scan_camera" or "target_camera" of the cell."""
    config = workplace.config
    if name == "scan_camera":
        return Eye(name, config.scan_camera, config.calibration.fine, key="calibration.fine", depth=0.130, step=0.005)
    return Eye(name, config.target_camera, config.calibration.large, key="calibration.large", depth=0.650, step=0.030)


def camera_of(workplace: CommissionWorkplace, eye: Eye) -> Camera:
    """Its device."""
    devices = workplace.devices
    return devices.scan_camera if eye.name == "scan_camera" else devices.target_camera


def see(workplace: CommissionWorkplace, eye: Eye, board: BoardSpec | None = None) -> SeenBoard:
    """The eye's board, or another one, from where the arm stands; `RefusedError` when it is not seen."""
    camera = camera_of(workplace, eye)
    camera.configure(eye.config.photo_exposure, PHOTO_RATE)
    frame = camera.grab()
    try:
        view = find_board(frame.image, board or eye.board)
        pose = board_pose(view, eye.model)
    except RefusedError as refused:
        raise refused.showing(seen={"frame": frame}) from refused
    return SeenBoard(from_ur(workplace.devices.arm.state().flange), pose.camera_from_board, view, frame)


def find_view(workplace: CommissionWorkplace, result: Result, eye: Eye) -> SeenBoard:
    """Go where the camera sees its board: where it did last, where it is drawn to, or as if its bracket were turned.

    Where a part of something bright is in the picture, the camera goes on towards it. Raises `RefusedError` when the
    board is seen from nowhere.
    """
    mover = workplace.mover()
    reason, tried = "", 0
    for what, goal, hand in _candidates(workplace, eye):
        for _ in range(1 + CENTRINGS):
            workplace.look_around()
            try:
                mover.to(goal, what)
            except DeviceFault:
                raise
            except CellError as error:
                reason = str(error)
                break
            tried += 1
            try:
                seen = see(workplace, eye)
            except RefusedError as error:
                reason = str(error)
                frame = error.seen["frame"]
                assert isinstance(frame, Frame)
                if tried == 1:
                    workplace.keep(result, f"{eye.name}-sees-no-board", frame)
                way = towards_bright(frame.image)
                if way is None:
                    break
                metres = np.array([*way, 0.0]) * eye.depth / eye.model.fx
                goal = goal * from_parts(hand.rotation @ metres)
                continue
            if tried > 1:
                result.notes.append(f"the board was seen from the {tried}. place that was tried: {what}")
            seen, goal = _nearer_the_middle(workplace, eye, seen, goal, hand)
            workplace.last_views[eye.name] = goal
            return seen
    raise RefusedError(
        f"{eye.name} saw the board {eye.plate.board} from none of {tried} places. See that the lens cap is off, the "
        f"light on, the lens in focus at {1e3 * eye.depth:.0f} mm, that the board on the deck is the one of "
        f"{eye.key}.board, and that {eye.key}.base_from_board is where it is. Last: {reason}"
    )


def _nearer_the_middle(
    workplace: CommissionWorkplace, eye: Eye, seen: SeenBoard, goal: pin.SE3, hand: pin.SE3
) -> tuple[SeenBoard, pin.SE3]:
    """The view with the board nearer to the picture's middle, if the camera sits as `hand` has it; else as it is."""
    way = _off_middle(seen)
    if np.linalg.norm(way) < CENTRED_SHARE * eye.config.width:
        return seen, goal
    nearer = goal * from_parts(hand.rotation @ (np.array([*way, 0.0]) * eye.depth / eye.model.fx))
    try:
        workplace.mover().to(nearer, f"{eye.name} with its board nearer to the middle")
        moved = see(workplace, eye)
    except DeviceFault:
        raise
    except CellError:
        moved = None
    if moved is not None and np.linalg.norm(_off_middle(moved)) < np.linalg.norm(way):
        return moved, nearer
    workplace.mover().to(goal, "back to where the board was seen")
    return see(workplace, eye), goal


def _off_middle(seen: SeenBoard) -> Array:
    """From the picture's middle to that of the board's points, (2,) px."""
    width, height = seen.view.size
    low, high = seen.view.pixels.min(axis=0), seen.view.pixels.max(axis=0)
    return np.asarray(0.5 * (low + high) - 0.5 * np.array([width - 1, height - 1]))


def towards_bright(image: Image) -> Array | None:
    """From the picture's middle to that of what is bright in it, (2,) px; None when nothing stands out, or all does."""
    level, _ = cv2.threshold(cv2.GaussianBlur(image, (9, 9), 0), 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    bright = image > level
    share = float(bright.mean())
    if not 0.02 < share < 0.95 or float(image[bright].mean() - image[~bright].mean()) < LEAST_CONTRAST:
        return None
    # Dark dots belong to their bright board: the middle of its outline, not of its pixels.
    rows, columns = np.flatnonzero(bright.mean(axis=1) > 0.05), np.flatnonzero(bright.mean(axis=0) > 0.05)
    if not len(rows) or not len(columns):
        return None
    middle = 0.5 * np.array([columns[0] + columns[-1], rows[0] + rows[-1]])
    way = middle - 0.5 * np.array([image.shape[1] - 1, image.shape[0] - 1])
    return way if np.linalg.norm(way) > LEAST_WAY_SHARE * image.shape[1] else None


def _candidates(workplace: CommissionWorkplace, eye: Eye) -> Iterator[tuple[str, pin.SE3, pin.SE3]]:
    """Places of the flange to try, with words for each, and flange_from_camera as it would be then."""
    drawn = eye.config.flange_from_camera.se3()
    if eye.name in workplace.last_views:
        yield "where it was seen last", workplace.last_views[eye.name], drawn
    tilted = from_parts(np.zeros(3), pin.exp3(np.array([TILT, 0.0, 0.0])))
    centre = eye.plate.base_from_board.se3() * from_parts(centre_of(eye.board))
    looking = centre * tilted * from_parts((0.0, 0.0, -eye.depth))
    rails = _rail_places(workplace, eye)
    # A head that is turned in its place is carried another way; a camera without a rail looks the same way for it.
    for quarters in (0, 2, 1, 3) if eye.name == "scan_camera" else (0,):
        turn = _about_z(quarters)
        for rail in rails:
            hand = drawn * turn * from_parts((rail, 0.0, 0.0))
            yield _words("head", quarters, eye, rail), looking * turn * hand.inverse(), hand
    for quarters in (2, 1, 3):
        for rail in rails:
            hand = _about_z(quarters) * drawn * from_parts((rail, 0.0, 0.0))
            yield _words("bracket", quarters, eye, rail), looking * hand.inverse(), hand


def _about_z(quarters: int) -> pin.SE3:
    return from_parts(np.zeros(3), pin.exp3(np.array([0.0, 0.0, 0.5 * math.pi * quarters])))


def _words(what: str, quarters: int, eye: Eye, rail: float) -> str:
    words = "as drawn" if quarters == 0 else f"{what} turned by {90 * quarters} deg"
    return f"{words}, rail near {1e3 * rail:.0f} mm" if eye.name == "scan_camera" else words


def _rail_places(workplace: CommissionWorkplace, eye: Eye) -> list[float]:
    """Where the carriage may stand, m, the middle first."""
    if eye.name != "scan_camera":
        return [0.0]
    state = workplace.devices.rail.state()
    if state.homed_here:
        return [state.position]
    low, high = workplace.config.rail.travel
    count = max(1, math.ceil((high - low) / RAIL_STEP))
    places = [low + (k + 0.5) * (high - low) / count for k in range(count)]
    return sorted(places, key=lambda place: abs(place - 0.5 * (low + high)))


def centred_view(workplace: CommissionWorkplace, result: Result, eye: Eye) -> SeenBoard:
    """As `find_view`, with the middle of the board in the middle of the picture, at the eye's depth. For a camera whose
    axes lie as they are drawn."""
    seen = find_view(workplace, result, eye)
    at = seen.camera_from_board
    middle = at.rotation @ centre_of(eye.board) + at.translation
    hand = eye.config.flange_from_camera.se3()
    shift = from_parts(hand.rotation @ (middle - np.array([0.0, 0.0, eye.depth])))
    goal = seen.base_from_flange * shift
    workplace.mover().to(goal, f"{eye.name} above the middle of its board")
    workplace.last_views[eye.name] = goal
    return see(workplace, eye)


# --- mounting and scale, by geometry ---

LEAST_SHIFT_SHARE = 0.2
"""The shortest of three directions in which the flange was shifted, in shares of the longest."""
SNAP_RAD, SNAP_M = math.radians(8.0), 0.020
"""A mounting that is this near to a drawn one is that one: rough views tell no more, and calibration does."""


class Axes(NamedTuple):
    """How the camera's axes lie on the flange, `flange_from_camera` (3, 3), and the true length of a millimetre as the
    pictures have it: `across` and `along` the optical axis."""

    flange_from_camera: Array
    across: float
    along: float


class RoughMounting(NamedTuple):
    """A camera on the flange and the board before it; `residual` (m, RMS) is how far apart the views put the board."""

    flange_from_camera: pin.SE3
    base_from_board: pin.SE3
    residual: float


def axes_from_shifts(flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3]) -> Axes:
    """From views with the flange's pose in the base, its orientation the same, and the board's pose in the camera.

    A shift d of the flange shifts the board by −Rᵀ d / scale in the camera. Raises `RefusedError` when the shifts do
    not go three ways.
    """
    turn = flanges[0].rotation.T
    moved = np.array([turn @ (f.translation - flanges[0].translation) for f in flanges[1:]])
    seen = np.array([b.translation - boards[0].translation for b in boards[1:]])
    sizes = np.linalg.svd(moved, compute_uv=False) if len(moved) else np.zeros(3)
    if len(sizes) < 3 or sizes[2] < LEAST_SHIFT_SHARE * sizes[0]:
        raise RefusedError(
            f"{len(flanges)} views do not show shifts along three axes: the board was lost from the picture. Give it "
            "more light, or put it where the camera sees it from further off"
        )
    camera_from_flange = -np.linalg.lstsq(moved, seen, rcond=None)[0].T
    lengths = np.linalg.norm(camera_from_flange, axis=1)
    u, _, vt = np.linalg.svd(camera_from_flange / lengths[:, None])
    if np.linalg.det(u @ vt) < 0:
        raise RefusedError(
            "the pictures are mirrored: shifts of the flange show the board going the other way along one axis only. "
            "Switch the camera's mirroring off (ReverseX, ReverseY), and see that no mirror is in its way"
        )
    return Axes((u @ vt).T, float(2.0 / (lengths[0] + lengths[1])), float(1.0 / lengths[2]))


def solve_mounting(
    flanges: Sequence[pin.SE3], boards: Sequence[pin.SE3], rotation: Array, scale: float
) -> RoughMounting:
    """Where a camera sits whose axes lie as `rotation` (3, 3), from views with turns of a few degrees about two axes.
    One linear system for the camera's place on the flange and the board's in the base, `scale` being known."""
    rows = np.concatenate([np.column_stack([f.rotation, -np.eye(3)]) for f in flanges])
    told = [
        -f.translation - scale * f.rotation @ rotation @ b.translation for f, b in zip(flanges, boards, strict=True)
    ]
    found, *_ = np.linalg.lstsq(rows, np.concatenate(told), rcond=None)
    residual = (rows @ found - np.concatenate(told)).reshape(-1, 3)
    hand = from_parts(found[:3], rotation)
    placed = [
        flange * hand * from_parts(scale * board.translation, board.rotation)
        for flange, board in zip(flanges, boards, strict=True)
    ]
    return RoughMounting(hand, mean(placed), float(np.sqrt((residual**2).sum(axis=1).mean())))


def against_drawing(found: pin.SE3, drawn: pin.SE3, carriage: tuple[float, float] = (0.0, 0.0)) -> tuple[str, pin.SE3]:
    """What of a drawn flange_from_camera is not so, in words, and the pose that would be right, by a measured one.

    Without words it is as drawn; else it is turned by right angles, or elsewhere.

    Where right angles explain it, the drawn numbers are kept and only turned. The camera may have been carried along
    its own x axis, by a way (m) within `carriage`, from where it is drawn: a rail that nobody has homed yet.
    """
    apart = float(np.linalg.norm(pin.log3(drawn.rotation.T @ found.rotation)))
    if _near(found, drawn, carriage):
        return "", drawn
    if apart < SNAP_RAD:
        away = _away(found, drawn, carriage)
        words = f"it sits {1e3 * np.linalg.norm(away):.0f} mm from where it is drawn"
        return words, from_parts(drawn.translation + away, drawn.rotation)
    # The camera turned in its place; then the whole bracket, on other holes of the flange.
    for turn in _right_angles():
        here = from_parts(drawn.translation, drawn.rotation @ turn)
        if _near(found, here, carriage):
            return _in_words(turn), here
    for quarters in (1, 2, 3):
        bracket = _about_z(quarters) * drawn
        if _near(found, bracket, carriage):
            return f"its mounting is turned by {_signed(quarters)} deg about the flange's axis", bracket
    return f"it is turned by {math.degrees(apart):.0f} deg against the drawing", found


def _near(found: pin.SE3, other: pin.SE3, carriage: tuple[float, float]) -> bool:
    turned = np.linalg.norm(pin.log3(other.rotation.T @ found.rotation))
    return bool(turned < SNAP_RAD and np.linalg.norm(_away(found, other, carriage)) < SNAP_M)


def _away(found: pin.SE3, other: pin.SE3, carriage: tuple[float, float]) -> Array:
    """How far (3,), in the flange, the camera is from `other` when the carriage stands where that is least."""
    way = found.translation - other.translation
    ridden = min(max(float(way @ other.rotation[:, 0]), carriage[0]), carriage[1])
    return np.asarray(way - ridden * other.rotation[:, 0])


def _right_angles() -> list[Array]:
    """The 23 turns by right angles, those about the optical axis first."""
    turns = np.round(Rotation.create_group("O").as_matrix()) + 0.0
    return sorted((turn for turn in turns if not np.array_equal(turn, np.eye(3))), key=lambda turn: -turn[2, 2])


def _in_words(turn: Array) -> str:
    if turn[2, 2] > 0.5:
        quarters = round(math.atan2(turn[1, 0], turn[0, 0]) / (0.5 * math.pi)) % 4
        if quarters == 2:
            return "the camera is upside down: turned by 180 deg about its optical axis"
        return f"its mounting is turned by {_signed(quarters)} deg about the optical axis"
    axis = np.asarray(pin.log3(turn))
    return (
        f"its mounting is turned by {math.degrees(np.linalg.norm(axis)):.0f} deg about "
        f"({', '.join(f'{v:.2f}' for v in axis / np.linalg.norm(axis))}) of the camera's axes"
    )


def _signed(quarters: int) -> int:
    return {1: 90, 2: 180, 3: -90}[quarters]


# --- shifts, then turns ---

SMALL_TURN, TURN = math.radians(5.0), math.radians(12.0)
LEAST_TURNED = 4
"""Views with turns that a mounting is solved from, besides those with shifts."""


def measure(workplace: CommissionWorkplace, result: Result, eye: Eye) -> tuple[Axes, RoughMounting]:
    """How the camera's axes lie on the flange, then where it sits, and how large the board is by the arm's measure.
    Raises `RefusedError` when the board is lost, or the views do not agree on one mounting."""
    first = find_view(workplace, result, eye)
    workplace.keep(result, f"{eye.name}-board", first.frame, first.view.pixels)
    shifted = shifted_views(workplace, eye, first.base_from_flange, eye.step)
    seen = [first, *shifted]
    axes = axes_from_shifts(*poses_of(seen))
    # Nothing is known yet of where the camera sits: small turns first, then larger ones about the board.
    hand = from_parts(eye.config.flange_from_camera.se3().translation, axes.flange_from_camera)
    for turn in (SMALL_TURN, TURN):
        seen += views_from(workplace, eye, _turned(eye, first, hand, axes.across, turn))
        found = solve_mounting(*poses_of(seen), axes.flange_from_camera, axes.across)
        hand = found.flange_from_camera
    if len(seen) < 1 + len(shifted) + LEAST_TURNED:
        raise RefusedError(
            f"only {len(seen) - 1 - len(shifted)} of 12 turned views show the board, at least {LEAST_TURNED} are "
            "needed: see that light and lens let the camera see it from the side as well"
        )
    workplace.last_views[eye.name] = first.base_from_flange
    return axes, found


def shifted_views(
    workplace: CommissionWorkplace, eye: Eye, first: pin.SE3, step: float, board: BoardSpec | None = None
) -> list[SeenBoard]:
    """Views of the board with the flange shifted from `first` by `step` m each way along its axes."""
    shifts = [from_parts(sign * step * np.eye(3)[axis]) for axis in (0, 1, 2) for sign in (1.0, -1.0)]
    return views_from(workplace, eye, [first * shift for shift in shifts], board)


def views_from(
    workplace: CommissionWorkplace, eye: Eye, goals: Iterable[pin.SE3], board: BoardSpec | None = None
) -> list[SeenBoard]:
    """What is seen from these places; those that cannot be reached, or do not show the board, are left out."""
    mover = workplace.mover()
    made = []
    for goal in goals:
        workplace.look_around()
        try:
            mover.to(goal, f"{eye.name} before its board")
            made.append(see(workplace, eye, board))
        except DeviceFault:
            raise
        except CellError:
            continue
    return made


def poses_of(seen: Sequence[SeenBoard]) -> tuple[list[pin.SE3], list[pin.SE3]]:
    """base_from_flange and camera_from_board of each view."""
    return [one.base_from_flange for one in seen], [one.camera_from_board for one in seen]


def _turned(eye: Eye, first: SeenBoard, hand: pin.SE3, scale: float, turn: float) -> list[pin.SE3]:
    """base_from_flange that look at the middle of the board from the first view, turned about each of its axes. `hand`
    is flange_from_camera as far as it is known, `scale` the board's."""
    at = first.camera_from_board
    centre = at.rotation @ centre_of(eye.board) * scale + scale * at.translation
    depth = float(np.linalg.norm(centre))
    middle = first.base_from_flange * hand * from_parts(centre)
    turns = [pin.exp3(sign * turn * np.eye(3)[axis]) for axis in range(3) for sign in (1.0, -1.0)]
    back = from_parts((0.0, 0.0, -depth))
    return [middle * from_parts(np.zeros(3), rotation) * back * hand.inverse() for rotation in turns]
