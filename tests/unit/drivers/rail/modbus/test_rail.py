"""The rail on Modbus RTU, with two register maps: the drive is simulated with pymodbus, the frames are our own."""

from __future__ import annotations

import itertools
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from pymodbus.client import ModbusSerialClient
from pymodbus.framer import FramerRTU

from cell.devices.contracts import Bench, Faults, RailContract
from drivers.clock import Clock
from drivers.errors import Aborted, ConfigError, DeadlineError, DeviceFault, InterlockError, LimitError
from drivers.interfaces import LinkStatistics, Rail
from drivers.rail.modbus.link import Action, ModbusLink, ModbusRefused
from drivers.rail.modbus.make import ModbusRailConfig, register_map
from drivers.rail.modbus.rail import ModbusRail
from sim_backends.clock import WorldClock
from sim_backends.models.rail import RailModel, RailParams
from sim_backends.peers.rail.modbus_drive import ModbusDriveServer, ModbusPeer
from tests.support.modbus_maps import EDGES, PATHS, RAIL

pytestmark = pytest.mark.wire

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
    def of(cls, record: ModbusRailConfig, *, pty: bool = False, echo: bool = False) -> Drive:
        world = WorldClock(SPEED)
        params = RailParams(steps_per_turn=record.counts_per_turn, serial=4711)
        model = RailModel(params, np.random.default_rng(1))
        drive = ModbusDriveServer(model, world, record.model_dump(mode="json"))
        peer = ModbusPeer(drive, UNIT, pty=pty, echo=echo)
        peer.start()
        return cls(record, model, peer, Clock(SPEED))

    def rail(self, url: str | None = None, *, control: bool = True, **changed: Any) -> ModbusRail:
        record = self.record.model_copy(update=changed)
        return ModbusRail(
            "rail", url or self.peer.url, register_map(record.registers), lead=record.lead,
            counts_per_turn=record.counts_per_turn, travel=record.travel, max_speed=record.max_speed,
            acceleration=record.acceleration, clock=self.clock, unit=record.unit, serial=record.serial, control=control,
        )  # fmt: skip

    def homed(self, **how: Any) -> ModbusRail:
        rail = self.rail(**how)
        rail.home().wait(60.0)
        return rail


@pytest.fixture
def drive() -> Iterator[Drive]:
    made = Drive.of(config(PATHS))
    yield made
    made.peer.stop()


class DriveFaults:
    def __init__(self, peer: ModbusPeer) -> None:
        self.cause, self.clear = peer.fault, peer.clear


class _OverModbus(RailContract):
    REGISTERS: dict[str, Any]

    @pytest.fixture(scope="class")
    @classmethod
    def bench(cls) -> Iterator[Bench[Rail]]:
        drive = Drive.of(config(cls.REGISTERS))
        faults: Faults = DriveFaults(drive.peer)
        made: Bench[Rail] = Bench(drive.rail, drive.clock, faults=faults)
        yield made
        made.over()
        drive.peer.stop()


class TestPaths(_OverModbus):
    """The contract of a rail, on the drive with paths."""

    REGISTERS = PATHS


class TestEdges(_OverModbus):
    """And on the one that has nothing in common with it."""

    REGISTERS = EDGES


def test_another_client_reads_from_the_drive_what_the_rail_has_written() -> None:
    """pymodbus' own client on the pseudo terminal: the target in two words, the speed in rpm, the place in counts."""
    drive = Drive.of(config(PATHS), pty=True)
    rail = drive.homed(url=drive.peer.pty)
    rail.move_to(0.0123, 0.015).wait(30.0)
    rail.close()
    client = ModbusSerialClient(str(drive.peer.pty), baudrate=115200)
    assert client.connect()

    def read(address: int, count: int) -> list[int]:
        return list(client.read_holding_registers(address, count=count, device_id=UNIT).registers)

    assert read(0x6201, 2) == [0, 61_500]
    assert read(0x6203, 1) == [450]
    assert read(0x602C, 2) == [0, 61_500]
    assert drive.model.carriage(drive.clock.now()) == pytest.approx(0.0123, abs=1e-6)
    assert client.write_register(0x9999, 1, device_id=UNIT).isError()
    client.close()
    drive.peer.stop()


def test_numbers_whose_words_come_in_the_other_order_end_the_first_motion_at_its_first_reading(drive: Drive) -> None:
    """Whatever is written reads back, 0 is 0 in either order, and the drive runs off the other way."""
    other = replace(drive, record=config({**PATHS, "word_order": "low first"}))
    rail = other.homed()
    with pytest.raises(DeviceFault, match="word_order") as told:
        rail.move_to(0.0123, 0.015).wait(30.0)
    assert told.value.code == "rail.astray"
    drive.clock.sleep(0.5)
    assert abs(drive.model.carriage(drive.clock.now())) < 3e-3
    with pytest.raises(InterlockError, match="homed"):
        rail.move_to(0.0123, 0.015)
    rail.close()


def test_a_drive_that_takes_its_speed_in_another_unit_is_told_as_too_fast(drive: Drive) -> None:
    """30 rpm for the configuration, in tenths: written as 300, taken by the drive as 300 rpm."""
    other = replace(drive, record=config({**PATHS, "speed": {"address": 0x6203, "unit": "0.1 rpm"}}))
    rail = other.homed()
    with pytest.raises(DeviceFault, match="in which unit") as told:
        rail.move_to(0.0050, 0.001).wait(30.0)
    assert told.value.code == "rail.too_fast"
    rail.close()


def test_a_line_that_repeats_what_is_sent_is_noticed() -> None:
    drive = Drive.of(config(PATHS), echo=True)
    rail = drive.homed()
    rail.move_to(0.005).wait(30.0)
    assert rail.state().position == pytest.approx(0.005, abs=1e-6)
    rail.close()
    drive.peer.stop()


def test_a_lost_reply_is_asked_for_again_and_a_silent_drive_is_told_with_what_to_check(drive: Drive) -> None:
    rail = drive.homed()
    drive.peer.fault("rail.drop_reply")
    assert rail.state().homed
    assert rail.statistics.errors["retries"] == 1
    rail.close()
    with pytest.raises(DeadlineError, match=r"rail\.unit.*rail\.baud, rail\.parity, rail\.stop_bits"):
        drive.rail(unit=UNIT + 1)


@pytest.mark.parametrize("late", [0.2, 0.4, 0.6])
def test_late_answers_never_become_those_to_later_questions(late: float) -> None:
    """Two replies are late, those behind them come at once after them; a drive that reads two registers at a time."""
    listener, asked, ready = socket.create_server(("127.0.0.1", 0)), itertools.count(), threading.Event()

    def serve() -> None:
        connection, _ = listener.accept()
        with connection:
            while request := connection.recv(8):
                address, count = struct.unpack(">HH", request[2:6])
                if ready.is_set() and next(asked) < 2:
                    time.sleep(late)
                body = bytes([UNIT, 3, 2 * count]) + struct.pack(">H", address) * count
                connection.sendall(body + FramerRTU.compute_CRC(body).to_bytes(2, "big"))

    threading.Thread(target=serve, daemon=True).start()
    link = ModbusLink(
        "rail", f"socket://127.0.0.1:{listener.getsockname()[1]}", unit=UNIT, baud=115200, parity="none", stop_bits=1,
        stop_action=Action(1, 1), clock=Clock(), statistics=LinkStatistics(),
    )  # fmt: skip
    assert link.read(7, 2) == [7, 7]
    ready.set()
    right = 0
    for address in (16, 32, 48, 64, 80, 96):
        with suppress(DeadlineError):
            assert link.read(address, 2) == [address, address]
            right += 1
    assert right >= 3
    link.close()
    listener.close()


@pytest.mark.parametrize("spoilt", ["a bit", "another drive's", "another function's"])
def test_a_reply_that_is_spoilt_or_anothers_is_asked_for_again(spoilt: str) -> None:
    listener, ready = socket.create_server(("127.0.0.1", 0)), threading.Event()
    spoiling = itertools.count()

    def serve() -> None:
        connection, _ = listener.accept()
        with connection:
            while request := connection.recv(8):
                address, count = struct.unpack(">HH", request[2:6])
                spoil = ready.is_set() and next(spoiling) == 0
                unit = UNIT + (spoil and spoilt == "another drive's")
                function = 3 + (spoil and spoilt == "another function's")
                body = bytes([unit, function, 2 * count]) + struct.pack(">H", address + spoil) * count
                reply = bytearray(body + FramerRTU.compute_CRC(body).to_bytes(2, "big"))
                if spoil and spoilt == "a bit":
                    reply[4] ^= 0x10
                connection.sendall(reply)

    threading.Thread(target=serve, daemon=True).start()
    statistics = LinkStatistics()
    link = ModbusLink(
        "rail", f"socket://127.0.0.1:{listener.getsockname()[1]}", unit=UNIT, baud=115200, parity="none", stop_bits=1,
        stop_action=Action(1, 1), clock=Clock(), statistics=statistics,
    )  # fmt: skip
    assert link.read(7, 2) == [7, 7]
    ready.set()
    assert link.read(16, 2) == [16, 16]
    assert next(spoiling) >= 2, "it was asked for again"
    link.close()
    listener.close()


def test_a_register_that_the_drive_does_not_have_is_named() -> None:
    wrong = {**PATHS, "homed": {"address": 0x1004, "bit": 6}}
    drive = Drive.of(config(PATHS))
    with pytest.raises(ModbusRefused, match="register 0x1004: it has no such register"):
        drive.rail(registers=config(wrong).registers)
    drive.peer.stop()


def test_a_stop_goes_before_whatever_was_not_sent_yet(drive: Drive) -> None:
    rail = drive.homed()
    motion = rail.move_to(0.09, 0.02)
    threads = [threading.Thread(target=rail.stop) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with pytest.raises(Aborted):
        motion.wait(30.0)
    Clock().sleep(0.1)
    assert drive.model.velocity(drive.clock.now()) == 0
    assert drive.model.carriage(drive.clock.now()) < 0.02
    rail.close()


def test_what_was_decided_before_a_stop_is_not_sent_after_it(drive: Drive) -> None:
    rail = drive.homed()
    decided = rail._link.stops
    rail.stop()
    with pytest.raises(Aborted):
        rail._link.do(rail.registers.start, issued=decided, moves=True)
    rail.close()


def test_a_zero_that_another_program_found_is_not_this_ones(drive: Drive) -> None:
    drive.homed().close()
    rail = drive.rail()
    assert (rail.state().homed, rail.state().homed_here) == (True, False)
    # Homed before it began: that the flag stands is no news. It has to be seen to search.
    rail.move_to(0.05).wait(60.0)
    rail.home().wait(60.0)
    assert rail.state().homed_here
    assert rail.state().position == pytest.approx(0.0, abs=1e-4)
    rail.close()


def test_a_drive_that_does_not_begin_to_search_is_not_homed(drive: Drive) -> None:
    drive.homed().close()
    deaf = config({**PATHS, "home": {"address": 0x6002, "value": 0x77}})
    rail = drive.rail(registers=deaf.registers)
    with pytest.raises(DeviceFault, match=r"rail\.not_begun"):
        rail.home().wait(60.0)
    assert not rail.state().homed_here
    rail.close()


@contextmanager
def shown(model: RailModel, name: str, told: Callable[[float], Any]) -> Iterator[None]:
    """The drive shows this instead of what is so."""
    setattr(model, name, told)
    try:
        yield
    finally:
        delattr(model, name)


@pytest.fixture
def edges() -> Iterator[Drive]:
    """The drive whose map has the switches."""
    made = Drive.of(config(EDGES))
    yield made
    made.peer.stop()


def test_what_speaks_against_a_zero_when_nobody_watched_ends_the_trust_in_it(edges: Drive) -> None:
    drive = edges
    drive.homed().close()
    for name in ("stalled", "left_switch", "right_switch"):
        with shown(drive.model, name, lambda t: True):
            rail = drive.rail()
        assert drive.peer.drive._homed
        assert not rail.state().homed, name
        with pytest.raises(InterlockError, match="not homed"):
            rail.move_to(0.01)
        rail.close()
    rail = drive.rail()
    assert rail.state().homed
    rail.close()


def test_a_search_that_ends_elsewhere_in_an_alarm_or_by_a_stop_finds_no_zero(edges: Drive) -> None:
    drive, rail = edges, edges.rail()
    true, off = drive.model.position, round(0.002 / drive.record.lead * drive.record.counts_per_turn)
    with shown(drive.model, "position", lambda t: true(t) + off):
        with pytest.raises(DeviceFault, match=r"counts 2 mm there .*rail\.setting"):
            rail.home().wait(60.0)
        assert not rail.state().homed_here
    search = rail.home()
    with shown(drive.model, "stalled", lambda t: True), pytest.raises(DeviceFault, match=r"while it searched"):
        search.wait(60.0)
    search = rail.home()
    rail.stop()
    with pytest.raises(Aborted):
        search.wait(60.0)
    assert not rail.state().homed
    rail.close()


def test_an_obstacle_is_an_alarm_with_its_number() -> None:
    drive = Drive.of(config(PATHS, travel=["0 mm", "120 mm"]))
    rail = drive.homed()
    drive.model.configure(drive.clock.now(), replace(drive.model.settings, right_stop=False))
    with pytest.raises(DeviceFault, match="alarm 0x00e0") as met:
        rail.move_to(0.115).wait(60.0)
    assert met.value.code == "rail.alarm"
    assert not rail.state().homed
    with pytest.raises(InterlockError):
        rail.move_to(0.01)
    assert [reading.ok for reading in rail.examine(0.0)] == [False]
    # Cleared at the drive, which says that it is homed as before: it may have slipped.
    drive.model.clear_stall()
    assert drive.peer.drive._homed
    assert not rail.state().homed
    rail.close()
    drive.peer.stop()


def test_what_the_drives_units_cannot_say_is_refused_before_anything_is_sent(drive: Drive) -> None:
    rail = drive.homed()
    with pytest.raises(LimitError, match="in the drive's unit"):
        rail.move_to(0.01, 50e-6)
    rail.close()
    with pytest.raises(ConfigError, match=r"rail\.acceleration"):
        drive.rail(acceleration=20.0)


def test_who_only_looks_writes_nothing(drive: Drive) -> None:
    drive.homed().close()
    before = dict(drive.peer.drive._written)
    rail = drive.rail(control=False)
    assert rail.state().homed
    assert rail.examine(0.0)[0].ok
    assert rail.identity().serial == "A1234"
    rail.close()
    assert drive.peer.drive._written == before


OWNER = """
import sys
from drivers.clock import Clock
from drivers.rail.modbus.rail import ModbusRail
from drivers.rail.modbus.link import *
rail = ModbusRail("rail", sys.argv[1], eval(sys.argv[2]), lead=0.002, counts_per_turn=10_000, travel=(0.0, 0.1),
    max_speed=0.04, acceleration=0.2, clock=Clock(5.0), unit=7)
rail.home().wait(60)
motion = rail.move_to(0.09, 0.002)
print("moves", flush=True)
motion.wait(600)
"""


def test_the_rail_stands_when_its_owner_is_killed() -> None:
    drive = Drive.of(config(PATHS), pty=True)
    command = [sys.executable, "-c", OWNER, str(drive.peer.pty), repr(register_map(drive.record.registers))]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as owner:
        assert owner.stdout is not None
        assert owner.stdout.readline() == b"moves\n"
        Clock().sleep(0.1)
        assert drive.model.velocity(drive.clock.now()) != 0
        os.kill(owner.pid, signal.SIGKILL)
    Clock().sleep(0.5)
    assert drive.model.velocity(drive.clock.now()) == 0
    drive.peer.stop()
