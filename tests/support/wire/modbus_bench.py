"""A simulated Modbus drive of a register map, and the rail connected to it."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.clock import Clock
from drivers.rail.modbus.make import ModbusRailConfig
from drivers.rail.modbus.rail import ModbusRail
from sim_backends.clock import WorldClock
from sim_backends.models.rail import RailModel, RailParams
from sim_backends.peers.rail.modbus_drive import ModbusDriveServer, ModbusPeer
from tests.support.modbus_maps import RAIL

UNIT, SPEED = 7, 5.0


def config(registers: dict[str, Any], **changed: Any) -> ModbusRailConfig:
    return ModbusRailConfig.model_validate({**RAIL, "unit": UNIT, "registers": registers, **changed})


@dataclass
class Drive:
    """A simulated drive of one map, and how a rail is connected to it."""

    record: ModbusRailConfig
    model: RailModel
    peer: ModbusPeer
    clock: Clock

    @classmethod
    def of(cls, record: ModbusRailConfig, *, pty: bool = False, echo: bool = False) -> "Drive":
        world = WorldClock(SPEED)
        params = RailParams(steps_per_turn=record.counts_per_turn, start=0.02, serial=4711)
        model = RailModel(params, np.random.default_rng(1))
        drive = ModbusDriveServer(model, world, record.model_dump(mode="json"))
        peer = ModbusPeer(drive, UNIT, pty=pty, echo=echo)
        peer.start()
        return cls(record, model, peer, Clock(SPEED))

    def rail(self, url: str | None = None, *, control: bool = True, **changed: Any) -> ModbusRail:
        record = self.record.model_copy(update={"url": url or self.peer.url, **changed})
        return ModbusRail("rail", record, clock=self.clock, control=control)

    def homed(self, **how: Any) -> ModbusRail:
        rail = self.rail(**how)
        rail.home().wait(60.0)
        return rail
