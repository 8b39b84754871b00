"""How one simulated cell is drawn: everything that a configuration and a job describe, before anything deviates.

A world is drawn around a `Drawing`: its true values are those described here and the level's tolerances. `STOCK` is the
cell of `nominal`. Poses are (4, 4), m, named `a_from_b`; frames as in `nominal`.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sim_backends.world import nominal

Pose = NDArray[np.float64]

TEXT_M, TEXT_RAD = 5e-6, 1e-9
"""A pose written in hundredths of a millimetre and in degrees is this near to the one that was meant, m and rad."""


Box = dict[str, list[Any]]
"""Something solid: "pose" of its middle, four rows of four, and the "size" of its edges, m."""


@dataclass(frozen=True, eq=False)
class CameraDrawing:
    """A camera: `size` (width, height) in px, `pixel`, `focal_length` and `focus` (the distance of its sharpest
    picture) in m, and where it is mounted; the scan camera with the carriage at the rail's position 0."""

    size: tuple[int, int]
    pixel: float
    focal_length: float
    focus: float
    mounting: Pose


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
    axes.
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


@dataclass(frozen=True, eq=False)
class Drawing:
    """A cell and its station."""

    cell: CellDrawing
    station: StationDrawing

    def with_surface(self, name: str) -> Drawing:
        """The same with the closed form `name` on the station."""
        return replace(self, station=replace(self.station, surface=name, mesh=""))

    def with_arm(self, model: str) -> Drawing:
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
        vehicle_from_base=nominal.VEHICLE_FROM_BASE,
        track=0.583,
        rail=RailDrawing(0.002, 200, (0.0, 0.100), (0.01, 0.09)),
        scan=CameraDrawing(
            nominal.SCAN_SIZE, nominal.PIXEL, nominal.FOCAL_LENGTH, nominal.SCAN_FOCUS, nominal.FLANGE_FROM_SCAN_CAMERA
        ),
        target=CameraDrawing(
            nominal.TARGET_SIZE, nominal.PIXEL, nominal.FOCAL_LENGTH, nominal.TARGET_FOCUS,
            nominal.FLANGE_FROM_TARGET_CAMERA,
        ),
        baseline=nominal.LASER_BASELINE,
        tan_theta=nominal.LASER_TAN_THETA,
        witness=nominal.FLANGE_FROM_WITNESS,
        laser_output=nominal.LASER_OUTPUT,
        claw_output=nominal.CLAW_OUTPUT,
        grip_input=nominal.GRIP_INPUT,
        fine_board="marked_dots:11x9:3mm",
        base_from_fine_board=nominal.BASE_FROM_FINE_BOARD,
        deck_board="marked_dots:9x7:20mm",
        base_from_deck_board=nominal.BASE_FROM_DECK_BOARD,
    ),
    StationDrawing(
        height=nominal.TABLE_HEIGHT,
        place_from_start=nominal.inverse(nominal.WORLD_FROM_PLACE) @ nominal.WORLD_FROM_VEHICLE_START,
        board="marked_dots:9x7:20mm",
        place_from_board=nominal.PLACE_FROM_BOARD,
        place_from_surface=np.eye(4),
        surface="pot",
        mesh="",
        mesh_unit="m",
        flange_from_part=nominal.FLANGE_FROM_PART,
        surface_from_part=np.eye(4),
        part_size=(0.070, 0.036, 0.020),
    ),
)  # fmt: skip
"""The cell that the shipped configuration and the job `pot` describe."""

Part = TypeVar("Part", Drawing, CellDrawing, StationDrawing, CameraDrawing, RailDrawing)


def settled(drawn: Part, stock: Part) -> Part:
    """`drawn` with the numbers of `stock` wherever both are the same as far as a text says it.

    So a cell whose file writes out the stock cell is the stock cell to the last bit.
    """
    return replace(drawn, **{f.name: _settled(getattr(drawn, f.name), getattr(stock, f.name)) for f in fields(drawn)})


def _settled(value: Any, stock: Any) -> Any:
    if is_dataclass(value):
        return settled(value, stock)
    if isinstance(value, np.ndarray) and stock is not None:
        same = np.abs(value - stock)
        return stock if same[:3, 3].max() < TEXT_M and same[:3, :3].max() < TEXT_RAD else value
    if isinstance(value, float) or (isinstance(value, tuple) and isinstance(value[0], float)):
        return stock if np.allclose(value, stock, rtol=1e-9, atol=1e-12) else value
    return value


def read(text: str) -> Drawing:
    """The drawing that `as_json` wrote. Raises ValueError when it is none."""
    try:
        data = json.loads(text)
        cell, station = data["cell"], data["station"]
        made: dict[str, Any] = {name: CameraDrawing(**_plain(cell.pop(name))) for name in ("scan", "target")}
        made["rail"] = RailDrawing(**_plain(cell.pop("rail")))
        return Drawing(CellDrawing(**made, **_plain(cell)), StationDrawing(**_plain(station)))
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"no drawing of a cell: {error}") from error


def _plain(data: dict[str, Any]) -> dict[str, Any]:
    """Lists of lists as poses, other lists as tuples."""

    def made(value: Any) -> Any:
        if not isinstance(value, list):
            return value
        return np.array(value) if isinstance(value[0], list) else tuple(value)

    return {name: made(value) for name, value in data.items()}
