"""A cell of real devices and simulated ones: the world that has the latter, and follows the former."""

from __future__ import annotations

import logging
from collections.abc import Collection
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from cell.config.cell_config import DEVICES, CellConfig
from cell.devices.assembly import connect, connect_one
from cell.devices.gate.gated import GatedArm
from cell.devices.lock import CellLock
from cell.devices.simulated.described import Described
from cell.devices.simulated.followed_camera import FollowedCamera
from cell.devices.simulated.following import DeviceFollowing
from cell.devices.simulated.mix import beware, followed, require_possible
from cell.devices.simulated.process import SimulatedCell, on_gige, with_endpoints
from cell.devices.simulated.touch import SimulatedTouch
from cell.devices.simulated.world_link import WorldConnector, WorldLink
from cell.makes.built_in import ArmOutputClawConfig, ArmOutputLaserConfig
from drivers.clock import Clock
from drivers.errors import ConfigError
from drivers.switches import ArmSwitchedClaw, ArmSwitchedLaser

log = logging.getLogger(__name__)


class MixedCell:
    """Opened: `config` with the simulated devices' addresses, the `lock` that is held, `devices`, the `world`."""

    def __init__(
        self,
        undo: ExitStack,
        config: CellConfig,
        job: str | Path,
        seed: int,
        level: str,
        simulated: tuple[str, ...],
        needed: Collection[str],
    ) -> None:
        """Simulate these of the `needed` devices and connect the others; what is to be undone goes to `undo`.

        Raises `ConfigError` for a mix that physics does not allow, else as `connect` and `DeviceFollowing`.
        """
        require_possible(config, simulated, needed)
        real = followed(config, simulated, needed)
        self.world = SimulatedCell(
            config,
            Described.of(job),
            seed=seed,
            level=level,
            speed=config.cell.time_scale,
            gige=[name for name in on_gige(config) if name in simulated],
            simulated=simulated,
            follow=real,
        )
        undo.callback(self.world.close)
        self.config = with_endpoints(config, self.world.endpoints, _addressed(config, simulated))
        self.lock = undo.enter_context(CellLock(self.config, needed))
        link = self.world.link

        def otherwise(name: str, clock: Clock) -> Any | None:
            if name not in simulated:
                return None
            if link is not None and DEVICES[name] == "camera":
                return FollowedCamera(connect_one(self.config, name, clock))
            return None if "arm" in simulated else _switched(self.config, name, link, clock)

        self.devices = connect(self.config, needed, otherwise)
        undo.callback(self.devices.close)
        if link is not None:
            following = DeviceFollowing(link, self.devices, config, real, simulated)
            self.devices.following = following
            arm = self.devices.arm if "arm" in real else None
            if isinstance(arm, GatedArm) and "scan_camera" in simulated:
                arm.touch = SimulatedTouch(following)
        for sentence in beware(simulated, needed):
            log.warning("%s", sentence)


def _addressed(config: CellConfig, simulated: Collection[str]) -> list[str]:
    """Those of them that are reached at an address of their own, or hang on a simulated arm."""
    return [name for name in simulated if not config.make(name).on_arm or "arm" in simulated]


def _switched(config: CellConfig, name: str, link: WorldLink | None, clock: Clock) -> Any | None:
    """A laser or claw that hangs on the arm's connectors, and is simulated while the arm is real; None for others."""
    if not config.make(name).on_arm:
        return None
    if link is None:
        raise ConfigError(f"{name} is simulated, and no real device moves in its world; simulate the arm as well")
    record, connector = config.device(name), WorldConnector(link)
    match record:
        case ArmOutputLaserConfig():
            return ArmSwitchedLaser(name, connector, record.output)
        case ArmOutputClawConfig():
            return ArmSwitchedClaw(name, connector, record.output, record.feedback, clock=clock)
    raise ConfigError(
        f'{name}.driver = "{record.driver}" hangs on the arm, which is real: nothing simulates it beside a real arm; '
        'name driver = "arm_output" for it'
    )
