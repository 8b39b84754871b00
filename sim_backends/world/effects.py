"""What a workshop does to a cell that the drawing's tolerances leave out: one row an effect, with its size and source.

Every effect is off at the other levels, and can be added alone to any of them (`levels.py`: "nominal+sheet_bow"). Sizes
marked "assumed" are of the usual order; nobody measured them on this cell.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field


def _row(unit: str, meaning: str, source: str) -> float:
    """An effect of size 0: off."""
    made: float = field(default=0.0, metadata={"unit": unit, "meaning": meaning, "source": source})
    return made


@dataclass(frozen=True)
class Effects:
    """The size of every effect, SI; 0 is off. What is drawn at random is drawn to this size from the world's seed."""

    factory_arm: float = _row(
        "m",
        "1 sigma of the link lengths that the controller knows and the maker's table does not; 2 mrad per mm of twists "
        "and zeros, and 50 mm per mm of the offsets that cancel along the parallel axes",
        "factory tables of three arms in the tests of the maker's ur_calibration",
    )
    joint_harmonics: float = _row(
        "rad",
        "RMS error of each joint's angle, in sines of one and two turns of its motor",
        "strain wave gears repeat with the wave generator: Tuttle, Understanding and modeling the behavior of a "
        "harmonic drive gear transmission, MIT 1992; size assumed",
    )
    path_memory: float = _row(
        "rad",
        "way of the joints after which the arm's repeatability error is another one; drawn anew at each rest if 0",
        "friction and play keep their state over a short way (Tuttle 1992); length assumed",
    )
    sag: float = _row(
        "rad/(N m)",
        "compliance of each joint under the weight that the flange carries",
        "gears of this size have 1e4 to 1e5 N m/rad (makers' catalogues); what a controller leaves of it is assumed",
    )
    rocking: float = _row("rad", "amplitude of the standing vehicle's rocking at about 4 Hz", "soft tyres; assumed")
    sheet_bow: float = _row(
        "m",
        "1 sigma of the light sheet's bow: off its plane 18 mm beside the middle, 130 mm from the laser",
        "line straightness of line lasers, 0.05 to 0.1 % of the line (makers' data sheets)",
    )
    laser_pointing: float = _row(
        "rad/K", "turn of the light plane as the laser warms", "makers' data sheets of line lasers, 10 to 100 µrad/K"
    )
    camera_warm_up: float = _row(
        "px/K",
        "shift of both cameras' principal points as they warm, per axis; the focal length follows by 1e-5 per K",
        "Elias et al., Sensors 2020, 20, 643, for the kind of effect; size assumed for a metal housing",
    )
    grasp: float = _row("m", "1 sigma of the part's place in the claw; 10 mrad per mm of turn", "assumed")
    late_stamps: float = _row("s", "most that a camera's time stamps are late; even from 0", "assumed")
    rolling_shutter: float = _row("s", "from the first row's exposure to the last one's", "CMOS sensors, 10 to 30 ms")
    texture: float = _row(
        "1", "RMS of the surface's albedo, in grains of 0.3 and 1 mm", "cast or ground metal, assumed"
    )
    gloss: float = _row("1", "light mirrored towards the camera, of that scattered", "half-matt metal; assumed")
    dust: float = _row("1", "spots per cm² on the surface, and shadows on the laser's window", "assumed")
    sheet_ends: float = _row("rad", "angle from the fan's middle at which it fades out", "fan angle of a line laser")
    sunlight: float = _row("1", "light of the sun's patch, of the room's; it moves over table and board", "assumed")
    droop: float = _row(
        "m",
        "how far the scan head's carriage has sunk, along the camera's axis, at the far end of its travel: as the "
        "square of its way; it rolls about the way by 10 mrad per mm",
        "a carriage on one guide, worn where it works; size assumed",
    )

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Every effect."""
        return tuple(f.name for f in dataclasses.fields(cls))

    def assumed_noise(self) -> dict[str, dict[str, float | str]]:
        """Every effect that is on, with its size, unit and meaning."""
        return {
            f.name: {
                "sigma": getattr(self, f.name),
                "unit": f.metadata["unit"],
                "of": f.metadata["meaning"],
            }
            for f in dataclasses.fields(self)
            if getattr(self, f.name)
        }


NONE = Effects()
WORKSHOP = Effects(
    factory_arm=1e-3,
    joint_harmonics=0.07e-3,
    path_memory=0.5,
    sag=3e-6,
    rocking=0.1e-3,
    sheet_bow=0.02e-3,
    laser_pointing=50e-6,
    camera_warm_up=0.01,
    grasp=0.1e-3,
    late_stamps=2e-3,
    texture=0.10,
    gloss=0.3,
    dust=1.0,
    sheet_ends=0.17,
    sunlight=0.4,
)
"""All of them together; a rolling shutter and a carriage that droops are options that are added by their names."""
ALONE = dataclasses.replace(WORKSHOP, rolling_shutter=10e-3, droop=0.1e-3)
"""The size of each when it is added alone."""
WARMING_K, WARMING_S = 10.0, 1200.0
"""How much warmer laser and cameras become after they are switched on, and in what time (1/e)."""


def only(*names: str) -> Effects:
    """Just the effects named; ValueError that lists them for a name that is none."""
    unknown = [name for name in names if name not in Effects.names()]
    if unknown:
        raise ValueError(f"unknown effect {unknown[0]!r}: choose of {', '.join(Effects.names())}")
    return dataclasses.replace(NONE, **{name: getattr(ALONE, name) for name in names})
