"""Promises of `drivers.rail.modbus.link`."""

import itertools
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import pytest
from pymodbus.framer import FramerRTU

from drivers.clock import Clock
from drivers.errors import Aborted, DeadlineError
from drivers.interfaces import LinkStatistics
from drivers.rail.modbus import link as modbus_link
from drivers.rail.modbus.link import ModbusLink, ModbusRefused
from drivers.rail.modbus.make import ActionConfig
from tests.support.modbus_maps import PATHS
from tests.support.wire.modbus_bench import UNIT, Drive, config


def test_frames_carry_the_checksum_that_pymodbus_computes():
    for frame in (bytes(range(n)) for n in range(2, 40)):
        assert modbus_link._crc(frame) == FramerRTU.compute_CRC(frame).to_bytes(2, "big")


@pytest.mark.wire
def test_a_line_that_repeats_what_is_sent_is_noticed():
    drive = Drive.of(config(PATHS), echo=True)
    rail = drive.homed()
    rail.move_to(0.005).wait(30.0)
    assert rail.state().position == pytest.approx(0.005, abs=1e-6)
    rail.close()
    drive.peer.stop()


@pytest.mark.wire
def test_a_lost_reply_is_asked_for_again_and_a_silent_drive_is_told_with_what_to_check(drive: Drive):
    rail = drive.homed()
    drive.peer.fault("rail.drop_reply")
    assert rail.state().homed
    assert rail.statistics.errors["retries"] == 1
    rail.close()
    with pytest.raises(DeadlineError, match=r"rail\.unit.*rail\.baud, rail\.parity, rail\.stop_bits"):
        drive.rail(unit=UNIT + 1)


@contextmanager
def answered(answer: Callable[[int, int], bytes]) -> Iterator[ModbusLink]:
    """A link to a drive that gives `answer(address, count)` to each question, after a first one that is asked here."""
    listener = socket.create_server(("127.0.0.1", 0))
    ready = threading.Event()

    def serve() -> None:
        connection, _ = listener.accept()
        with connection:
            while request := connection.recv(8):
                address, count = struct.unpack(">HH", request[2:6])
                connection.sendall(answer(address, count) if ready.is_set() else reply(address, count))

    threading.Thread(target=serve, daemon=True).start()
    link = ModbusLink(
        "rail", f"socket://127.0.0.1:{listener.getsockname()[1]}", unit=UNIT, baud=115200, parity="none", stop_bits=1,
        stop_action=ActionConfig(address=1, value=1), clock=Clock(), statistics=LinkStatistics(),
    )  # fmt: skip
    assert link.read(7, 2) == [7, 7]
    ready.set()
    yield link
    link.close()
    listener.close()


def reply(address: int, count: int, unit: int = UNIT, function: int = 3) -> bytes:
    """Each register holds its first one's address."""
    body = bytes([unit, function, 2 * count]) + struct.pack(">H", address) * count
    return body + FramerRTU.compute_CRC(body).to_bytes(2, "big")


@pytest.mark.wire
@pytest.mark.parametrize("late", [0.2, 0.4, 0.6])
def test_late_answers_never_become_those_to_later_questions(late: float):
    """Two replies are late, those behind them come at once after them; a drive that reads two registers at a time."""
    asked = itertools.count()

    def answer(address: int, count: int) -> bytes:
        if next(asked) < 2:
            time.sleep(late)
        return reply(address, count)

    right = 0
    with answered(answer) as link:
        for address in (16, 32, 48, 64, 80, 96):
            with suppress(DeadlineError):
                assert link.read(address, 2) == [address, address]
                right += 1
    assert right >= 3


@pytest.mark.wire
@pytest.mark.parametrize("spoilt", ["a bit", "another drive's", "another function's"])
def test_a_reply_that_is_spoilt_or_anothers_is_asked_for_again(spoilt: str):
    asked = itertools.count()

    def answer(address: int, count: int) -> bytes:
        if next(asked) > 0:
            return reply(address, count)
        made = bytearray(
            reply(address + 1, count, UNIT + (spoilt == "another drive's"), 3 + (spoilt == "another function's"))
        )
        made[4] ^= 0x10 * (spoilt == "a bit")
        return bytes(made)

    with answered(answer) as link:
        assert link.read(16, 2) == [16, 16]
    assert next(asked) >= 2, "it was asked for again"


@pytest.mark.wire
def test_a_register_that_the_drive_does_not_have_is_named():
    wrong = {**PATHS, "homed": {"address": 0x1004, "bit": 6}}
    drive = Drive.of(config(PATHS))
    with pytest.raises(ModbusRefused, match="register 0x1004: it has no such register"):
        drive.rail(registers=config(wrong).registers)
    drive.peer.stop()


@pytest.mark.wire
def test_what_was_decided_before_a_stop_is_not_sent_after_it(drive: Drive):
    rail = drive.homed()
    decided = rail._link.stops.count
    rail.stop()
    with pytest.raises(Aborted):
        rail._link.do(rail.registers.start, issued=decided, moves=True)
    rail.close()
