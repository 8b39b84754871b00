"""A cell of real devices and simulated ones: which mixes make sense, and the world that follows the real ones.

A real camera sees the real cell, in which nothing follows a simulated device: what it would need of those is refused.
"""

import logging
import threading
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from cell.config.cell_config import DEVICES, CellConfig, find_config, load_config
from cell.devices.assembly import connect
from cell.devices.gate.gated import TRIES, GatedArm, GatedCamera
from cell.devices.lock import CellLock
from cell.devices.simulated.following import DeviceFollowing
from cell.devices.simulated.process import SimulatedCell, WorldConnector, WorldLink, on_gige, with_endpoints
from drivers.arm.make import ArmOutputClawConfig, ArmOutputLaserConfig
from drivers.clock import Clock
from drivers.errors import Aborted, CellError, ConfigError
from drivers.interfaces import ArmMotion, ArmState, Device, Vector
from drivers.switches import ArmSwitchedClaw, ArmSwitchedLaser

Sim = str | Sequence[str] | None
"""What may be asked for: "all", "none", names of devices in one text or in a list, or None for what `cell.sim` has."""

NEEDS = {"scan_camera": ("arm", "rail", "vehicle", "laser", "target_camera"), "target_camera": ("arm", "vehicle")}
"""What has to be real where a camera is real: it carries the camera, lights its picture or finds its station."""


def named(sim: Sim) -> tuple[str, ...] | None:
    """The devices that `sim` asks to simulate, in the cell's order; None where it leaves that to the configuration.
    Raises `ConfigError` for a name that is none."""
    if sim is None:
        return None
    names = [word.strip() for word in sim.split(",") if word.strip()] if isinstance(sim, str) else list(sim)
    if names == ["all"]:
        return tuple(DEVICES)
    if names == ["none"]:
        return ()
    if unknown := [name for name in names if name not in DEVICES]:
        raise ConfigError(
            f'sim: there is no device {", ".join(map(repr, unknown))}; write "all", "none", or some of '
            f"{', '.join(DEVICES)}"
        )
    return tuple(name for name in DEVICES if name in names)


def simulated_of(sim: Sim, config: Path | None) -> tuple[str, ...]:
    """As `named`, else what `cell.sim` of this configuration's file names. Raises `ConfigError`."""
    if (names := named(sim)) is not None:
        return names
    return named(load_config(find_config(config)).cell.sim) or ()


def require_possible(config: CellConfig, simulated: Collection[str], needed: Collection[str]) -> None:
    """Raise `ConfigError`, a line each, for what physics does not allow: these devices simulated, the others that
    are `needed` real."""
    problems = []
    for name in needed:
        if name in simulated:
            continue
        if config.make(name).on_arm and "arm" in simulated:
            problems.append(f"{name} is real and hangs on the arm's output, and the arm is simulated")
        if missing := [other for other in NEEDS.get(name, ()) if other in simulated]:
            problems.append(
                f"{name} is real: its pictures show nothing of what {', '.join(missing)} only simulated would do"
            )
    if problems:
        raise ConfigError(
            f"these devices cannot be simulated beside the others: {', '.join(simulated)}\n  "
            + "\n  ".join(problems)
            + "\nSimulate the first named of each line as well, or have the others real"
        )


def followed(config: CellConfig, simulated: Collection[str], needed: Collection[str]) -> tuple[str, ...]:
    """The real devices that the simulated world follows: those that move or light its pictures."""
    kinds = ("arm", "rail", "vehicle", "laser", "claw")
    return tuple(name for name in needed if name in kinds and name not in simulated and not config.make(name).on_arm)


def beware(simulated: Collection[str], needed: Collection[str]) -> list[str]:
    """What a person has to know before real devices move beside simulated ones; one sentence each."""
    real = [name for name in needed if name not in simulated]
    told = [f"simulated: {', '.join(simulated)}; real: {', '.join(real)}"]
    if "arm" in real and "scan_camera" in simulated:
        told.append(
            "the real arm moves by simulated pictures and puts down where the simulated surface is: keep the place "
            "clear. Touch is what it feels and what the simulated part would"
        )
    if "arm" in real and "vehicle" in simulated:
        told.append("the vehicle's brake is simulated: see that what the real arm stands on cannot roll")
    if "vehicle" in real and "arm" in simulated:
        told.append("the arm's posture is simulated: see that a real one on the vehicle is folded, or not there")
    if "claw" in simulated and "arm" in real:
        told.append("the claw is simulated: what a real one holds, it keeps")
    if "target_camera" in simulated and "vehicle" in real:
        told.append(
            "the real vehicle drives by a simulated board: it was taken to stand at the job's start when the cell was "
            "opened"
        )
    return told


log = logging.getLogger(__name__)


class SimulatedTouch:
    """Adds the simulated wrench to a real arm's, and ends its guarded motions at it."""

    def __init__(self, following: DeviceFollowing) -> None:
        self._following = following
        self._zero: Vector = np.zeros(6)

    def zero(self) -> None:
        """Take the present simulated wrench as zero, too."""
        self._zero = self._following.wrench()

    def felt(self, state: ArmState) -> ArmState:
        """The state with the newest simulated wrench in it."""
        return replace(state, wrench=state.wrench + self._following.wrench() - self._zero)

    def recorded(self, states: list[ArmState]) -> None:
        """Put into each of these states the simulated wrench that held at its time."""
        found = self._following.wrenches_at(states)
        states[:] = [
            replace(state, wrench=state.wrench + wrench - self._zero)
            for state, wrench in zip(states, found, strict=True)
        ]

    def guard(self, motion: ArmMotion, limit: float, stop: Callable[[], None]) -> ArmMotion:
        """The same motion, ended by `stop` as soon as the simulated force has changed by `limit` N."""
        return _Guarded(motion, limit, stop, self._following)


class _Guarded:
    """A motion that ends at its own contact or at a simulated one; see `drivers.interfaces.ArmMotion`."""

    def __init__(self, motion: ArmMotion, limit: float, stop: Callable[[], None], following: DeviceFollowing) -> None:
        self._motion, self._limit, self._stop, self._following = motion, limit, stop, following
        self._touched = False
        self._start = following.wrench()[:3]
        self._watch = threading.Thread(target=self._poll, name="simulated touch", daemon=True)
        self._watch.start()

    @property
    def done(self) -> bool:
        return self._motion.done

    @property
    def contact(self) -> bool:
        return self._touched or self._motion.contact

    def wait(self, timeout: float) -> None:
        """See `drivers.interfaces.Motion`."""
        try:
            self._motion.wait(timeout)
        except Aborted:
            if not self._touched:
                raise
        self._watch.join(timeout)

    def _poll(self) -> None:
        while not self._motion.done:
            if np.linalg.norm(self._following.next_wrench()[:3] - self._start) >= self._limit:
                self._touched = True
                try:
                    self._stop()
                except CellError as error:
                    log.error("the arm was to stop at a simulated contact: %s", error)
                return


class MixedCell:
    """Opened: `config` with the simulated devices' addresses, the `lock` that is held, `devices`, the `world`."""

    def __init__(
        self, undo: ExitStack, config: CellConfig, job: str | Path, seed: int, level: str, simulated: tuple[str, ...],
        needed: Collection[str],
    ) -> None:  # fmt: skip
        """Simulate these of the `needed` devices and connect the others; what is to be undone goes to `undo`. Raises
        `ConfigError` for a mix that physics does not allow, else as `connect` and `DeviceFollowing`."""
        from cell.devices.simulated.described import Described

        require_possible(config, simulated, needed)
        real = followed(config, simulated, needed)
        self.world = SimulatedCell(
            config, Described.of(job), seed=seed, level=level, speed=config.cell.time_scale,
            gige=[name for name in on_gige(config) if name in simulated], simulated=simulated, follow=real,
        )  # fmt: skip
        undo.callback(self.world.close)
        addressed = [name for name in simulated if not config.make(name).on_arm or "arm" in simulated]
        self.config = with_endpoints(config, self.world.endpoints, addressed)
        self.lock = undo.enter_context(CellLock(self.config, needed))
        link = self.world.link

        def otherwise(name: str, clock: Clock) -> Device | None:
            if name not in simulated:
                return None
            return None if "arm" in simulated else _switched(self.config, name, link, clock)

        self.devices = connect(self.config, needed, otherwise)
        undo.callback(self.devices.close)
        if link is not None:
            for device in self.devices:
                if isinstance(device, GatedCamera) and device.name in simulated:
                    device.tries = TRIES
            following = DeviceFollowing(link, self.devices, config, real, simulated)
            self.devices.following = following
            arm = self.devices.arm if "arm" in real else None
            if isinstance(arm, GatedArm) and "scan_camera" in simulated:
                arm.touch = SimulatedTouch(following)
        for sentence in beware(simulated, needed):
            log.warning("%s", sentence)


def _switched(config: CellConfig, name: str, link: WorldLink | None, clock: Clock) -> Device | None:
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
