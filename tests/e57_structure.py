"""A reader of E57 files written from the standard's description (ASTM E2807), so that no library checks itself.

A header, pages that end in their CRC-32C, an XML section, and packets of byte streams, one for each field of a point.
Reads what a cloud needs: floats and whole numbers. Anything else is an error.
"""

from __future__ import annotations

import struct
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

NAMESPACE = "{http://www.astm.org/COMMIT/E57/2010-e57-v1.0}"
CASTAGNOLI = 0x82F63B78
CHECKSUM_BYTES = 4


def crc32c(rows: np.ndarray) -> np.ndarray:
    """CRC-32C (n,) of rows (n, bytes)."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(CASTAGNOLI), table >> 1)
    state = np.full(len(rows), 0xFFFFFFFF, dtype=np.uint32)
    for column in rows.T:
        state = table[(state ^ column) & 0xFF] ^ (state >> np.uint32(8))
    return np.asarray(state ^ np.uint32(0xFFFFFFFF))


class E57File:
    """The scans of a file; `xml` is its root. Raises AssertionError where the file departs from the standard."""

    def __init__(self, path: Path) -> None:
        raw = path.read_bytes()
        magic, major, minor, length, xml_at, xml_length, self.page = struct.unpack("<8sIIQQQQ", raw[:48])
        assert (magic, major, minor) == (b"ASTM-E57", 1, 0)
        assert length == len(raw) and length % self.page == 0
        pages = np.frombuffer(raw, dtype=np.uint8).reshape(-1, self.page)
        content, stored = pages[:, :-CHECKSUM_BYTES], pages[:, -CHECKSUM_BYTES:]
        assert np.array_equal(crc32c(content), np.ascontiguousarray(stored).view(">u4")[:, 0])
        self.content = content.tobytes()
        start = self.logical(xml_at)
        self.xml = ElementTree.fromstring(self.content[start : start + xml_length].decode("utf-8"))

    def logical(self, offset: int) -> int:
        """Where a place in the file lies among the pages' contents."""
        page, within = divmod(offset, self.page)
        assert within < self.page - CHECKSUM_BYTES
        return page * (self.page - CHECKSUM_BYTES) + within

    def names(self) -> list[str]:
        """The scans' names."""
        return [text(scan, "name") for scan in self._scans()]

    def scan(self, number: int) -> dict[str, np.ndarray]:
        """Fields by name, each (n,), of one scan's points."""
        points = self._scans()[number].find(NAMESPACE + "points")
        assert points is not None and points.get("type") == "CompressedVector"
        prototype = points.find(NAMESPACE + "prototype")
        assert prototype is not None
        count = int(points.attrib["recordCount"])
        streams = self._streams(int(points.attrib["fileOffset"]), len(prototype))
        fields = zip(prototype, streams, strict=True)
        return {field.tag.removeprefix(NAMESPACE): decoded(field, stream, count) for field, stream in fields}

    def _scans(self) -> list[ElementTree.Element]:
        scans = self.xml.find(NAMESPACE + "data3D")
        assert scans is not None and scans.get("type") == "Vector"
        return list(scans)

    def _streams(self, section: int, fields: int) -> list[bytes]:
        """The bytes of each field, put together from the section's data packets."""
        begin = self.logical(section)
        kind, length, data, _ = struct.unpack_from("<B7xQQQ", self.content, begin)
        assert kind == 1, "a compressed vector section"
        at, streams = self.logical(data), [b""] * fields
        while at < begin + length:
            packet, _, size_less_one = struct.unpack_from("<BBH", self.content, at)
            if packet == 1:
                (number,) = struct.unpack_from("<H", self.content, at + 4)
                assert number == fields
                sizes = struct.unpack_from(f"<{number}H", self.content, at + 6)
                place = at + 6 + 2 * number
                for k, size in enumerate(sizes):
                    streams[k] += self.content[place : place + size]
                    place += size
                assert place <= at + size_less_one + 1
            at += size_less_one + 1
        return streams


def text(element: ElementTree.Element, name: str) -> str:
    """The text of a child."""
    child = element.find(NAMESPACE + name)
    assert child is not None
    return child.text or ""


def decoded(field: ElementTree.Element, stream: bytes, count: int) -> np.ndarray:
    """The values (count,) of a field: IEEE floats, or whole numbers above their minimum in as few bits as they need."""
    kind = field.get("type")
    if kind == "Float":
        precision = "<f4" if field.get("precision") == "single" else "<f8"
        return np.frombuffer(stream, dtype=precision, count=count)
    assert kind == "Integer", f"{field.tag} is {kind}"
    low, high = int(field.get("minimum", -(2**63))), int(field.get("maximum", 2**63 - 1))
    bits = (high - low).bit_length()
    if bits == 0:
        return np.full(count, low)
    packed = np.unpackbits(np.frombuffer(stream, dtype=np.uint8), count=count * bits, bitorder="little")
    return low + packed.reshape(count, bits).astype(np.int64) @ (1 << np.arange(bits, dtype=np.int64))
