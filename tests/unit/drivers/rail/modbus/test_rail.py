"""The rail on Modbus RTU, with two register maps: the drive is simulated with pymodbus, the frames are our own."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from pymodbus.client import ModbusSerialClient

from cell.devices.contracts import Bench, RailContract
from drivers.clock import Clock
from drivers.errors import Aborted, ConfigError, LimitError
from drivers.interfaces import Rail
from tests.support.modbus_maps import EDGES, PATHS
from tests.support.wire.modbus_bench import UNIT, Drive, config

pytestmark = pytest.mark.wire


class _OverModbus(RailContract):
    REGISTERS: dict[str, Any]

    @pytest.fixture(scope="class")
    @classmethod
    def bench(cls) -> Iterator[Bench[Rail]]:
        drive = Drive.of(config(cls.REGISTERS))
        faults = SimpleNamespace(cause=drive.peer.fault, clear=drive.peer.clear)
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


def test_another_client_reads_from_the_drive_what_the_rail_has_written():
    """pymodbus' own client on the pseudo terminal: the target in two words, the speed in rpm, the place in counts."""
    drive = Drive.of(config(PATHS), pty=True)
    rail = drive.homed(url=drive.peer.pty)
    rail.move_to(0.0123, 0.015).wait(30.0)
    rail.close()
    client = ModbusSerialClient(str(drive.peer.pty), baudrate=115200)
    assert client.connect()

    def read(address: int, count: int) -> list[int]:
        return list(client.read_holding_registers(address, count=count, device_id=UNIT).registers)

    assert (read(0x6201, 2), read(0x6203, 1), read(0x602C, 2)) == ([0, 61_500], [450], [0, 61_500])
    assert drive.model.carriage(drive.clock.now()) == pytest.approx(0.0123, abs=1e-6)
    assert client.write_register(0x9999, 1, device_id=UNIT).isError()
    client.close()
    drive.peer.stop()


def test_a_stop_goes_before_whatever_was_not_sent_yet(drive: Drive):
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


def test_a_search_ends_as_its_stop_did(drive: Drive):
    rail = drive.rail()
    motion = rail.home()
    rail.stop()
    with pytest.raises(Aborted, match="while it searched the reference switch"):
        motion.wait(30.0)
    rail.close()


def test_what_the_drives_units_cannot_say_is_refused_before_anything_is_sent(drive: Drive):
    rail = drive.homed()
    with pytest.raises(LimitError, match="in the drive's unit"):
        rail.move_to(0.01, 50e-6)
    rail.close()
    with pytest.raises(ConfigError, match=r"rail\.acceleration"):
        drive.rail(acceleration=20.0)


def test_who_only_looks_writes_nothing(drive: Drive):
    drive.homed().close()
    before = dict(drive.peer.drive._written)
    rail = drive.rail(control=False)
    assert rail.state().homed and rail.examine(0.0)[0].ok
    assert rail.identity().serial == "A1234"
    rail.close()
    assert drive.peer.drive._written == before


OWNER = """
import sys
from drivers.clock import Clock
from drivers.common.units import KEPT
from drivers.rail.modbus.make import ModbusRailConfig
from drivers.rail.modbus.rail import ModbusRail
record = ModbusRailConfig.model_validate_json(sys.argv[1], context=KEPT)
rail = ModbusRail("rail", record, clock=Clock(5.0))
rail.home().wait(60)
motion = rail.move_to(0.09, 0.002)
print("moves", flush=True)
motion.wait(600)"""


def test_the_rail_stands_when_its_owner_is_killed():
    drive = Drive.of(config(PATHS), pty=True)
    record = drive.record.model_copy(update={"url": str(drive.peer.pty)})
    command = [sys.executable, "-c", OWNER, record.model_dump_json()]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as owner:
        assert owner.stdout is not None
        assert owner.stdout.readline() == b"moves\n"
        Clock().sleep(0.1)
        assert drive.model.velocity(drive.clock.now()) != 0
        os.kill(owner.pid, signal.SIGKILL)
    Clock().sleep(0.5)
    assert drive.model.velocity(drive.clock.now()) == 0
    drive.peer.stop()
