"""The make `tmcl` of rails: its record in `cell.toml`, and how it is connected."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self

from pydantic import StrictBool, model_validator

from drivers.common.addresses import Port
from drivers.common.units import whole
from drivers.make import AnyMake, Make, RailConfig, Surroundings, with_endpoint

if TYPE_CHECKING:
    from drivers.rail.tmcl.rail import TmclRail

MODULE_COUNTS = 2**31 - 1
"""Microsteps to which the rail's module counts, positions and microsteps per second alike."""

BAUDS = (9600, 14400, 19200, 28800, 38400, 57600, 76800, 115200, 230400, 250000, 500000, 1_000_000)
"""What the rail's module can be set to (its global parameter 65); over USB none of them matters."""
REFERENCE_MODES = (*range(1, 9), *range(65, 69), *range(133, 137))
"""Axis parameter 193 of the rail's module; +64 swaps left and right, +128 is for a home switch that opens."""
MODES_TOLD = (
    ": 1 left limit switch, 2 right then left, 3 right then both sides of the left, 4 both sides of the left, 5 home "
    "switch in negative direction turning at the left switch, 6 in positive direction turning at the right, 7 and 8 "
    "the same without the limit switches; 64 more swaps the sides of 1-4, 128 more for a home switch 5-8 that opens"
)


class TmclRailConfig(RailConfig):
    """A stepper rail on a TMCL module on a serial line."""

    ADDRESS: ClassVar[str] = "url"

    driver: Literal["tmcl"] = "tmcl"
    url: Annotated[str, Port]
    address: Annotated[int, whole(1, 255)] = 1
    motor: Annotated[int, whole(0, 5)] = 0
    steps_per_turn: Annotated[int, whole(20, 2000)]
    microsteps: Annotated[int, whole(1, 256, allowed=(1, 2, 4, 8, 16, 32, 64, 128, 256))]
    baud: Annotated[int, whole(9600, 1_000_000, allowed=BAUDS)] = 9600
    reference_mode: Annotated[int, whole(1, 255, allowed=REFERENCE_MODES, meaning=MODES_TOLD)] = 5
    reversed: StrictBool = False

    @property
    def counted(self) -> tuple[int, int]:
        return self.steps_per_turn, self.microsteps

    @property
    def turned_round(self) -> bool:
        return self.reversed

    @model_validator(mode="after")
    def _countable(self) -> Self:
        low, high = self.travel
        counts = self.steps_per_turn * self.microsteps / self.lead
        for name, value in (
            ("travel", max(-low, high)),
            ("max_speed", self.max_speed),
            ("acceleration", self.acceleration),
        ):
            if value * counts > MODULE_COUNTS:
                raise ValueError(
                    f"{name} would be {value * counts:.3g} microsteps with this lead, steps_per_turn and microsteps; "
                    f"the module counts to {MODULE_COUNTS}. Use fewer microsteps"
                )
        return self


def _connect(name: str, config: TmclRailConfig, around: Surroundings) -> TmclRail:
    from drivers.rail.tmcl.rail import TmclRail

    return TmclRail(name, config, clock=around.clock, control=not around.look)


TMCL: AnyMake = Make(
    "rail", "tmcl", TmclRailConfig, _connect, frozenset(("lead", "steps_per_turn", "microsteps")),
    calibrated_since=frozenset(("reference_mode", "reversed")), simulated=with_endpoint("url"),
)  # fmt: skip
