"""The make `canopen` of vehicles, two wheel drives of CiA 402: its record in `cell.toml`, and how it is connected.

Which CANopen nodes are on the configured bus: the configured ones are asked who they are, the others only heard.

One question to each configured number, which changes nothing in a drive; no network command, no synchronisation.
Source: CiA 301, predefined connection set and SDO upload."""

from __future__ import annotations

import importlib.util
import math
import struct
import threading
import time
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self

from pydantic import model_validator

from drivers.common.units import number, quantity, whole
from drivers.errors import CellError
from drivers.interfaces import LinkStatistics
from drivers.make import AnyMake, Make, Surroundings, with_endpoint
from drivers.vehicle.cia402.drive import (
    DEVICE_TYPE,
    DRIVE_PROFILE,
    HEARTBEAT,
    PRODUCT,
    SDO_REPLY,
    SDO_REQUEST,
    VENDOR,
    Entry,
)
from drivers.vehicle.make import CanVehicleConfig

if TYPE_CHECKING:
    import can

    from drivers.vehicle.can_link import CanLink
    from drivers.vehicle.cia402.feedback import WheelDrives
    from drivers.vehicle.cia402.vehicle import CanopenVehicle


COARSEST_SPEED = 0.002
"""Largest speed of a wheel's rim, m/s, that one step of a drive's velocity may be: the vehicle creeps at 15 mm/s."""
COARSEST_COUNT = 0.0005
"""Largest way of a wheel's rim, m, that one count may be."""

Node = Annotated[int, whole(1, 127)]
Bit = Annotated[int, whole(0, 31)]


class CanopenVehicleConfig(CanVehicleConfig):
    """Two wheel drives, left and right, of CiA 402; docs/how-to/canopen.md explains each key."""

    CAUTION: ClassVar[str] = (
        "never run on a real drive: the first time with the wheels off the floor, and look which way each turns"
    )

    # Two driven wheels slide by far less sideways than four.
    SLIDES: ClassVar[bool] = False
    MODEL: ClassVar[str] = "CiA 402"

    driver: Literal["canopen"] = "canopen"
    left_node: Node
    right_node: Node
    own_node: Node = 127
    wheel_radius: Annotated[float, quantity("mm", 20, 1000)]
    gear: Annotated[float, number(0.1, 1000)]
    counts_per_turn: Annotated[int, whole(4, 16_777_216)]
    velocity_unit: Literal["counts/s", "rpm", "0.1 rpm", "0.01 rpm", "0.001 rpm"]
    left_reversed: bool = False
    right_reversed: bool = True
    acceleration: Annotated[float, quantity("m/s^2", 0.05, 3)]
    deceleration: Annotated[float, quantity("m/s^2", 0.3, 5)]
    guarding: Literal["heartbeat", "node"] = "heartbeat"
    watchdog: Annotated[float, quantity("ms", 100, 1000)] = 0.5
    brake: Literal["drive", "output"] = "drive"
    brake_bit: Bit = 16
    brake_locks: Literal["low", "high"] = "low"
    stop_input: Bit | None = None
    stop_pressed: Literal["low", "high"] = "high"

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if len({self.left_node, self.right_node, self.own_node}) < 3:
            raise ValueError(
                f"left_node {self.left_node}, right_node {self.right_node} and own_node {self.own_node}: each node on "
                "the bus has a number of its own"
            )
        wheels = self.wheels()
        if wheels.velocity_step > COARSEST_SPEED:
            raise ValueError(
                f'velocity_unit = "{self.velocity_unit}" is {1e3 * wheels.velocity_step:.3g} mm/s at the wheel with '
                f"this gear and wheel_radius (allowed: at most {1e3 * COARSEST_SPEED:g} mm/s); set the drives to a "
                "finer unit"
            )
        if wheels.count_length > COARSEST_COUNT:
            raise ValueError(
                f"counts_per_turn {self.counts_per_turn} is {1e3 * wheels.count_length:.3g} mm of the wheel's way per "
                f"count (allowed: at most {1e3 * COARSEST_COUNT:g} mm); is it per turn of the motor, each edge counted?"
            )
        fastest = (self.max_speed + 0.5 * self.track * self.max_yaw_rate) / wheels.velocity_step
        if fastest >= 2**31:
            raise ValueError(f"max_speed would be {fastest:.3g} units of velocity; a drive takes up to {2**31 - 1}")
        turns = (self.max_speed + 0.5 * self.track * self.max_yaw_rate) * self.gear / (2 * math.pi * self.wheel_radius)
        if 60.0 * turns > MOST_RPM:
            raise ValueError(
                f"max_speed and max_yaw_rate ask {60.0 * turns:.0f} turns a minute of a motor (allowed: at most "
                f"{MOST_RPM:g}); is gear turns of the motor per turn of the wheel?"
            )
        return self

    @property
    def count_length(self) -> float:
        return self.wheels().count_length

    def wire(self) -> dict[str, object]:
        keys = {
            "left_node", "right_node", "wheel_radius", "gear", "counts_per_turn", "velocity_unit", "left_reversed",
            "right_reversed",
        }  # fmt: skip
        lines = {
            "brake_bit": self.brake_bit if self.brake == "output" else None,
            "brake_locks": self.brake_locks == "high",
            "stop_bit": self.stop_input,
            "stop_active": self.stop_pressed == "high",
        }
        return {"make": self.driver, **self.model_dump(include=keys), **lines}

    def answers(self) -> tuple[str, bool]:
        return look_at_nodes(self)

    def wheels(self) -> WheelDrives:
        """The drives as their driver takes them."""
        from drivers.vehicle.cia402.feedback import WheelDrives

        return WheelDrives(
            nodes=(self.left_node, self.right_node), wheel_radius=self.wheel_radius, gear=self.gear,
            counts=self.counts_per_turn, velocity_unit=self.velocity_unit,
            reversed=(self.left_reversed, self.right_reversed), track=self.track, acceleration=self.acceleration,
            deceleration=self.deceleration, brake_output=self.brake_bit if self.brake == "output" else None,
            brake_locks=self.brake_locks == "high", stop_input=self.stop_input, stop_active=self.stop_pressed == "high",
        )  # fmt: skip


MOST_RPM = 20_000.0
"""Of a motor that drives a wheel."""


def _connect(name: str, config: CanopenVehicleConfig, around: Surroundings) -> CanopenVehicle:
    from drivers.vehicle.cia402.setup import Watchdog
    from drivers.vehicle.cia402.vehicle import CanopenVehicle

    return CanopenVehicle(
        name, config.interface, config.channel, wheels=config.wheels(),
        watchdog=Watchdog(config.guarding, config.watchdog, config.own_node), max_speed=config.max_speed,
        max_yaw_rate=config.max_yaw_rate, clock=around.clock, bitrate=round(config.bitrate), look=around.look,
    )  # fmt: skip


def _missing() -> str:
    return "" if importlib.util.find_spec("canopen") else "pip install 'assembly-cell[canopen]'"


CANOPEN: AnyMake = Make(
    "vehicle", "canopen", CanopenVehicleConfig, _connect,
    simulated=with_endpoint("interface", "channel"), missing=_missing,
)  # fmt: skip


LISTEN_S, ANSWER_S = 1.2, 0.5
"""Wall seconds: a heartbeat comes once a second on most drives as they are shipped."""
_UPLOAD, _ABORT = 0x40, 0x80


def look_at_nodes(record: CanopenVehicleConfig) -> tuple[str, bool]:
    """What is on the vehicle's bus, in words, and whether both configured nodes are drives of CiA 402."""
    from drivers.vehicle.can_link import CanLink

    heard: dict[int, dict[int, bytes]] = {}
    news = threading.Condition()

    def take(frame: can.Message) -> None:
        service, node = frame.arbitration_id & 0x780, frame.arbitration_id & 0x7F
        if frame.is_extended_id or frame.is_remote_frame or not node or service not in (SDO_REPLY, HEARTBEAT):
            return
        with news:
            heard.setdefault(node, {})[service] = bytes(frame.data)
            news.notify_all()

    try:
        link = CanLink(
            "vehicle", record.interface, record.channel, bitrate=round(record.bitrate), receive=take,
            idle=lambda seconds: None, statistics=LinkStatistics(), alone="nothing on it was set",
        )  # fmt: skip
        try:
            begun = time.monotonic()
            nodes = (record.left_node, record.right_node)
            told = [_told(link, node, heard, news) for node in nodes]
            with news:
                news.wait_for(lambda: False, max(0.0, LISTEN_S - (time.monotonic() - begun)))
        finally:
            link.close()
    except CellError as error:
        return str(error), False
    texts = [text for text, _ in told]
    if others := sorted(set(heard) - {*nodes, record.own_node}):
        texts.append(f"heard besides: node {', '.join(map(str, others))}")
    if record.own_node in heard:
        texts.append(
            f"node {record.own_node}, which is to be this program's, is taken: choose another vehicle.own_node"
        )
    return "; ".join(texts), all(ok for _, ok in told) and record.own_node not in heard


def _told(link: CanLink, node: int, heard: dict[int, dict[int, bytes]], news: threading.Condition) -> tuple[str, bool]:
    kind = _ask(link, node, DEVICE_TYPE, heard, news)
    if kind is None:
        with news:
            alive = HEARTBEAT in heard.get(node, {})
        why = "is heard but does not answer" if alive else "does not answer"
        return f"node {node} {why}: see its number, its supply and the bit rate", False
    profile = kind & 0xFFFF
    maker = [_ask(link, node, entry, heard, news) for entry in (VENDOR, PRODUCT)]
    who = ", ".join(
        f"{name} {number:#x}" for name, number in zip(("vendor", "product"), maker, strict=True) if number is not None
    )
    text = f"node {node} answers: profile {profile}" + (f" ({who})" if who else "")
    if profile != DRIVE_PROFILE:
        return f"{text}, a drive has {DRIVE_PROFILE}: see vehicle.left_node and right_node", False
    return text, True


def _ask(
    link: CanLink, node: int, entry: Entry, heard: dict[int, dict[int, bytes]], news: threading.Condition
) -> int | None:
    """A value of four bytes or less; None when the node is silent or has no such object."""
    from drivers.vehicle.can_link import data_frame

    with news:
        heard.get(node, {}).pop(SDO_REPLY, None)
    where = struct.pack("<HB", entry.index, entry.sub)
    data = bytes([_UPLOAD]) + where + bytes(4)
    link.send_frame(data_frame(SDO_REQUEST + node, data), str(entry))

    def answer() -> bytes | None:
        reply = heard.get(node, {}).get(SDO_REPLY, b"")
        return reply if len(reply) == 8 and reply[1:4] == where else None

    with news:
        reply = news.wait_for(answer, ANSWER_S)
    if not reply or reply[0] == _ABORT:
        return None
    return int(struct.unpack_from("<I", reply, 4)[0])
