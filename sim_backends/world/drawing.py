"""How one simulated cell is drawn: everything that a configuration and a job describe, before anything deviates.

A world is drawn around a `Drawing`: its true values are those described here and the level's tolerances. `STOCK` is the
cell of the shipped configuration, whose geometry is written out here. Poses are (4, 4), m, named `a_from_b`.

Frames: world W (z up, floor z = 0), vehicle V, arm base B, flange F (z out of the flange), scan camera C, target
camera T (z along the optical axis), part, surface S, place frame P, boards D (x right, y down, z into the board).
"""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Pose = NDArray[np.float64]


def pose(translation: Sequence[float], x_axis: Sequence[float], z_axis: Sequence[float]) -> Pose:
    """The (4, 4) transformation with this translation, m, and these (exact, orthonormal) x and z axes."""
    x, z = np.array(x_axis, dtype=float), np.array(z_axis, dtype=float)
    made = np.eye(4)
    made[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    made[:3, 3] = translation
    return made


def inverse(a_from_b: Pose) -> Pose:
    """`b_from_a` (4, 4) of a rigid transformation."""
    made = np.eye(4)
    made[:3, :3] = a_from_b[:3, :3].T
    made[:3, 3] = -made[:3, :3] @ a_from_b[:3, 3]
    return made


def board_pose(
    centre: Sequence[float], x_axis: Sequence[float], z_axis: Sequence[float], size: Sequence[float]
) -> Pose:
    """The pose of a board whose lattice of `size` (m) is centred at `centre`; its origin is the lattice's corner."""
    made = pose(centre, x_axis, z_axis)
    made[:3, 3] -= made[:3, 0] * size[0] / 2.0 + made[:3, 1] * size[1] / 2.0
    return made


LARGE_BOARD_SIZE = (0.160, 0.120)
"""From the first dot to the last of the station's board and of the deck's large board, m."""
_FINE_SIZE = (0.030, 0.024)
_C45 = math.sqrt(0.5)

TABLE_HEIGHT = 0.60
"""The table's top above the floor, m."""
TABLE_HALF = 0.25
"""The table reaches this far, m, along x and y around the surface's origin."""
WORLD_FROM_PLACE = pose((0.0, 0.0, TABLE_HEIGHT), (1, 0, 0), (0, 0, 1))
PLACE_FROM_BOARD = board_pose((0.10, 0.32, 0.12), (0, -1, 0), (_C45, 0, -_C45), LARGE_BOARD_SIZE)
WORLD_FROM_VEHICLE_START = pose((-3.05, 0.0, 0.0), (1, 0, 0), (0, 0, 1))
VEHICLE_FROM_BASE = pose((0.30, 0.0, 0.55), (1, 0, 0), (0, 0, 1))
BASE_FROM_FINE_BOARD = board_pose((-0.55, 0.25, 0.02), (1, 0, 0), (0, 0, -1), _FINE_SIZE)
BASE_FROM_DECK_BOARD = board_pose((-0.60, -0.25, 0.02), (1, 0, 0), (0, 0, -1), LARGE_BOARD_SIZE)

FLANGE_FROM_SCAN_CAMERA = pose((0.09, -0.05, 0.08), (0, 1, 0), (0, 0, 1))
"""The scan camera with the carriage at home."""
FLANGE_FROM_TARGET_CAMERA = pose((-0.10, 0.0, 0.03), (0, 1, 0), (0, 0, 1))
FLANGE_FROM_WITNESS = pose((0.09, -0.0625, 0.165), (0, 1, 0), (0, 0, 1))
"""A plate of `WITNESS_SIZE` on the claw: with the carriage at home the laser's line lies on it, beside the sweeps."""
WITNESS_SIZE = (0.013, 0.012)
FLANGE_FROM_PART = pose((0.0, 0.0, 0.17), (0, 1, 0), (0, 0, -1))
RAIL_DIRECTION = np.array([1.0, 0.0, 0.0])
"""The way the carriage moves, in C."""

F_NUMBER = 4.0
PIXEL = 4.8e-6
SCAN_SIZE = (640, 480)
SCAN_FOCUS = 0.130
TARGET_SIZE = (1280, 1024)
TARGET_FOCUS = 1.0
CAMERA_RATE = {"scan": 120.0, "target": 30.0}
"""Most pictures a second."""


TEXT_M, TEXT_RAD = 5e-6, 1e-9
"""A pose written in hundredths of a millimetre and in degrees is this near to the one that was meant, m and rad."""


Box = dict[str, list[object]]
"""Something solid: "pose" of its middle, four rows of four, and the "size" of its edges, m."""


@dataclass(frozen=True, eq=False)
class CameraDrawing:
    """A camera: `size` (width, height) in px, `pixel`, `focal_length` and `focus` (the distance of its sharpest
    picture) in m, and where it is mounted; the scan camera with the carriage at the rail's position 0.

    `filter`: centre and width, m, and transmission of a band-pass before the lens."""

    size: tuple[int, int]
    pixel: float
    focal_length: float
    focus: float
    mounting: Pose
    filter: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class RailDrawing:
    """The rail: `lead` in m per turn, full `steps_per_turn`, usable `travel` in m, and where in it the carriage may
    stand when the rail is switched on. One that is `reversed` has a coil of its motor connected the other way round."""

    lead: float
    steps_per_turn: int
    travel: tuple[float, float]
    start: tuple[float, float]
    reversed: bool = False


@dataclass(frozen=True, eq=False)
class CellDrawing:
    """What a cell's configuration describes.

    `baseline` (m) and `tan_theta` are the laser's in the scan camera's frame; `witness` is flange_from_witness of the
    plate on the claw, or None without one. `payload` in kg with its centre of gravity in m on the flange, `track` in m
    as the vehicle turns. Boards are named as in `sim_backends.optics.scene.Board.parse`. Outputs and `grip_input` are
    numbers of the arm's connectors, None where laser or claw hang on something else; `wires` says by device ("rail",
    "laser", "claw") what that is, as its peer takes it, or what else than TMCL the rail speaks; "vehicle": what else
    than AgileX v2 it speaks, or that there is none.
    """

    arm: str
    payload: float
    payload_centre: tuple[float, float, float]
    vehicle_from_base: Pose
    track: float
    rail: RailDrawing
    scan: CameraDrawing
    target: CameraDrawing
    baseline: float
    tan_theta: float
    witness: Pose | None
    laser_output: int | None
    claw_output: int | None
    grip_input: int | None
    fine_board: str
    base_from_fine_board: Pose
    deck_board: str
    base_from_deck_board: Pose
    wires: dict[str, dict[str, Any]] = field(default_factory=dict)
    obstacles: dict[str, Box] = field(default_factory=dict)
    """On the vehicle, in the arm's base."""

    @property
    def fixed(self) -> bool:
        """Whether the arm stands on a frame that is bolted down, with no vehicle below it."""
        return bool(self.wires.get("vehicle", {}).get("make") == "fixed")


@dataclass(frozen=True, eq=False)
class StationDrawing:
    """What a job describes: the station, and the part in the claw.

    The place frame lies `height` m above the floor. `mesh` is the file of the surface, in `mesh_unit` "m" or "mm", or
    "" for the closed form `surface`, a name of `sim_backends.world.bodies.surfaces`. `part_size` (3,) in m, along its
    axes. `part_mesh` is the file of the part, in the part frame; "" for a part that fits the surface exactly.
    """

    height: float
    place_from_start: Pose
    board: str
    place_from_board: Pose
    place_from_surface: Pose
    surface: str
    mesh: str
    mesh_unit: str
    flange_from_part: Pose
    surface_from_part: Pose
    part_size: tuple[float, float, float]
    obstacles: dict[str, Box] = field(default_factory=dict)
    """In the place frame."""
    part_mesh: str = ""
    part_mesh_unit: str = "m"
    nest: Pose | None = None
    """base_from_part in a nest on the vehicle: the part lies on the surface at first, and the claw is empty."""
    nest_filled: bool = False
    """The part lies in the nest at first."""
    beside: "tuple[StationDrawing, ...]" = ()
    """Of a job with several items the station of each, this one's as well, none of which has another beside it."""
    stop: str = ""
    """Of a job with several stations the name of this one."""
    place_from_stop: Pose | None = None
    """Where its place frame lies in that of the job's first station; None for that."""
    waviness: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Amplitude and wavelength, m, and direction from the surface's x, rad, of a sine that the job's mesh has not."""

    def as_json(self) -> str:
        """By which stations are told apart, to the last bit."""
        return json.dumps(asdict(self), default=np.ndarray.tolist)


@dataclass(frozen=True, eq=False)
class Drawing:
    """A cell and its station."""

    cell: CellDrawing
    station: StationDrawing

    def with_surface(self, name: str) -> "Drawing":
        """The same with the closed form `name` on the station."""
        return replace(self, station=replace(self.station, surface=name, mesh=""))

    def with_arm(self, model: str) -> "Drawing":
        """The same with another arm."""
        return replace(self, cell=replace(self.cell, arm=model))

    def as_json(self) -> str:
        """For `read`, to the last bit."""
        return json.dumps(asdict(self), default=np.ndarray.tolist)


STOCK = Drawing(
    CellDrawing(
        arm="UR10e",
        payload=2.1,
        payload_centre=(0.0, 0.0, 0.06),
        vehicle_from_base=VEHICLE_FROM_BASE,
        track=0.583,
        rail=RailDrawing(0.002, 200, (0.0, 0.100), (0.01, 0.09)),
        scan=CameraDrawing(
            SCAN_SIZE, PIXEL, 0.008, SCAN_FOCUS, FLANGE_FROM_SCAN_CAMERA
        ),
        target=CameraDrawing(
            TARGET_SIZE, PIXEL, 0.008, TARGET_FOCUS,
            FLANGE_FROM_TARGET_CAMERA,
        ),
        baseline=0.035,
        tan_theta=3.5,
        witness=FLANGE_FROM_WITNESS,
        laser_output=0,
        claw_output=1,
        grip_input=0,
        fine_board="marked_dots:11x9:3mm",
        base_from_fine_board=BASE_FROM_FINE_BOARD,
        deck_board="marked_dots:9x7:20mm",
        base_from_deck_board=BASE_FROM_DECK_BOARD,
    ),
    StationDrawing(
        height=TABLE_HEIGHT,
        place_from_start=inverse(WORLD_FROM_PLACE) @ WORLD_FROM_VEHICLE_START,
        board="marked_dots:9x7:20mm",
        place_from_board=PLACE_FROM_BOARD,
        place_from_surface=np.eye(4),
        surface="pot",
        mesh="",
        mesh_unit="m",
        flange_from_part=FLANGE_FROM_PART,
        surface_from_part=np.eye(4),
        part_size=(0.070, 0.036, 0.020),
    ),
)  # fmt: skip
"""The cell that the shipped configuration and the job `pot` describe."""

Part = TypeVar("Part", bound=Drawing | CellDrawing | StationDrawing | CameraDrawing | RailDrawing)


def settled(drawn: Part, stock: Part) -> Part:
    """`drawn` with the numbers of `stock` wherever both are the same as far as a text says it. So a cell whose file
    writes out the stock cell is the stock cell to the last bit."""
    return replace(drawn, **{f.name: _settled(getattr(drawn, f.name), getattr(stock, f.name)) for f in fields(drawn)})


def _settled(value: Any, stock: Any) -> Any:
    if stock is None:
        return value
    if is_dataclass(value):
        return settled(value, stock)
    if isinstance(value, np.ndarray):
        same = np.abs(value - stock)
        return stock if same[:3, 3].max() < TEXT_M and same[:3, :3].max() < TEXT_RAD else value
    if isinstance(value, float) or (isinstance(value, tuple) and value and isinstance(value[0], float)):
        return stock if np.allclose(value, stock, rtol=1e-9, atol=1e-12) else value
    return value


def read(text: str) -> Drawing:
    """The drawing that `as_json` wrote. Raises ValueError when it is none."""
    try:
        data = json.loads(text)
        cell, station = data["cell"], data["station"]
        made: dict[str, Any] = {name: CameraDrawing(**_plain(cell.pop(name))) for name in ("scan", "target")}
        made["rail"] = RailDrawing(**_plain(cell.pop("rail")))
        beside = tuple(StationDrawing(**_plain(each)) for each in station.pop("beside", ()))
        return Drawing(CellDrawing(**made, **_plain(cell)), StationDrawing(**_plain(station), beside=beside))
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"no drawing of a cell: {error}") from error


def _plain(data: dict[str, Any]) -> dict[str, Any]:
    """Lists of lists as poses, other lists as tuples."""

    def made(value: Any) -> Any:
        if not isinstance(value, list):
            return value
        return np.array(value) if value and isinstance(value[0], list) else tuple(value)

    return {name: made(value) for name, value in data.items()}
