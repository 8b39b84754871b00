"""From a configuration and a job to the drawing of the cell that is simulated: that one and no other.

What cannot be simulated as it is described is refused here, before anything is started.
"""

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from cell.config.cell_config import CALIBRATION_DEPTHS, DEVICES, CellConfig
from cell.config.job import Job, load_job, shipped_mesh
from cell.measure.geometry.poses import from_parts, transform
from drivers.arm.make import ArmOutputClawConfig, ArmOutputLaserConfig
from drivers.errors import ConfigError
from drivers.make import CameraConfig, OnArm, Pose
from sim_backends.optics.scene import KINDS, Board
from sim_backends.world import drawing as drawn
from sim_backends.world.bodies.surfaces import surface
from sim_backends.world.drawing import CAMERA_RATE, SCAN_FOCUS, STOCK, TABLE_HALF, TARGET_FOCUS, Drawing

MOST_BLUR, MOST_STRIPE_BLUR_PX = 0.5, 16.0
"""Diameter of the blur disc at which a board's dots are still found, in diameters of a dot, and a stripe, in px."""
F_NUMBER = 4.0
"""Of both simulated lenses, which are focused where a stock cell's are: a configuration says nothing of either."""
TURNS_WIDER = 0.583 / 0.580
"""A vehicle on wheels that slide sideways turns as if its track were this much wider than drawn."""
PLATE_AT, PLATE_ASIDE = 0.656513, -0.0017857
"""Where the witness shows the line: at this share of half the picture's width before its middle; the plate's middle
lies so far (m) beside the line, along the camera's x axis."""


@dataclass(frozen=True)
class Described:
    """A job with the file of its mesh, to simulate a cell around."""

    job: Job
    mesh: Path

    @classmethod
    def of(cls, job: str | Path) -> Self:
        """The job of that file or name. Raises `ConfigError`."""
        return cls(*load_job(job))

    def drawing(self, config: CellConfig, simulated: Collection[str] = tuple(DEVICES)) -> Drawing:
        """The cell of the configuration with this job's station; the stock cell, to the last bit, where it is that.

        Raises `ConfigError`, with a line for each value, for what nothing simulates; real devices beside the
        `simulated` ones may be of any make.
        """
        problems = [*_makes(config, simulated), *_boards(config, self.job)]
        if not problems:
            problems = [*_cameras(config, self.job), *_outputs(config), *_table(self.job, self.mesh)]
        if problems:
            raise ConfigError(
                f"this cell cannot be simulated as it is described (job {self.job.job.name}):\n  "
                + "\n  ".join(problems)
            )
        drives, items = config.vehicle.DRIVES, range(1, len(self.job.item) + 1)
        beside = tuple(_station(self.job.of_item(k), self.mesh, drives) for k in items)
        station = replace(_station(self.job, self.mesh, drives), beside=beside)
        return drawn.settled(Drawing(_cell(config), station), STOCK)


def _cell(config: CellConfig) -> drawn.CellDrawing:
    arm, rail, laser, claw = config.arm, config.rail, config.laser, config.claw
    low, high = rail.travel
    margin = 0.1 * (high - low)
    # A real rail that does not say how it counts is followed: how it is driven does not show.
    steps, _ = rail.counted or (STOCK.cell.rail.steps_per_turn, 1)
    return drawn.CellDrawing(
        arm=arm.model, payload=arm.payload, payload_centre=arm.payload_centre,
        vehicle_from_base=_matrix(arm.vehicle_from_base.se3()),
        track=(TURNS_WIDER if config.vehicle.SLIDES else 1.0) * config.vehicle.track,
        rail=drawn.RailDrawing(rail.lead, steps, rail.travel, (low + margin, high - margin), rail.turned_round),
        scan=_camera(config.scan_camera, SCAN_FOCUS), target=_camera(config.target_camera, TARGET_FOCUS),
        baseline=laser.baseline, tan_theta=laser.tan_theta, witness=_witness(config),
        laser_output=laser.output if isinstance(laser, ArmOutputLaserConfig) else None,
        claw_output=claw.output if isinstance(claw, ArmOutputClawConfig) else None,
        grip_input=claw.feedback if isinstance(claw, ArmOutputClawConfig) else None,
        fine_board=config.calibration.fine.board,
        base_from_fine_board=_matrix(config.calibration.fine.base_from_board.se3()),
        deck_board=config.calibration.large.board,
        base_from_deck_board=_matrix(config.calibration.large.base_from_board.se3()),
        wires={name: wire for name in ("vehicle", "rail", "laser", "claw") if (wire := config.device(name).wire())},
        obstacles=_boxes({o.name: (o.base_from_centre, o.size) for o in config.obstacle}),
    )  # fmt: skip


def _station(job: Job, mesh: Path, drives: bool) -> drawn.StationDrawing:
    approach, there = job.approach, job.surface
    shipped, part, nest = _closed_form(job, mesh), job.part, job.nest
    station = drawn.StationDrawing(
        height=-float(approach.target.se3().translation[2]),
        # To a fixed frame the station is brought, to where the job has it.
        place_from_start=_matrix((approach.start if drives else approach.target).se3()),
        board=job.board.spec, place_from_board=_matrix(job.place_from_board),
        place_from_surface=_matrix(there.place_from_surface.se3()),
        surface=shipped or mesh.stem, mesh="" if shipped else str(mesh.resolve()), mesh_unit=there.mesh_unit,
        flange_from_part=_matrix(job.grasp.flange_from_part.se3()),
        surface_from_part=_matrix(job.place.surface_from_part.se3()), part_size=job.grasp.size,
        obstacles=_boxes({o.name: (o.place_from_centre, o.size) for o in job.obstacle}),
        part_mesh="" if part is None else part.mesh, part_mesh_unit="m" if part is None else part.mesh_unit,
        nest=None if nest is None else _matrix(nest.base_from_part.se3()),
        nest_filled=nest is not None and not job.unloads, stop=job.at_stop or "",
        place_from_stop=next(
            (_matrix(stop.frame) for stop in job.stop if stop.name == job.at_stop and stop.place_from_stop), None
        ),
    )  # fmt: skip
    return drawn.settled(station, STOCK.station)


def _boxes(obstacles: dict[str, tuple[Pose, tuple[float, float, float]]]) -> dict[str, drawn.Box]:
    return {
        name: {"pose": _matrix(middle.se3()).tolist(), "size": list(size)} for name, (middle, size) in obstacles.items()
    }


def _camera(camera: CameraConfig, focus: float) -> drawn.CameraDrawing:
    mounting, band = _matrix(camera.flange_from_camera.se3()), camera.filter
    passed = None if band is None else (band.centre, band.width, band.transmission)
    size = camera.width, camera.height
    return drawn.CameraDrawing(size, camera.pixel, camera.focal_length, focus, mounting=mounting, filter=passed)


def _witness(config: CellConfig) -> NDArray[np.float64] | None:
    """flange_from_witness of a plate on which the laser's line lies, in the picture, at `laser.witness`."""
    laser, camera = config.laser, config.scan_camera
    if laser.witness is None:
        return None
    aside = PLATE_AT * 0.5 * camera.width * camera.pixel / camera.focal_length
    depth = laser.baseline / (1.0 / laser.tan_theta + aside)
    across = depth / laser.tan_theta - laser.baseline + PLATE_ASIDE
    plate = from_parts((laser.witness + across, 0.0, depth))
    return _matrix(camera.flange_from_camera.se3() * plate)


def _closed_form(job: Job, mesh: Path) -> str | None:
    """The name of the shipped surface of which the world knows the closed form; None for any other mesh."""
    return shipped_mesh(mesh) if job.surface.mesh_unit == "m" else None


def _matrix(pose: pin.SE3) -> NDArray[np.float64]:
    return np.array(pose.homogeneous)


# --- what nothing simulates ---


def _makes(config: CellConfig, simulated: Collection[str]) -> Iterator[str]:
    for name in simulated:
        make = config.make(name)
        if make.simulated is None:
            yield (
                f'{name}.driver = "{make.name}": nothing simulates this make; for a simulated cell name one that is '
                "simulated (the built-in ones are)"
            )
        elif name in ("laser", "claw") and not make.on_arm and not config.device(name).wire():
            yield f'{name}.driver = "{make.name}": nothing simulates what this make hangs on; name a built-in one'


def _boards(config: CellConfig, job: Job) -> Iterator[str]:
    for key, board in (
        ("board.spec", job.board.spec),
        ("calibration.fine.board", config.calibration.fine.board),
        ("calibration.large.board", config.calibration.large.board),
    ):
        try:
            Board.parse(board)
        except ValueError:
            yield (
                f'{key} = "{board}": the simulated world prints {", ".join(KINDS[1:])}, named as in '
                '"marked_dots:9x7:20mm", and no other board; name one of these'
            )


def _cameras(config: CellConfig, job: Job) -> Iterator[str]:
    """The simulated cameras are fast enough, and their pictures sharp enough at every distance."""
    scan, most = job.scan, CAMERA_RATE["scan"]
    if scan.frame_rate > most:
        yield f"scan.frame_rate {scan.frame_rate:g} Hz: the simulated scan camera takes at most {most:g} Hz; lower it"
    head, target, deck = config.scan_camera, config.target_camera, config.calibration
    blur = _blur_px(head, SCAN_FOCUS, scan.stand_off)
    if blur > MOST_STRIPE_BLUR_PX:
        yield (
            f"scan.stand_off {1e3 * scan.stand_off:g} mm: a lens of {1e3 * head.focal_length:g} mm at "
            f"f/{F_NUMBER:g}, focused at {1e3 * SCAN_FOCUS:g} mm as is simulated, blurs the line by {blur:.1f} pixels "
            f"(allowed: at most {MOST_STRIPE_BLUR_PX:g}); bring scan.stand_off nearer to {1e3 * SCAN_FOCUS:g} mm"
        )
    for key, board, name, camera, focus, depths in (
        ("calibration.fine.board", deck.fine.board, "scan_camera", head, SCAN_FOCUS, CALIBRATION_DEPTHS["fine"]),
        ("calibration.large.board", deck.large.board, "target_camera", target, TARGET_FOCUS,
         CALIBRATION_DEPTHS["large"]),
        ("board.spec", job.board.spec, "target_camera", target, TARGET_FOCUS, (job.photo.stand_off,)),
    ):  # fmt: skip
        for depth in (depths[0], depths[-1]):
            dot = 0.5 * Board.parse(board).pitch * camera.focal_length / camera.pixel / depth
            if (blur := _blur_px(camera, focus, depth)) > MOST_BLUR * dot:
                yield (
                    f"{key} {board}, {1e3 * depth:g} mm from {name}: a lens of {1e3 * camera.focal_length:g} mm at "
                    f"f/{F_NUMBER:g}, focused at {1e3 * focus:g} mm as is simulated, blurs its dots of {dot:.1f} "
                    f"pixels by {blur:.1f} (allowed: at most {MOST_BLUR * dot:.1f}); take a board with a larger pitch"
                )
                break


def _blur_px(camera: CameraConfig, focus: float, depth: float) -> float:
    """Diameter of the blur disc, px, by the thin lens."""
    f = camera.focal_length
    if min(depth, focus) <= f:
        return math.inf
    return f * f / F_NUMBER * abs(depth - focus) / (depth * (focus - f)) / camera.pixel


def _outputs(config: CellConfig) -> Iterator[str]:
    laser, claw = config.laser, config.claw
    if isinstance(laser, OnArm) and isinstance(claw, OnArm) and laser.output == claw.output:
        yield f"laser.output and claw.output are both {laser.output}; each has an output of its own"


def _table(job: Job, mesh: Path) -> Iterator[str]:
    """The simulated table is square; surface and part lie on it, and the surface is seen from above."""
    if (shipped := _closed_form(job, mesh)) is not None:
        x, y = surface(shipped).half_x, surface(shipped).half_y
        vertices = np.array([[sx * x, sy * y, 0.0] for sx in (-1, 1) for sy in (-1, 1)])
        faces = np.array([[0, 2, 1], [1, 2, 3]])
    else:
        from cell.measure.inversion.nominal import read_mesh  # half a second of imports

        vertices, faces = read_mesh(mesh, job.surface.mesh_unit)
    on_place = transform(job.surface.place_from_surface.se3(), vertices)
    reach = float(np.abs(on_place[:, :2]).max())
    if reach > TABLE_HALF:
        yield (
            f"surface.mesh and surface.place_from_surface: the surface reaches {1e3 * reach:.0f} mm from the place "
            f"frame's origin; the simulated table ends at {1e3 * TABLE_HALF:.0f} mm. Put place frame and board nearer"
        )
    lean = job.surface.place_from_surface.se3().rotation[2, 2]
    if lean < math.cos(math.radians(45.0)):
        yield (
            f"surface.place_from_surface tilts the surface by {math.degrees(math.acos(max(-1.0, lean))):.0f} deg "
            "(allowed: at most 45 deg): the simulated part comes from above; turn the mesh so that z is up"
        )
    corners = vertices[faces]
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    if up.sum() < 0.0 and not (up > 0.0).any():
        yield (
            "surface.mesh: all of its triangles face down (corners counter-clockwise from outside, z up); turn their "
            "order round"
        )
