"""Which CANopen nodes are on the configured bus: the configured ones are asked who they are, the others only heard.

One question to each configured number, which changes nothing in a drive; no network command, no synchronisation.
Source: CiA 301, predefined connection set and SDO upload.
"""

from __future__ import annotations

import struct
import threading
import time

import can

from cell.makes.vehicles import CanopenVehicleConfig
from drivers.errors import CellError
from drivers.interfaces import LinkStatistics
from drivers.vehicle.can_link import CanLink
from drivers.vehicle.cia402.objects import (
    DEVICE_TYPE,
    DRIVE_PROFILE,
    HEARTBEAT,
    PRODUCT,
    SDO_REPLY,
    SDO_REQUEST,
    VENDOR,
    Entry,
)

LISTEN_S, ANSWER_S = 1.2, 0.5
"""Wall seconds: a heartbeat comes once a second on most drives as they are shipped."""
_UPLOAD, _ABORT = 0x40, 0x80


def look_at_nodes(record: CanopenVehicleConfig) -> tuple[str, bool]:
    """What is on the vehicle's bus, in words, and whether both configured nodes are drives of CiA 402."""
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
            "vehicle", record.interface, record.channel, bitrate=round(record.bitrate), options={}, receive=take,
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
    with news:
        heard.get(node, {}).pop(SDO_REPLY, None)
    where = struct.pack("<HB", entry.index, entry.sub)
    data = bytes([_UPLOAD]) + where + bytes(4)
    link.send(can.Message(arbitration_id=SDO_REQUEST + node, data=data, is_extended_id=False), str(entry))

    def answer() -> bytes | None:
        reply = heard.get(node, {}).get(SDO_REPLY, b"")
        return reply if len(reply) == 8 and reply[1:4] == where else None

    with news:
        reply = news.wait_for(answer, ANSWER_S)
    if not reply or reply[0] == _ABORT:
        return None
    return int(struct.unpack_from("<I", reply, 4)[0])
