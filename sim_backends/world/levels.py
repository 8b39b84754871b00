"""How far a world deviates from its nominal geometry: one table of 1σ values for each level.

Every draw is Gaussian and cut at 2.5 σ. `ideal` keeps only what a perfect cell would have too: the sensor's
quantisation and a little read noise. `workshop` is `nominal` with all effects of `effects.py`; "nominal+rocking+grasp"
is a level with just those.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

from sim_backends.world.effects import NONE, WORKSHOP, Effects, only

CUT = 2.5
"""Draws lie within this many σ."""


def _of(unit: str, meaning: str) -> float:
    """A σ of the table with its unit and meaning; every level must state it."""
    made: float = field(metadata={"unit": unit, "meaning": meaning})
    return made


@dataclass(frozen=True)
class Deviations:
    """1σ of every deviation and noise, SI. Vectors are drawn component by component with the σ given here."""

    hand_eye_translation: float = _of("m", "scan camera on its carriage against the drawing")
    hand_eye_rotation: float = _of("rad", "scan camera on its carriage against the drawing")
    target_mount_translation: float = _of("m", "target camera on the flange against the drawing")
    target_mount_rotation: float = _of("rad", "target camera on the flange against the drawing")
    light_plane_offset: float = _of("m", "laser's exit point, per axis")
    light_plane_tilt: float = _of("rad", "light plane's normal")
    focal_length: float = _of("1", "relative, both lenses")
    principal_point: float = _of("px", "per axis, both lenses")
    distortion_k1: float = _of("1", "first radial coefficient, both lenses")
    rail_direction: float = _of("rad", "sweep direction in the camera's frame")
    rail_lead: float = _of("1", "relative error of the rail's lead")
    rail_periodic: float = _of("m", "amplitude of the error once per turn of the screw")
    rail_backlash: float = _of("m", "lost motion of the carriage")
    rail_homing: float = _of("m", "home position, anew at each homing")
    arm_repeatability: float = _of("m", "radial (1/√3 of it per axis), anew each time the arm settles")
    arm_repeatability_rotation: float = _of("rad", "per axis, anew each time the arm settles")
    arm_factory_length: float = _of("m", "each link length and offset that the controller knows and the drawing not")
    arm_factory_angle: float = _of("rad", "each joint's zero and twist that the controller knows and the drawing not")
    arm_factory_slide: float = _of("m", "offsets of joints 2 and 3 in the controller's table, taken back by joint 4's")
    arm_dh_length: float = _of("m", "each link length and offset")
    arm_dh_angle: float = _of("rad", "each joint's zero")
    arm_force_noise: float = _of("N", "measured force, per axis")
    odometry_scale: float = _of("1", "relative error of the way driven")
    odometry_yaw: float = _of("1", "relative error of the angle turned")
    suspension: float = _of("rad/m", "body's lean per metre that the arm reaches out")
    station_translation: float = _of("m", "surface against the place frame that the board defines")
    station_rotation: float = _of("rad", "surface against the place frame that the board defines")
    deck_board_translation: float = _of("m", "calibration boards on the deck against the drawing")
    deck_board_rotation: float = _of("rad", "calibration boards on the deck against the drawing")
    start_translation: float = _of("m", "vehicle's start")
    start_rotation: float = _of("rad", "vehicle's start")
    grasp_translation: float = _of("m", "part in the claw")
    grasp_rotation: float = _of("rad", "part in the claw")
    camera_clock_drift: float = _of("1", "relative drift of a camera's time stamps")
    exposure_latency: float = _of("s", "time stamp after the start of the exposure")
    read_noise: float = _of("DN", "camera's read noise")
    speckle_contrast: float = _of("1", "correlated along the stripe")
    ambient: float = _of("1", "relative deviation of the ambient light's level and its gradient across the image")

    def assumed_noise(self) -> dict[str, dict[str, float | str]]:
        """Every σ with its unit and meaning, for reports that state what was assumed."""
        return {
            f.name: {"sigma": getattr(self, f.name), "unit": f.metadata["unit"], "of": f.metadata["meaning"]}
            for f in dataclasses.fields(self)
        }


NOMINAL = Deviations(
    hand_eye_translation=0.002,
    hand_eye_rotation=0.0105,
    target_mount_translation=0.002,
    target_mount_rotation=0.0105,
    light_plane_offset=0.0005,
    light_plane_tilt=0.0070,
    focal_length=0.005,
    principal_point=4.0,
    distortion_k1=0.02,
    rail_direction=0.0070,
    rail_lead=0.0015,
    rail_periodic=3e-6,
    rail_backlash=10e-6,
    rail_homing=5e-6,
    arm_repeatability=0.04e-3,
    arm_repeatability_rotation=0.08e-3,
    arm_factory_length=0.0,
    arm_factory_angle=0.0,
    arm_factory_slide=0.0,
    arm_dh_length=0.03e-3,
    arm_dh_angle=0.02e-3,
    arm_force_noise=0.3,
    odometry_scale=0.01,
    odometry_yaw=0.015,
    suspension=0.0004,
    station_translation=0.002,
    station_rotation=0.0087,
    deck_board_translation=0.002,
    deck_board_rotation=0.0087,
    start_translation=0.02,
    start_rotation=0.014,
    grasp_translation=0.01e-3,
    grasp_rotation=0.1e-3,
    camera_clock_drift=20e-6,
    exposure_latency=20e-6,
    read_noise=0.4,
    speckle_contrast=0.15,
    ambient=0.06,
)
IDEAL = Deviations(**{f.name: 0.0 for f in dataclasses.fields(Deviations)} | {"read_noise": 0.1})
HARSH = Deviations(**{f.name: 2.5 * getattr(NOMINAL, f.name) for f in dataclasses.fields(Deviations)})

LEVELS = {"ideal": IDEAL, "nominal": NOMINAL, "harsh": HARSH, "workshop": NOMINAL}


def deviations(level: str) -> Deviations:
    """The table of `level`, or of a level with effects as in "nominal+grasp". Raises ValueError that lists them."""
    rows: dict[str, float] = {}
    effects = effects_of(level)
    if effects.grasp:
        rows |= {"grasp_translation": effects.grasp, "grasp_rotation": 10.0 * effects.grasp}
    if length := effects.factory_arm:
        rows |= {"arm_factory_length": length, "arm_factory_angle": 2.0 * length, "arm_factory_slide": 50.0 * length}
    return dataclasses.replace(LEVELS[_parts(level)[0]], **rows)


def effects_of(level: str) -> Effects:
    """The workshop's effects at `level`. Raises ValueError that lists the levels or the effects."""
    base, *names = _parts(level)
    return only(*names) if names else WORKSHOP if base == "workshop" else NONE


def number_of(level: str) -> str:
    """Digits that tell this level from every other one, for serial numbers."""
    base, *names = _parts(level)
    every = Effects.names()
    return str(list(LEVELS).index(base)) + "".join(f"{every.index(name):02d}" for name in sorted(names))


def assumed_noise(level: str) -> dict[str, dict[str, float | str]]:
    """Every σ of `level` with its unit and meaning, and the effects that are on."""
    return deviations(level).assumed_noise() | effects_of(level).assumed_noise()


def _parts(level: str) -> list[str]:
    base, *names = level.split("+")
    if base not in LEVELS or (names and base == "workshop"):
        raise ValueError(f"unknown level {level!r}: choose one of {', '.join(LEVELS)}")
    return [base, *names]
