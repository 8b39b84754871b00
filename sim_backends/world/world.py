"""The world: the devices' models in one place, what couples them, and the pictures that the cameras take of it.

The models are advanced by their peers. What they share passes through here: switches on the arm's outputs, contact,
the vehicle's lean under the arm, and the chain of poses from the floor to the cameras. Its truth is one JSON object,
for the report's comparison and for nothing that the cell does; frames are those of `drawing`.
"""

import math
from collections.abc import Collection
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_backends.clock import SwitchHistory, WorldClock
from sim_backends.models.arm import ArmModel, ArmParams, Safety
from sim_backends.models.arm_kinematics import TABLES
from sim_backends.models.camera import CameraSpec
from sim_backends.models.followed import FollowedArm, FollowedRail, FollowedVehicle
from sim_backends.models.rail import RailModel, RailParams
from sim_backends.models.ramp import Screw
from sim_backends.models.vehicle import VehicleModel, VehicleParams
from sim_backends.world.bodies.collisions import ArmPoints, Collision, Collisions
from sim_backends.world.bodies.contact import Nest, PartContact
from sim_backends.world.bodies.station import Station
from sim_backends.world.cameras import Cameras
from sim_backends.world.drawing import CAMERA_RATE, STOCK, Drawing, StationDrawing, inverse, pose
from sim_backends.world.levels import WARMING_S, assumed_noise
from sim_backends.world.scene import Lens, Scene, draw, rotation, stream

Pose = NDArray[np.float64]


ROLL = 10.0
"""Of a carriage that droops, rad per m."""
GUST_S, WAVE_M = 10.0, 1.5
"""From gust to gust, and from one of the ground's waves to the next."""
BANDS = 6
"""In so many bands a rolling shutter is drawn."""


@dataclass(frozen=True, eq=False)
class Item:
    """One item of a job, or all of a job that has none: its scene, its station and its part."""

    scene: Scene
    station: Station
    part: PartContact


class World:
    """One seeded world. `scene` holds what was drawn, `arm`, `rail` and `vehicle` the models that the peers drive."""

    def __init__(
        self, seed: int = 1, level: str = "nominal", speed: float = 1.0, drawing: Drawing = STOCK,
        clock: WorldClock | None = None, followed: Collection[str] = (),
    ) -> None:  # fmt: skip
        """Draw the world around `drawing` and let its clock run, at `speed` unless it is given one.

        Of arm, rail and vehicle those in `followed` are where real ones are measured: see `world.following`.
        Raises ValueError for an unknown level or surface, a surface that is no mesh, or a bad number.
        """
        self.scene = draw(seed, level, drawing)
        self.station = Station.of(drawing.station)
        self.clock = WorldClock(speed) if clock is None else clock
        self.arm = make_arm(self.scene, self.clock, FollowedArm if "arm" in followed else ArmModel)
        self.rail = make_rail(self.scene, FollowedRail if "rail" in followed else RailModel)
        self.vehicle = make_vehicle(self.scene, FollowedVehicle if "vehicle" in followed else VehicleModel)
        self.laser = SwitchHistory()
        self.switches = {"laser": False, "claw": True}
        """What switches laser and claw where no output of the arm does: set by their peers."""
        self.parts = 0
        """How many parts were made ready before those of now."""
        self._cameras = Cameras(self.scene, self.station)
        self._stood = 0.0
        self._set_up()
        if drawing.station.nest is not None:
            self._close_claw(False)
        self.vehicle.sag = self._sag
        self.vehicle.blocked = lambda t, pose: self.collisions.blocks(t, pose)
        self.arm.contact = self._contact_wrench

    @property
    def part(self) -> PartContact:
        """The part of the job, or of its present item; whichever the claw holds."""
        return next((item.part for item in self._items if item.part.held), self._items[self._current].part)

    def _set_up(self, found: tuple[Collision, ...] = ()) -> None:
        """Part in the claw, or those of all items where they lie at first, and bodies that may meet."""
        drawn = self.scene.drawing.station
        items = [self._drawn_item(k) for k in range(len(drawn.beside))]
        own = replace(drawn, beside=()).as_json()
        # Whoever looks meanwhile, in another thread, finds an item.
        self._current = 0
        self._items = items or [Item(self.scene, self.station, self._part(self.scene, self.station))]
        self._current = [each.as_json() for each in drawn.beside].index(own) if items else 0
        self._make_current(found)
        self._report_grip()

    def _drawn_item(self, k: int) -> Item:
        """One of those beside each other. The table of the first one at its stop carries them all."""
        beside, now = self.scene.drawing.station.beside, self.scene
        at_stop = [each.stop for each in beside].index(beside[k].stop)
        first, own = (
            draw(now.seed, now.level, replace(now.drawing, station=replace(beside[n], beside=beside)), self.parts + n)
            for n in (at_stop, k)
        )
        on_table = first.world_from_table @ beside[k].place_from_surface
        scene = replace(own, world_from_table=first.world_from_table, world_from_surface=on_table)
        station = Station.of(beside[k])
        return Item(scene, station, self._part(scene, station))

    def _make_current(self, found: tuple[Collision, ...]) -> None:
        """What the cell does now is about this item."""
        item = self._items[self._current]
        self.scene, self.station = item.scene, item.station
        self._solid = ArmPoints(item.scene.drawing)
        others = [other for other in self._items if other is not item]
        stops = {other.scene.drawing.station.stop: other.scene for other in others}
        stops.pop(item.scene.drawing.station.stop, None)
        self.collisions = Collisions(item.scene, item.part, found, list(stops.values()))
        self._cameras.show(item.scene, item.station, [(other.scene, other.station) for other in others])

    def _part(self, scene: Scene, station: Station) -> PartContact:
        drawn, nest = scene.drawing.station, None
        if drawn.nest is not None:
            there = drawn.nest @ inverse(drawn.surface_from_part)
            nest = Nest(
                there, lambda: self.world_from_base(self.clock.now()), scene.surface_from_part, drawn.nest_filled
            )
        return PartContact(
            station.ground, scene.world_from_surface, scene.flange_from_part, world_from_table=scene.world_from_table,
            surface_from_part=drawn.surface_from_part, table_height=drawn.height, part=station.part, nest=nest,
        )  # fmt: skip

    def _close_claw(self, closed: bool) -> None:
        self.switches["claw"] = closed
        if (output := self.scene.drawing.cell.claw_output) is not None:
            self.arm.write_digital_outputs(1 << output, int(closed) << output)

    def make_ready(self, station: StationDrawing) -> None:
        """As when a person makes all ready for a job: the station is set up, and its part is put into the claw, or onto
        the surface where the job takes it from there.

        What lay at the station is taken away. Vehicle, arm and rail stay as they stand. Where the station stands
        already, with the part of that item untouched, all stays as it is. Raises ValueError as `World`.
        """
        wanted = replace(self.scene.drawing, station=station).as_json()
        for k, item in enumerate(self._items):
            if item.part.untouched and item.scene.drawing.as_json() == wanted:
                if k != self._current:
                    self._current = k
                    self._make_current(self.collisions.found)
                return
        ready, parts = Station.of(station), self.parts + len(self._items)
        scene = draw(self.scene.seed, self.scene.level, replace(self.scene.drawing, station=station), parts)
        self.scene, self.station, self.parts = scene, ready, parts
        self._close_claw(station.nest is None)
        self._set_up(self.collisions.found)

    def remake(self, scene: Scene, station: Station) -> None:
        """As if this scene had been drawn, and the part were in its claw; devices stay as they are."""
        self.scene, self.station = scene, station
        self._set_up(self.collisions.found)

    def slide(self, by: Pose) -> None:
        """As when a person pushes the surface over its table, with what lies on it: `by` (4, 4) in its own frame."""
        item = self._items[self._current]
        pushed = item.scene.world_from_surface @ by
        item.part.slide(pushed)
        self._items[self._current] = replace(item, scene=replace(item.scene, world_from_surface=pushed))
        self._make_current(self.collisions.found)

    def world_from_base(self, t: float) -> Pose:
        """True pose (4, 4) of the arm's base at world time `t`, the vehicle's lean and rocking included."""
        drawn, effects = self.scene.workshop, self.scene.effects
        carried, world_from_vehicle = self.scene.vehicle_from_base, self.vehicle.world_from_vehicle(t)
        if drawn.rocking.any() or effects.wind or effects.ground:
            swing = drawn.rocking + drawn.wind * np.sin(np.pi * t / GUST_S) ** 2
            turn = swing * np.sin(2.0 * np.pi * drawn.rocking_hz * t + drawn.rocking_phase)
            waves = 2.0 * np.pi * world_from_vehicle[0, 3] / WAVE_M + drawn.ground[2:]
            turn = turn + drawn.ground[:2] * np.sin(waves)
            tilt = np.eye(4)
            tilt[:3, :3] = rotation(np.append(turn, 0.0))
            carried = tilt @ carried
        return world_from_vehicle @ carried

    def world_from_flange(self, t: float) -> Pose:
        """True pose (4, 4) of the flange at world time `t`."""
        return self.world_from_base(t) @ self.arm.base_from_flange(t)

    def flange_from_camera(self, camera: str, t: float) -> Pose:
        """True pose (4, 4) of the camera "scan" or "target" on the flange at world time `t`."""
        if camera == "target":
            return self.scene.flange_from_target_camera
        made, carriage = self.scene.flange_from_scan_camera.copy(), self.rail.carriage(t)
        if self.scene.effects.heat:
            made[:3, 3] += self.warmth(t) * self.scene.workshop.heat
        made[:3, 3] += made[:3, :3] @ (carriage * self.scene.rail_direction)
        if droop := self.scene.effects.droop * (carriage / self.rail.params.travel[1]) ** 2:
            made[:3, 3] += droop * made[:3, 2]
            made[:3, :3] = made[:3, :3] @ rotation(ROLL * droop * self.scene.rail_direction)
        return made

    def render(self, camera: str, t_mid: float, exposure: float) -> NDArray[np.uint8]:
        """The picture (height, width) of "scan" or "target": the world as it was at `t_mid`, exposed `exposure` s."""
        readout = self.scene.effects.rolling_shutter
        if not readout:
            return self._exposed(camera, t_mid, exposure)
        # Bands of rows, each at its own time; pictures of the past only, since the world knows no other.
        bands = [self._exposed(camera, t_mid - readout * (1.0 - k / BANDS), exposure) for k in range(BANDS)]
        edges = np.linspace(0, bands[0].shape[0], BANDS + 1).astype(int)
        return np.concatenate([band[a:b] for band, a, b in zip(bands, edges[:-1], edges[1:], strict=True)])

    def _exposed(self, camera: str, t: float, exposure: float) -> NDArray[np.uint8]:
        world_from_base = self.world_from_base(t)
        world_from_flange = world_from_base @ self.arm.base_from_flange(t)
        seat = self.flange_from_camera(camera, t)
        return self._cameras.picture(
            camera, world_from_flange @ seat, world_from_base, laser=self.laser.at(t), exposure=exposure,
            warm=self.warmth(t), t=t, camera_from_flange=inverse(seat),
            parts=[(item.station, item.part.part_pose(world_from_flange)) for item in self._items],
        )  # fmt: skip

    def warmth(self, t: float) -> float:
        """How far, of 0 to 1, laser and cameras have warmed up since they were switched on, at world time `t`."""
        return float(1.0 - np.exp(-(t + self._stood) / WARMING_S))

    def lens(self, camera: str, t: float) -> Lens:
        """The lens of "scan" or "target" as warm as it is at `t`."""
        return self._cameras.lens(camera, self.warmth(t))

    def light_plane(self, t: float) -> dict[str, object]:
        """The light sheet as warm as it is at `t`: normal (3,) and distance, m, of its plane in the scan camera's
        frame, and its bow y²/r, with y across the fan's middle and r along it from the laser."""
        laser = self._cameras.laser(self.warmth(t))
        return {"normal": list(laser.normal), "distance": laser.distance, "bow": laser.bow}

    def stand(self, seconds: float) -> None:
        """As if the cell had stood idle for so long: nothing moves, laser and cameras warm up."""
        self._stood += seconds

    def warm_up(self) -> None:
        """Render one picture of everything, so that compiling is over before the first client asks for one."""
        base = self.world_from_base(self.clock.now())
        drawn = self.scene.drawing.cell
        for camera, distance in (("scan", drawn.scan.focus), ("target", drawn.target.focus)):
            for target in (self.scene.world_from_surface, self.scene.world_from_board):
                facing = target @ pose((0.0, 0.0, distance), (1, 0, 0), (0, 0, -1))
                self._cameras.picture(camera, facing, base, True, 0.002)

    def switched(self, name: str) -> bool:
        """Whether the "laser" is on, or the "claw" closed: by the arm's output, or by its own switch."""
        drawn = self.scene.drawing.cell
        output = drawn.laser_output if name == "laser" else drawn.claw_output
        return self.switches[name] if output is None else bool(self.arm.digital_outputs >> output & 1)

    def switch(self, name: str, on: bool, since: float | None = None) -> None:
        """The own switch of "laser" or "claw" is on or off: since now, or since a world time. An arm that a real one
        moves is told of late: its tick would note the laser late as well."""
        self.switches[name] = on
        if name == "laser":
            self.laser.record(self.clock.now() if since is None else since, on)

    def _report_grip(self) -> None:
        if (grip := self.scene.drawing.cell.grip_input) is not None:
            self.arm.set_digital_input(grip, self.part.held)

    def _contact_wrench(self, base_from_flange: Pose) -> NDArray[np.float64]:
        """Called by the arm at every tick: follow its outputs, then give the wrench (6,) on the flange in base axes."""
        t = self.arm.time
        world_from_base = self.world_from_base(t)
        world_from_flange = world_from_base @ base_from_flange
        self.laser.record(t, self.switched("laser"))
        closed = self.switched("claw")
        for item in self._items:
            item.part.set_claw(closed, world_from_flange)
        self._report_grip()
        self._stop_at_collision(t, world_from_base)
        wrench = self.part.wrench(world_from_flange)
        if not wrench.any():
            return wrench
        if np.linalg.norm(wrench[:3]) > self.arm.params.force_limit and self.arm.safety is Safety.NORMAL:
            self.collisions.note(t, "part" if self.part.held else "claw", "ground")
        base_from_world = world_from_base[:3, :3].T
        return np.concatenate([base_from_world @ wrench[:3], base_from_world @ wrench[3:]])

    def _stop_at_collision(self, t: float, world_from_base: Pose) -> None:
        """Stop the arm as its safety system does when a link or the tool meets something solid."""
        joints = self.arm.drive.q
        if not self.collisions.due(t, joints, world_from_base):
            return
        points = self._solid.at(self.arm.body_frames(), self.flange_from_camera("scan", t), self.part.held)
        points = points @ world_from_base[:3, :3].T + world_from_base[:3, 3]
        if (met := self.collisions.arm(t, points, self.vehicle.world_from_vehicle(t))) is not None:
            self.arm.protective_stop(met)

    def _sag(self) -> tuple[float, float, float]:
        """Roll, pitch (rad) and height (m) of the body: it leans towards where the arm reaches out."""
        reach = self.arm.base_from_flange(self.clock.now())[:3, 3]
        return (float(-self.scene.suspension[1] * reach[1]), float(self.scene.suspension[0] * reach[0]), 0.0)


_TORQUE_PER_FORCE = 0.05
"""Noise of the measured torque, Nm, per newton of noise in the force."""


def make_arm(scene: Scene, clock: WorldClock, made: type[ArmModel] = ArmModel) -> ArmModel:
    """The arm at rest, with its claw closed."""
    sigma, drawn = scene.deviations, scene.drawing.cell
    model = drawn.arm
    params = ArmParams.of(
        model, dh=TABLES[model] + scene.dh_factory, dh_error=scene.dh_error,
        repeatability=(sigma.arm_repeatability / math.sqrt(3.0), sigma.arm_repeatability_rotation),
        force_noise=(sigma.arm_force_noise, _TORQUE_PER_FORCE * sigma.arm_force_noise),
        memory=scene.effects.path_memory, harmonics=scene.workshop.harmonics, compliance=scene.effects.sag,
        carried=drawn.payload, carried_centre=drawn.payload_centre, serial=f"2023{scene.serial}",
    )  # fmt: skip
    arm = made(params, stream(scene.seed, "arm"), clock)
    if drawn.claw_output is not None:
        closed = 1 << drawn.claw_output
        arm.write_digital_outputs(closed, closed)
    return arm


def make_rail(scene: Scene, made: type[RailModel] = RailModel) -> RailModel:
    """The rail, switched on anywhere on its travel and not yet homed."""
    drawn = scene.drawing.cell.rail
    screw = Screw(
        lead=drawn.lead, scale_error=scene.rail_lead_error, periodic=scene.rail_periodic_amplitude,
        phase=scene.rail_periodic_phase, backlash=scene.rail_backlash,
    )  # fmt: skip
    params = RailParams(
        screw=screw,
        steps_per_turn=drawn.steps_per_turn,
        repeatability=scene.deviations.rail_homing,
        start=float(stream(scene.seed, "rail.start").uniform(*drawn.start)),
        serial=int(scene.serial),
        reversed=drawn.reversed,
    ).around(drawn.travel)
    return made(params, stream(scene.seed, "rail"))


def make_vehicle(scene: Scene, made: type[VehicleModel] = VehicleModel) -> VehicleModel:
    """The vehicle standing at its start, braked for good where it is a fixed frame. Its drift sideways and in yaw
    follow the odometry's errors."""
    start = scene.world_from_vehicle_start
    yaw = float(np.arctan2(start[1, 0], start[0, 0]))
    params = VehicleParams(
        start=(float(start[0, 3]), float(start[1, 3]), yaw), track=scene.drawing.cell.track,
        distance_scale=1.0 + scene.odometry_scale, yaw_scale=1.0 + scene.odometry_yaw,
        lateral_walk=0.1 * scene.deviations.odometry_scale, yaw_walk=0.1 * scene.deviations.odometry_yaw,
    )  # fmt: skip
    model = made(params, stream(scene.seed, "vehicle"))
    if scene.drawing.cell.fixed:
        model.set_brake(0.0, True)
    return model


def camera_spec(scene: Scene, camera: str) -> CameraSpec:
    """The camera "scan" or "target"; its serial carries the seed, so that another cell's calibration is recognised."""
    drawn, scan = scene.drawing.cell, camera == "scan"
    size = drawn.scan.size if scan else drawn.target.size
    timing = scene.scan_clock if scan else scene.target_clock
    return CameraSpec(
        model=f"SIM-{camera.upper()}", serial=f"SIM{scene.serial}-{camera.upper()}", width=size[0], height=size[1],
        frame_rate_max=CAMERA_RATE[camera], epoch=timing.epoch, drift_ppm=1e6 * timing.drift, latency=timing.latency,
    )  # fmt: skip


def truth(world: World) -> dict[str, object]:
    """Everything true about `world` now; see the keys."""
    t = world.clock.now()
    scene = world.scene
    vehicle = world.vehicle.feedback(t)
    shape = world.station.ground
    outputs = world.arm.digital_outputs
    return {
        "seed": scene.seed,
        "level": scene.level,
        "speed": world.clock.speed,
        "time": t,
        "assumed_noise": assumed_noise(scene.level),
        "surface": {"name": shape.name, "half_x": shape.half_x, "half_y": shape.half_y, "unit": "m"},
        "poses": {name: _nested(pose) for name, pose in _poses(world, t).items()},
        "scan_lens": _lens(world.lens("scan", t)),
        "target_lens": _lens(world.lens("target", t)),
        "light_plane": world.light_plane(t),
        "rail": {
            "direction": _nested(scene.rail_direction),
            "scale": 1.0 + scene.rail_lead_error,
            "backlash": scene.rail_backlash,
            "periodic": scene.rail_periodic_amplitude,
            "carriage": world.rail.carriage(t),
        },
        "part": {"held": world.part.held},
        "laser_on": world.switched("laser"),
        "digital_outputs": [bool(outputs >> i & 1) for i in range(8)],
        "vehicle": {
            "stopped": vehicle.speed == 0.0 and vehicle.yaw_rate == 0.0,
            "braked": vehicle.braked,
            "speed": vehicle.speed,
            "yaw_rate": vehicle.yaw_rate,
        },
        "arm": {"moving": world.arm.moving, "safety": world.arm.safety.name.lower(), "fault": world.arm.fault_text},
        "collisions": [asdict(collision) for collision in world.collisions.found],
        "rail_moving": world.rail.velocity(t) != 0,
    }


def _poses(world: World, t: float) -> dict[str, Pose]:
    """Every pose (4, 4), m, by its name."""
    scene = world.scene
    world_from_base = world.world_from_base(t)
    base_from_world = inverse(world_from_base)
    base_from_flange = world.arm.base_from_flange(t)
    world_from_part = world.part.part_pose(world_from_base @ base_from_flange)
    return {
        "world_from_vehicle": world.vehicle.world_from_vehicle(t), "world_from_base": world_from_base,
        "world_from_surface": scene.world_from_surface, "world_from_board": scene.world_from_board,
        "base_from_surface": base_from_world @ scene.world_from_surface,
        "base_from_board": base_from_world @ scene.world_from_board, "base_from_flange": base_from_flange,
        "base_from_fine_board": scene.base_from_fine_board, "base_from_deck_board": scene.base_from_deck_board,
        "flange_from_scan_camera": scene.flange_from_scan_camera,
        "flange_from_target_camera": scene.flange_from_target_camera, "flange_from_part": scene.flange_from_part,
        "base_from_part": base_from_world @ world_from_part,
        "surface_from_part": inverse(scene.world_from_surface) @ world_from_part,
    }  # fmt: skip


def _nested(values: Pose) -> Any:
    return np.asarray(values).tolist()


def _lens(lens: Lens) -> dict[str, object]:
    return {"fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy, "dist": list(lens.dist)}
