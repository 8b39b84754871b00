"""The CANopen bus with this program as its master: values of the drives by SDO, NMT, SYNC, and who else commands there.

The SDO protocol is the `canopen` package's; its frames go over the same `CanLink` as all the others.
"""

import logging
import struct
import threading
from collections.abc import Callable
from typing import TypeVar

import can
import canopen
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from drivers.errors import DeadlineError, DeviceFault
from drivers.interfaces import LinkStatistics
from drivers.vehicle.can_link import CanLink, data_frame
from drivers.vehicle.cia402.drive import (
    COMMAND,
    EMERGENCY,
    HEALTH,
    HEARTBEAT,
    MOTION,
    NMT,
    SDO_REPLY,
    SDO_REQUEST,
    STATUS,
    SYNC,
    Entry,
)
from drivers.vehicle.faults import OUT_OF_COMMAND, vehicle_fault

Answer = TypeVar("Answer")

SETUP = "vehicle.setup"
TOLD_ONCE = (*OUT_OF_COMMAND, "vehicle.units")
"""Codes of faults that end command: whoever is in charge afterwards is no fault of the vehicle."""


def unfit(name: str, what: str) -> DeviceFault:
    """A drive that cannot be used as it is."""
    return vehicle_fault(name, SETUP, what)


ANSWER_S = 0.5
"""For one answer by SDO, on the wall."""
_TRIES = 2
_ABSENT = (0x06020000, 0x06090011, 0x06010000)
"""Abort codes of a value that a drive does not have."""
_READ_ONLY = 0x06010002
_SET_TWO_BYTES = 0x2B
_FROM_DRIVES = (EMERGENCY, STATUS, MOTION, HEALTH, HEARTBEAT)
_FROM_MASTERS = (COMMAND, 0x300, 0x400, 0x500)

# Every answer that does not come is raised; the package's own lines would say it once more.
logging.getLogger("canopen").setLevel(logging.CRITICAL)


class Absent(Exception):
    """The drive has no such value, or does not let it be written."""


class CanopenBus(CanLink):
    """An open bus with the drives `nodes` and this program as node `own`.

    In the receive thread `take` is called with a node, the service (the identifier without the node) and the data of
    each frame that a drive sends by itself, `other` with words for each frame by which somebody else commands, and
    `idle` as `CanLink` does. Raises what `CanLink` does.
    """

    def __init__(
        self, name: str, interface: str, channel: str, *, bitrate: int, own: int,
        nodes: tuple[int, int], take: Callable[[int, int, bytes], None], other: Callable[[str], None],
        idle: Callable[[float], None], statistics: LinkStatistics, alone: str,
    ) -> None:  # fmt: skip
        self.name = name
        self._own = own
        self._nodes = nodes
        self._take_from, self._other = take, other
        self._nodes_heard: set[int] = set()
        self._asking = threading.Lock()
        self._network = _Network(self)
        self._clients: dict[int, SdoClient] = {}
        for node in nodes:
            # Values are asked for by their numbers: nothing of an object dictionary is needed.
            remote = canopen.RemoteNode(node, canopen.ObjectDictionary())  # type: ignore[no-untyped-call]
            self._network.add_node(remote)
            self._clients[node] = remote.sdo
            remote.sdo.RESPONSE_TIMEOUT = ANSWER_S
        super().__init__(
            name, interface, channel, bitrate=bitrate, receive=self._take, idle=idle,
            statistics=statistics, alone=alone,
        )  # fmt: skip

    def send(self, identifier: int, data: bytes) -> None:
        """Send a frame; raises as `check` does."""
        self.send_frame(data_frame(identifier, data), f"0x{identifier:03X}")

    def guard(self, node: int) -> None:
        """Ask a node for its NMT state, as node guarding does."""
        frame = can.Message(arbitration_id=HEARTBEAT + node, is_remote_frame=True, dlc=1, is_extended_id=False)
        self.send_frame(frame, "node guarding")

    def command(self, node: int, command: int) -> None:
        """Send an NMT command to one node."""
        self.send(NMT, bytes((command, node)))

    def sync(self) -> None:
        """Have the drives tell their state."""
        self.send(SYNC, b"")

    def read(self, node: int, entry: Entry) -> int:
        """A value of a drive. Raises `Absent`, `DeviceFault` for a refusal, `DeadlineError` when no answer comes."""
        try:
            return entry.unpack(self._ask(node, str(entry), lambda sdo: sdo.upload(entry.index, entry.sub)))
        except struct.error as error:
            raise unfit(self.name, f"the drive with node number {node} tells {entry} in too few bytes") from error

    def read_if_there(self, node: int, entry: Entry) -> int | None:
        """A value that not every drive has; None when this one has not. Raises as `read` does."""
        try:
            return self.read(node, entry)
        except Absent:
            return None

    def text(self, node: int, index: int, sub: int) -> str:
        """A text of a drive, "" when it has none. Raises as `read` does."""
        try:
            told = self._ask(node, f"{index:04X}h", lambda sdo: sdo.upload(index, sub))
        except Absent:
            return ""
        return bytes(told).split(b"\0")[0].decode("ascii", "replace").strip()

    def write(self, node: int, entry: Entry, value: int) -> None:
        """Set a value of a drive. Raises as `read` does; `Absent` also for one that cannot be written."""
        self._ask(node, f"{entry} = {value}", lambda sdo: sdo.download(entry.index, entry.sub, entry.pack(value)))

    def post(self, node: int, entry: Entry, value: int) -> None:
        """Set a value of two bytes without waiting for the answer. Raises as `check` does."""
        request = struct.pack("<BHB2s2x", _SET_TWO_BYTES, entry.index, entry.sub, entry.pack(value))
        self.send(SDO_REQUEST + node, request)

    def _ask(self, node: int, what: str, ask: Callable[[SdoClient], Answer]) -> Answer:
        for tries in range(_TRIES):
            try:
                with self._asking:
                    return ask(self._clients[node])
            except SdoAbortedError as refusal:
                if refusal.code in (*_ABSENT, _READ_ONLY):
                    raise Absent(f"node {node}: {what}: {refusal}") from refusal
                raise unfit(self.name, f"the drive with node number {node} refuses {what}: {refusal}") from refusal
            except struct.error as error:
                raise unfit(self.name, f"the drive with node number {node} answers {what} in too few bytes") from error
            except SdoCommunicationError as silence:
                self.check()
                self._statistics.count("timeouts")
                if tries == _TRIES - 1:
                    heard = ", ".join(map(str, sorted(self._nodes_heard))) or "none"
                    raise DeadlineError(
                        self.name,
                        f"node {node} does not answer for {what} within {ANSWER_S} s; nodes heard on this bus: "
                        f"{heard}. See that the drive is on, its node number and bit rate are those of cell.toml, and "
                        "no second master asks it",
                    ) from silence
        raise AssertionError

    def _take(self, frame: can.Message) -> None:
        if frame.is_extended_id:
            return
        identifier, data = frame.arbitration_id, bytes(frame.data)
        service, node = identifier & 0x780, identifier & 0x7F
        if node and service in _FROM_DRIVES:
            self._nodes_heard.add(node)
        if frame.is_remote_frame:
            if service == HEARTBEAT and node in self._nodes:
                self._other(f"somebody else guards node {node}")
            return
        if node in self._nodes and service == SDO_REPLY:
            self._network.notify(identifier, bytearray(data), frame.timestamp)
        elif node in self._nodes and service in _FROM_DRIVES:
            self._take_from(node, service, data)
        elif words := self._commanded(identifier, service, node, data):
            self._other(words)

    def _commanded(self, identifier: int, service: int, node: int, data: bytes) -> str:
        """What somebody else commands by this frame; "" when it commands nothing."""
        if identifier == NMT and len(data) == 2 and data[1] in (0, *self._nodes):
            return f"somebody else on the CAN bus sends NMT command {data[0]:02X}h to node {data[1] or 'all'}"
        if identifier == SYNC:
            return "somebody else on the CAN bus sends SYNC"
        if service == HEARTBEAT and node == self._own:
            return f"another node on the CAN bus has the number {node} of this program (vehicle.own_node)"
        if node not in self._nodes:
            return ""
        if service in _FROM_MASTERS:
            return f"somebody else on the CAN bus commands node {node}"
        if service == SDO_REQUEST and data and data[0] >> 5 == 1:
            return f"somebody else on the CAN bus sets values of node {node}"
        return ""


class _Network(canopen.Network):
    """The package's network without a bus of its own."""

    def __init__(self, bus: CanopenBus) -> None:
        super().__init__()
        self._over = bus

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._over.send(can_id, bytes(data))
