"""What a rail is made of, and what its controller can be told: the data of the rail's model."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from sim_backends.models.screw import Screw


@dataclass(frozen=True)
class RailParams:
    """Hardware of one rail. Lengths in m from where the home switch's edge is; the left and right switches and the
    mechanical ends lie beyond the usable travel. `repeatability` is the scatter (1 σ) of a switch edge per search."""

    screw: Screw = field(default_factory=Screw)
    steps_per_turn: int = 200
    travel: tuple[float, float] = (0.0, 0.100)
    switches: tuple[float, float] = (-0.002, 0.102)
    ends: tuple[float, float] = (-0.004, 0.104)
    repeatability: float = 0.0
    start: float = 0.037
    reversed: bool = False
    """A coil of the motor is connected the other way round: it turns backwards."""
    serial: int = 1
    firmware: tuple[int, int] = (1, 12)

    def around(self, travel: tuple[float, float]) -> RailParams:
        """The same for a usable `travel`, m: the home switch at 0, the others 2 mm and the ends 4 mm beyond both."""
        low, high = min(0.0, travel[0]), max(0.0, travel[1])
        return replace(self, travel=travel, switches=(low - 0.002, high + 0.002), ends=(low - 0.004, high + 0.004))


@dataclass(frozen=True)
class RailSettings:
    """What the controller's axis parameters set: pps and pps² (microsteps), switches, reference search."""

    max_velocity: int = 512_000
    max_acceleration: int = 2_000_000
    max_deceleration: int | None = None
    """Of positioning; None: the acceleration."""
    first_acceleration: int = 2_000_000
    last_deceleration: int = 2_000_000
    first_speed: int = 0
    """Below this speed (pps) positioning uses the two above instead; 0 switches that off."""
    microsteps: int = 8
    """Microsteps per full step as a power of two."""
    search_mode: int = 1
    """1 left switch; 2 right, then left switch; 3, 4 the same; 5 or 7 home switch in negative direction; 6 the same
    from the right switch."""
    search_speed: int = 256_000
    switch_speed: int = 51_200
    left_stop: bool = True
    right_stop: bool = True
    soft_stop: bool = False
    reverse_shaft: bool = False
