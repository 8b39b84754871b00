"""The make `robotiq` of claws: its record in `cell.toml`, and how it is connected."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from drivers.common.addresses import Endpoint
from drivers.common.units import whole
from drivers.make import AnyMake, ClawConfig, Make, Surroundings, with_endpoint

if TYPE_CHECKING:
    from drivers.claw.robotiq import RobotiqClaw

Count = Annotated[int, whole(0, 255, meaning=" as the gripper counts it: 0 open, slowest, weakest; 255 the other end")]


class RobotiqClawConfig(ClawConfig):
    """A Robotiq gripper, on the socket of its program on the arm's controller; `inside`: it holds by spreading.

    Where its fingers are open and where they are sent to hold, how fast they go and how strongly they press: all as the
    gripper counts it.
    """

    driver: Literal["robotiq"] = "robotiq"
    address: Annotated[str, Endpoint]
    open_at: Count = 0
    closed_at: Count = 255
    speed: Count = 128
    force: Count = 64
    inside: bool = False

    def wire(self) -> dict[str, object]:
        return {"make": self.driver, "place": self.address}


def _connect(name: str, config: RobotiqClawConfig, around: Surroundings) -> RobotiqClaw:
    from drivers.claw.robotiq import RobotiqClaw

    return RobotiqClaw(name, config, clock=around.clock, control=not around.look)


ROBOTIQ: AnyMake = Make("claw", "robotiq", RobotiqClawConfig, _connect, simulated=with_endpoint("address"))
