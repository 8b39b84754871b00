"""How far a world deviates from its nominal geometry: one table of 1σ values for each level.

Every draw is Gaussian and cut at 2.5 σ. `ideal` keeps only what a perfect cell would have too: the sensor's
quantisation and a little read noise. `workshop` is `nominal` with what a workshop does to a cell that the drawing's
tolerances leave out, `outdoor` what the open adds. Each such effect is off at the other levels and can be added alone:
"nominal+rocking+grasp". Sizes marked "assumed" are of the usual order; nobody measured them on this cell.
"""

import dataclasses
from dataclasses import dataclass, field


def _row(size: float, unit: str, meaning: str, source: str, option: bool = False) -> float:
    """An effect, off; `size` is its when it is on. An `option` is none of `workshop`."""
    made: float = field(
        default=0.0, metadata={"size": size, "unit": unit, "meaning": meaning, "source": source, "option": option}
    )
    return made


def _told(rows: "Deviations | Effects") -> dict[str, dict[str, float | str]]:
    """Every row that is not off, with its size, unit and meaning, for reports that state what was assumed."""
    return {
        f.name: {"sigma": getattr(rows, f.name), "unit": f.metadata["unit"], "of": f.metadata["meaning"]}
        for f in dataclasses.fields(rows)
        if getattr(rows, f.name) or isinstance(rows, Deviations)
    }


@dataclass(frozen=True)
class Effects:
    """The size of every effect, SI; 0 is off. What is drawn at random is drawn to this size from the world's seed."""

    factory_arm: float = _row(
        1e-3,
        "m",
        "1 sigma of the link lengths that the controller knows and the maker's table does not; 2 mrad per mm of twists "
        "and zeros, and 50 mm per mm of the offsets that cancel along the parallel axes",
        "factory tables of three arms in the tests of the maker's ur_calibration",
    )
    joint_harmonics: float = _row(
        0.07e-3,
        "rad",
        "RMS error of each joint's angle, in sines of one and two turns of its motor",
        "strain wave gears repeat with the wave generator: Tuttle, Understanding and modeling the behavior of a "
        "harmonic drive gear transmission, MIT 1992; size assumed",
    )
    path_memory: float = _row(
        0.5,
        "rad",
        "way of the joints after which the arm's repeatability error is another one; drawn anew at each rest if 0",
        "friction and play keep their state over a short way (Tuttle 1992); length assumed",
    )
    sag: float = _row(
        3e-6,
        "rad/(N m)",
        "compliance of each joint under the weight that the flange carries",
        "gears of this size have 1e4 to 1e5 N m/rad (makers' catalogues); what a controller leaves of it is assumed",
    )
    rocking: float = _row(
        0.1e-3, "rad", "amplitude of the standing vehicle's rocking at about 4 Hz", "soft tyres; assumed"
    )
    sheet_bow: float = _row(
        0.02e-3,
        "m",
        "1 sigma of the light sheet's bow: off its plane 18 mm beside the middle, 130 mm from the laser",
        "line straightness of line lasers, 0.05 to 0.1 % of the line (makers' data sheets)",
    )
    laser_pointing: float = _row(
        50e-6,
        "rad/K",
        "turn of the light plane as the laser warms",
        "makers' data sheets of line lasers, 10 to 100 µrad/K",
    )
    camera_warm_up: float = _row(
        0.01,
        "px/K",
        "shift of both cameras' principal points as they warm, per axis; the focal length follows by 1e-5 per K",
        "Elias et al., Sensors 2020, 20, 643, for the kind of effect; size assumed for a metal housing",
    )
    grasp: float = _row(0.1e-3, "m", "1 sigma of the part's place in the claw; 10 mrad per mm of turn", "assumed")
    late_stamps: float = _row(2e-3, "s", "most that a camera's time stamps are late; even from 0", "assumed")
    rolling_shutter: float = _row(
        10e-3, "s", "from the first row's exposure to the last one's", "CMOS sensors, 10 to 30 ms", option=True
    )
    texture: float = _row(
        0.10, "1", "RMS of the surface's albedo, in grains of 0.3 and 1 mm", "cast or ground metal, assumed"
    )
    gloss: float = _row(0.3, "1", "light mirrored towards the camera, of that scattered", "half-matt metal; assumed")
    dust: float = _row(1.0, "1", "spots per cm² on the surface, and shadows on the laser's window", "assumed")
    sheet_ends: float = _row(
        0.17, "rad", "angle from the fan's middle at which it fades out", "fan angle of a line laser"
    )
    sunlight: float = _row(
        0.4, "1", "light of the sun's patch, of the room's; it moves over table and board", "assumed"
    )
    droop: float = _row(
        0.1e-3,
        "m",
        "how far the scan head's carriage has sunk, along the camera's axis, at the far end of its travel: as the "
        "square of its way; it rolls about the way by 10 mrad per mm",
        "a carriage on one guide, worn where it works; size assumed",
        option=True,
    )
    oil: float = _row(
        0.12e-3,
        "m",
        "thickness, in its middle, of a puddle of oil on the surface, 12 to 20 mm wide",
        "what stands on metal at 4 degrees of contact: 2 sin 2° of its capillary length, 1.8 mm; angle assumed",
        option=True,
    )
    sun: float = _row(
        100.0,
        "klx",
        "most illuminance in the open, drawn from a fifth of it on; 15 % of it reach into a shadow, whose edge goes to "
        "and fro over the place",
        "clear sky, sun from 10 to 60 degrees high (CIE S 011); sim_backends/optics/daylight.py has what a sensor sees",
        option=True,
    )
    wind: float = _row(
        0.05e-3,
        "rad",
        "amplitude of the standing vehicle's rocking at about 4 Hz in the gusts, one every 10 s",
        "8 m/s on 1 m², half a metre high, gusts of 0.3 of it: 7 N m on tyres of 8e5 N m/rad, and their resonance, "
        "assumed to be five times",
        option=True,
    )
    ground: float = _row(
        5e-3, "rad", "1 sigma of the ground's slope, in waves of 1.5 m", "paved yards fall by 1 to 2 %", option=True
    )
    heat: float = _row(
        20e-6,
        "m",
        "1 sigma, per axis, by which the scan camera's mount has grown once it is warm",
        "aluminium, 0.1 m, 23e-6 per K, 10 K",
        option=True,
    )

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Every effect."""
        return tuple(f.name for f in dataclasses.fields(cls))


NONE = Effects()
_ROWS = dataclasses.fields(Effects)
ALONE = Effects(**{f.name: f.metadata["size"] for f in _ROWS})
"""The size of each when it is added alone."""
WORKSHOP = Effects(**{f.name: f.metadata["size"] for f in _ROWS if not f.metadata["option"]})
"""All of them together, but for the options, which are added by their names."""
OUTDOOR = ("sun", "wind", "ground", "heat")
"""The options that the level of this name has."""
WARMING_K, WARMING_S = 10.0, 1200.0
"""How much warmer laser and cameras become after they are switched on, and in what time (1/e)."""


def only(*names: str) -> Effects:
    """Just the effects named; ValueError that lists them for a name that is none."""
    unknown = [name for name in names if name not in Effects.names()]
    if unknown:
        raise ValueError(f"unknown effect {unknown[0]!r}: choose of {', '.join(Effects.names())}")
    return dataclasses.replace(NONE, **{name: getattr(ALONE, name) for name in names})


CUT = 2.5


def _of(nominal: float, unit: str, meaning: str) -> float:
    """A σ of the table, at `nominal`, with its unit and meaning."""
    made: float = field(default=nominal, metadata={"unit": unit, "meaning": meaning})
    return made


@dataclass(frozen=True)
class Deviations:
    """1σ of every deviation and noise, SI. Vectors are drawn component by component with the σ given here."""

    hand_eye_translation: float = _of(0.002, "m", "scan camera on its carriage against the drawing")
    hand_eye_rotation: float = _of(0.0105, "rad", "scan camera on its carriage against the drawing")
    target_mount_translation: float = _of(0.002, "m", "target camera on the flange against the drawing")
    target_mount_rotation: float = _of(0.0105, "rad", "target camera on the flange against the drawing")
    light_plane_offset: float = _of(0.0005, "m", "laser's exit point, per axis")
    light_plane_tilt: float = _of(0.0070, "rad", "light plane's normal")
    focal_length: float = _of(0.005, "1", "relative, both lenses")
    principal_point: float = _of(4.0, "px", "per axis, both lenses")
    distortion_k1: float = _of(0.02, "1", "first radial coefficient, both lenses")
    rail_direction: float = _of(0.0070, "rad", "sweep direction in the camera's frame")
    rail_lead: float = _of(0.0015, "1", "relative error of the rail's lead")
    rail_periodic: float = _of(3e-6, "m", "amplitude of the error once per turn of the screw")
    rail_backlash: float = _of(10e-6, "m", "lost motion of the carriage")
    rail_homing: float = _of(5e-6, "m", "home position, anew at each homing")
    arm_repeatability: float = _of(0.04e-3, "m", "radial (1/√3 of it per axis), anew each time the arm settles")
    arm_repeatability_rotation: float = _of(0.08e-3, "rad", "per axis, anew each time the arm settles")
    arm_factory_length: float = _of(
        0.0, "m", "each link length and offset that the controller knows and the drawing not"
    )
    arm_factory_angle: float = _of(
        0.0, "rad", "each joint's zero and twist that the controller knows and the drawing not"
    )
    arm_factory_slide: float = _of(
        0.0, "m", "offsets of joints 2 and 3 in the controller's table, taken back by joint 4's"
    )
    arm_dh_length: float = _of(0.03e-3, "m", "each link length and offset")
    arm_dh_angle: float = _of(0.02e-3, "rad", "each joint's zero")
    arm_force_noise: float = _of(0.3, "N", "measured force, per axis")
    odometry_scale: float = _of(0.01, "1", "relative error of the way driven")
    odometry_yaw: float = _of(0.015, "1", "relative error of the angle turned")
    suspension: float = _of(0.0004, "rad/m", "body's lean per metre that the arm reaches out")
    station_translation: float = _of(0.002, "m", "surface against the place frame that the board defines")
    station_rotation: float = _of(0.0087, "rad", "surface against the place frame that the board defines")
    deck_board_translation: float = _of(0.002, "m", "calibration boards on the deck against the drawing")
    deck_board_rotation: float = _of(0.0087, "rad", "calibration boards on the deck against the drawing")
    start_translation: float = _of(0.02, "m", "vehicle's start")
    start_rotation: float = _of(0.014, "rad", "vehicle's start")
    grasp_translation: float = _of(0.01e-3, "m", "part in the claw")
    grasp_rotation: float = _of(0.1e-3, "rad", "part in the claw")
    camera_clock_drift: float = _of(20e-6, "1", "relative drift of a camera's time stamps")
    exposure_latency: float = _of(20e-6, "s", "time stamp after the start of the exposure")
    read_noise: float = _of(0.4, "DN", "camera's read noise")
    speckle_contrast: float = _of(0.15, "1", "correlated along the stripe")
    ambient: float = _of(0.06, "1", "relative deviation of the ambient light's level and its gradient across the image")


NOMINAL = Deviations()
IDEAL = Deviations(**{f.name: 0.0 for f in dataclasses.fields(Deviations)} | {"read_noise": 0.1})
HARSH = Deviations(**{f.name: 2.5 * getattr(NOMINAL, f.name) for f in dataclasses.fields(Deviations)})

LEVELS = {"ideal": IDEAL, "nominal": NOMINAL, "harsh": HARSH, "workshop": NOMINAL, "outdoor": NOMINAL}


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
    """The effects at `level`. Raises ValueError that lists the levels or the effects."""
    base, *names = _parts(level)
    return WORKSHOP if base == "workshop" else only(*(OUTDOOR if base == "outdoor" else names))


def number_of(level: str) -> str:
    """Digits that tell this level from every other one, for serial numbers."""
    base, *names = _parts(level)
    every = Effects.names()
    return str(list(LEVELS).index(base)) + "".join(f"{every.index(name):02d}" for name in sorted(names))


def assumed_noise(level: str) -> dict[str, dict[str, float | str]]:
    """Every σ of `level` with its unit and meaning, and the effects that are on."""
    return _told(deviations(level)) | _told(effects_of(level))


def _parts(level: str) -> list[str]:
    base, *names = level.split("+")
    if base not in LEVELS or (names and base in ("workshop", "outdoor")):
        raise ValueError(f"unknown level {level!r}: choose one of {', '.join(LEVELS)}")
    return [base, *names]
