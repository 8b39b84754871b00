"""What a check works at: the open cell, the person beside it, slow moves, and where pictures go.

The cell is opened anew when its configuration was changed. Nothing of one check is needed by the next but what stands
in the configuration, and where a camera was seen to see its board last.

Bringing a camera over its board on the deck when nobody knows for sure how it is mounted, and seeing it there."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from cell.apps.commission.check import Result
from cell.apps.commission.person import Person
from cell.config.calibrations.store import nominal_camera
from cell.config.cell_config import CameraConfig, PlateConfig, load_config
from cell.config.job import Job, load_job
from cell.devices.devices import Devices
from cell.devices.simulated.process import cause_fault, make_ready
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.poses import from_parts, from_ur
from cell.measure.vision import BoardSpec, BoardView, board_pose, find_board, parse_board
from cell.measure.vision.board.view import centre_of
from cell.motion.kinematics import HOME, Joints
from cell.procedures.arm.moves import Mover
from cell.run.recorded_work import Hands
from drivers.errors import CellError, DeviceFault, RefusedError
from drivers.interfaces import Camera, Frame, Image
from statemachine.step import Observer

if TYPE_CHECKING:
    from cell.config.cell_config import CellConfig
    from cell.run.session.supervisor import Cell


SLOW_JOINT = math.radians(15.0)
"""Of the leading joint in free moves, rad/s."""
SLOW_TOOL = 0.15
"""Of any point of tool and part in free moves, m/s."""
WIDEST_PICTURE = 640


class SlowMover(Mover):
    """Moves that are planned anew, once, after a fault that a program may clear by itself, such as a lost program."""

    def to(self, base_from_flange: pin.SE3, what: str) -> None:
        """See `Mover.to`."""
        self._again(lambda: Mover.to(self, base_from_flange, what))

    def to_joints(self, joints: Joints) -> None:
        """See `Mover.to_joints`."""
        self._again(lambda: Mover.to_joints(self, joints))

    def _again(self, move: Callable[[], None]) -> None:
        try:
            move()
        except DeviceFault as fault:
            if fault.device != self._arm.name or not fault.recoverable:
                raise
            # A protective stop is refused here: a person has to look first.
            self._arm.recover()
            move()


class Declined(Exception):
    """A person did not want this check to go on."""


@dataclass
class CommissionWorkplace:
    """`path` is the configuration's file, `open_cell` connects the cell as it now says. `folder` takes pictures.

    `simulated`: all of its devices are, and their world can be told what to do.
    """

    path: Path
    open_cell: Callable[[], Cell]
    person: Person
    folder: Path
    job_file: str
    simulated: bool
    hands: Hands | None = None
    heard: Observer | None = None
    """Is told what goes on in a check, such as a question to a person."""
    last_views: dict[str, pin.SE3] = field(default_factory=dict)
    """base_from_flange at which each camera saw its board last."""
    _cell: Cell | None = None
    _config: CellConfig | None = None
    _confirmed: set[str] = field(default_factory=set)

    # --- the cell ---

    @property
    def cell(self) -> Cell:
        """The cell, opened if need be."""
        return self.connect()

    @property
    def config(self) -> CellConfig:
        """Its configuration as the file has it, read anew after `close`."""
        if self._config is None:
            self._config = load_config(self.path)
        return self._config

    @property
    def devices(self) -> Devices:
        """Its devices."""
        return self.cell.devices

    @property
    def job(self) -> Job:
        """The first job."""
        return load_job(self.job_file)[0]

    def connect(self) -> Cell:
        """Open the cell as the file now says, unless it is open."""
        if self._cell is None:
            self._cell = self.open_cell()
        return self._cell

    def close(self) -> None:
        """Let go of the cell; `cell` opens it again."""
        self._config = None
        if self._cell is not None:
            cell, self._cell = self._cell, None
            cell.close()

    def fill_claw(self) -> None:
        """At a simulated cell: what a person's hands do, who puts the job's part into the claw."""
        from cell.devices.simulated.described import Described

        described = Described.of(self.job_file)
        if self.cell.simulated is not None:
            self.cell.simulated.make_ready(described)
        elif self.cell.config.cell.truth:
            make_ready(self.cell.config.cell.truth, described.drawing(self.config).as_json())

    def cause(self, fault: str) -> None:
        """At a simulated cell: cause a fault by its name."""
        if self.cell.simulated is not None:
            self.cell.simulated.fault(fault)
        else:
            cause_fault(self.cell.config.cell.truth, fault)

    # --- the person ---

    def confirm(self, axis: str, moves: str, far: str, fast: str) -> None:
        """A person's word before the first motion of an axis in this session; raises `Declined`."""
        if axis in self._confirmed:
            return
        if not self.person.go_ahead(f"{axis} moves for the first time: {moves}, {far}, {fast}."):
            raise Declined(f"{axis} was not to move")
        self._confirmed.add(axis)

    # --- motion ---

    def look_around(self) -> None:
        """Raise when the work is to end; wait while it is paused."""
        if self.hands is not None:
            self.hands.safe_point()

    def mover(self) -> Mover:
        """Planned moves of the arm at the speed of somebody who stands beside it; the vehicle is braked first.

        The claw may hold the job's part: ways keep clear of it either way.
        """
        self.confirm(
            "the arm as a whole", "planned ways above the deck", "up to its whole reach",
            f"at most {math.degrees(SLOW_JOINT):.0f} deg/s and {1e3 * SLOW_TOOL:.0f} mm/s",
        )  # fmt: skip
        return self._mover()

    def _mover(self) -> Mover:
        config, devices = self.config, self.devices
        if not devices.vehicle.state().braked:
            devices.vehicle.recover()
        arm = config.arm
        slow = arm.model_copy(
            update={
                "max_joint_speed": min(arm.max_joint_speed, SLOW_JOINT),
                "max_tool_speed": min(arm.max_tool_speed, SLOW_TOOL),
            }
        )
        config = config.model_copy(update={"arm": slow})
        return SlowMover(devices.arm, devices.clock, config, self.job, self.look_around, interlocks=devices.interlocks)

    def fold(self) -> None:
        """The arm to its folded posture above the deck, unless it is there."""
        if np.abs(self.devices.arm.state().joints - HOME).max() > math.radians(1.0):
            self.mover().to_joints(HOME)

    def home_rail(self) -> None:
        """The rail's zero, if this program has not found it."""
        rail = self.devices.rail
        if not rail.state().homed_here:
            self.confirm("rail", "it searches its home switch", "its whole travel at most", "half its configured speed")
            rail.home().wait(120.0)

    # --- pictures ---

    def keep(self, result: Result, name: str, frame: Frame, marks: ArrayLike | None = None) -> None:
        """Keep a picture for the protocol, with points (n, 2) px marked in it, and the whole frame in the run."""
        if self.hands is not None:
            self.hands.keep(name, frame)
        pictures = self.folder / "pictures"
        pictures.mkdir(parents=True, exist_ok=True)
        path = pictures / f"{name}.png"
        cv2.imwrite(str(path), _shown(frame.image, marks))
        told = f"pictures/{path.name}"
        if told not in result.pictures:
            result.pictures.append(told)


def _shown(image: Image, marks: ArrayLike | None) -> cv2.typing.MatLike:
    picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    share = min(1.0, WIDEST_PICTURE / image.shape[1])
    small = cv2.resize(picture, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    for x, y in [] if marks is None else np.asarray(marks) * share:
        cv2.circle(small, (round(float(x)), round(float(y))), 2, (0, 200, 0), -1)
    return small


def told(error: CellError) -> str:
    """An error in one line."""
    return " ".join(str(error).split())


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


@dataclass(frozen=True, eq=False)
class SeenBoard:
    """A picture of the board: `base_from_flange` as the arm told it, `camera_from_board` with the board as named."""

    base_from_flange: pin.SE3
    camera_from_board: pin.SE3
    view: BoardView
    frame: Frame


def eye_of(desk: CommissionWorkplace, name: str) -> Eye:
    """The eye "scan_camera" or "target_camera" of the cell."""
    config = desk.config
    if name == "scan_camera":
        return Eye(name, config.scan_camera, config.calibration.fine, key="calibration.fine", depth=0.130, step=0.005)
    return Eye(name, config.target_camera, config.calibration.large, key="calibration.large", depth=0.650, step=0.030)


def camera_of(desk: CommissionWorkplace, eye: Eye) -> Camera:
    """Its device."""
    devices = desk.devices
    return devices.scan_camera if eye.name == "scan_camera" else devices.target_camera


def take(desk: CommissionWorkplace, eye: Eye) -> Frame:
    """A photograph at the configured exposure."""
    camera = camera_of(desk, eye)
    camera.configure(eye.config.photo_exposure, PHOTO_RATE)
    return camera.grab()


def see(desk: CommissionWorkplace, eye: Eye) -> SeenBoard:
    """The board from where the arm stands; `RefusedError` when it is not seen."""
    frame = take(desk, eye)
    try:
        view = find_board(frame.image, eye.board)
        pose = board_pose(view, eye.model)
    except RefusedError as refused:
        raise refused.showing(seen={"frame": frame}) from refused
    return SeenBoard(from_ur(desk.devices.arm.state().flange), pose.camera_from_board, view, frame)


def find_view(desk: CommissionWorkplace, result: Result, eye: Eye) -> SeenBoard:
    """Go where the camera sees its board: where it did last, where it is drawn to, or as if its bracket were turned.

    Where a part of something bright is in the picture, the camera goes on towards it. Raises `RefusedError` when the
    board is seen from nowhere.
    """
    mover = desk.mover()
    reason, tried = "", 0
    for what, goal, hand in _candidates(desk, eye):
        for _ in range(1 + CENTRINGS):
            desk.look_around()
            try:
                mover.to(goal, what)
            except DeviceFault:
                raise
            except CellError as error:
                reason = str(error)
                break
            tried += 1
            try:
                seen = see(desk, eye)
            except RefusedError as error:
                reason = str(error)
                frame = error.seen["frame"]
                assert isinstance(frame, Frame)
                if tried == 1:
                    desk.keep(result, f"{eye.name}-sees-no-board", frame)
                way = towards_bright(frame.image)
                if way is None:
                    break
                metres = np.array([*way, 0.0]) * eye.depth / eye.model.fx
                goal = goal * from_parts(hand.rotation @ metres)
                continue
            if tried > 1:
                result.notes.append(f"the board was seen from the {tried}. place that was tried: {what}")
            seen, goal = _nearer_the_middle(desk, eye, seen, goal, hand)
            desk.last_views[eye.name] = goal
            return seen
    raise RefusedError(
        f"{eye.name} saw the board {eye.plate.board} from none of {tried} places. See that the lens cap is off, the "
        f"light on, the lens in focus at {1e3 * eye.depth:.0f} mm, that the board on the deck is the one of "
        f"{eye.key}.board, and that {eye.key}.base_from_board is where it is. Last: {reason}"
    )


def _nearer_the_middle(
    desk: CommissionWorkplace, eye: Eye, seen: SeenBoard, goal: pin.SE3, hand: pin.SE3
) -> tuple[SeenBoard, pin.SE3]:
    """The view with the board nearer to the picture's middle, if the camera sits as `hand` has it; else as it is."""
    way = _off_middle(seen)
    if np.linalg.norm(way) < CENTRED_SHARE * eye.config.width:
        return seen, goal
    nearer = goal * from_parts(hand.rotation @ (np.array([*way, 0.0]) * eye.depth / eye.model.fx))
    try:
        desk.mover().to(nearer, f"{eye.name} with its board nearer to the middle")
        moved = see(desk, eye)
    except DeviceFault:
        raise
    except CellError:
        moved = None
    if moved is not None and np.linalg.norm(_off_middle(moved)) < np.linalg.norm(way):
        return moved, nearer
    desk.mover().to(goal, "back to where the board was seen")
    return see(desk, eye), goal


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


def _candidates(desk: CommissionWorkplace, eye: Eye) -> Iterator[tuple[str, pin.SE3, pin.SE3]]:
    """Places of the flange to try, with words for each, and flange_from_camera as it would be then."""
    drawn = eye.config.flange_from_camera.se3()
    if eye.name in desk.last_views:
        yield "where it was seen last", desk.last_views[eye.name], drawn
    tilted = from_parts(np.zeros(3), pin.exp3(np.array([TILT, 0.0, 0.0])))
    centre = eye.plate.base_from_board.se3() * from_parts(centre_of(eye.board))
    looking = centre * tilted * from_parts((0.0, 0.0, -eye.depth))
    rails = _rail_places(desk, eye)
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


def _rail_places(desk: CommissionWorkplace, eye: Eye) -> list[float]:
    """Where the carriage may stand, m, the middle first."""
    if eye.name != "scan_camera":
        return [0.0]
    state = desk.devices.rail.state()
    if state.homed_here:
        return [state.position]
    low, high = desk.config.rail.travel
    count = max(1, math.ceil((high - low) / RAIL_STEP))
    places = [low + (k + 0.5) * (high - low) / count for k in range(count)]
    return sorted(places, key=lambda place: abs(place - 0.5 * (low + high)))


def centred_view(desk: CommissionWorkplace, result: Result, eye: Eye) -> SeenBoard:
    """As `find_view`, with the middle of the board in the middle of the picture, at the eye's depth.

    For a camera whose axes lie as they are drawn.
    """
    seen = find_view(desk, result, eye)
    at = seen.camera_from_board
    middle = at.rotation @ centre_of(eye.board) + at.translation
    hand = eye.config.flange_from_camera.se3()
    shift = from_parts(hand.rotation @ (middle - np.array([0.0, 0.0, eye.depth])))
    goal = seen.base_from_flange * shift
    desk.mover().to(goal, f"{eye.name} above the middle of its board")
    desk.last_views[eye.name] = goal
    return see(desk, eye)
