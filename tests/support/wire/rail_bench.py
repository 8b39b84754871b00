"""A rail's driver on the wire of a simulated TMCL module, beside the truth of its carriage."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.clock import Clock
from drivers.common.units import KEPT
from drivers.rail.tmcl.make import TmclRailConfig
from drivers.rail.tmcl.rail import TmclRail
from sim_backends.clock import WorldClock
from sim_backends.models.rail import RailModel, RailParams
from sim_backends.peers.rail.tmcl import TmclPeer
from tests.support.wire.clocks import ahead

SPEED, MAX_SPEED, ACCELERATION = 5.0, 0.05, 0.25


@dataclass
class Bench:
    """A rail on its wire: the driver, the carriage's truth and the two clocks' difference."""

    rail: TmclRail
    model: RailModel
    peer: TmclPeer
    world: WorldClock
    clock: Clock

    def carriage(self, host_time: float | None = None) -> float:
        """True place of the carriage in m, at a host time of the past or now."""
        if host_time is None:
            return self.model.carriage(self.world.now())
        return self.model.carriage(host_time - ahead(self.clock, self.world))


def connect(url: str, clock: Clock, *, control: bool = True, **changed: Any) -> TmclRail:
    """The rail at `url`, its record changed so; lengths in m."""
    record = {
        "url": url, "lead": 0.002, "steps_per_turn": 200, "microsteps": 256, "travel": (0.0, 0.1),
        "max_speed": MAX_SPEED, "acceleration": ACCELERATION,
    }  # fmt: skip
    made = TmclRailConfig.model_validate(record, context=KEPT).model_copy(update=changed)
    return TmclRail("rail", made, clock=clock, control=control)


def telegram(command: int, kind: int, value: int) -> bytes:
    """A request to the module at address 1, motor 0."""
    body = bytes([1, command, kind, 0]) + value.to_bytes(4, "big", signed=True)
    return body + bytes([sum(body) & 0xFF])


@contextmanager
def benched(speed: float = SPEED, params: RailParams | None = None, **how: Any) -> Iterator[Bench]:
    """The bench at `speed`, its rail connected as `how` says and closed in the end."""
    world, clock = WorldClock(speed), Clock(speed)
    model = RailModel(params or RailParams(start=0.02), np.random.default_rng(3))
    peer = TmclPeer(model, world)
    peer.start()
    try:
        with closing(connect(peer.url, clock, **how)) as rail:
            yield Bench(rail, model, peer, world, clock)
    finally:
        peer.stop()


def reply(request: bytes, value: int = 0, status: int = 100) -> bytes:
    if request[1] == 136:
        return b"\x021260V112"
    body = bytes([2, request[0], status, request[1]]) + value.to_bytes(4, "big", signed=True)
    return body + bytes([sum(body) & 0xFF])
