"""The vehicle on CANopen with its simulated drives, on a bus inside this process: what must never fail."""

import time

import pytest

from drivers.errors import DeadlineError, DeviceFault
from drivers.vehicle.feedback import QUIET_S
from sim_backends.peers.vehicle.canopen import WheelState
from tests.support.canopen_bench import WATCHDOG_S, Bench, at_bench, with_output_brake

pytestmark = pytest.mark.wire

PRE_OPERATIONAL = 0x7F
RAMP_WALL_S = 0.3
"""From 0.3 m/s to standstill, and the time to notice, on the wall at three times its pace."""


def test_a_drive_that_is_lost_keeps_no_other_brake_open_and_nobody_says_braked():
    settings, wheels = with_output_brake(False)
    with at_bench(settings, wheels=wheels) as bench:
        left, right = bench.peer.drives
        left.node.silent = True
        with pytest.raises(DeadlineError, match="node 1 does not answer"):
            bench.vehicle.brake()
        bench.until(lambda: right.locked)
        assert not left.locked and bench.vehicle._braked is None
        left.node.silent = False


def test_heartbeats_do_not_pass_for_readings(bench: Bench):
    bench.vehicle.brake()
    for drive in bench.peer.drives:
        drive.node.state = PRE_OPERATIONAL
    time.sleep(QUIET_S + 0.5)
    with pytest.raises(DeviceFault, match="does not tell its state") as caught:
        bench.vehicle.check()
    assert caught.value.code == "vehicle.silent"


@pytest.mark.parametrize("guarding", ["heartbeat", "node"])
def test_the_drives_stop_by_themselves_when_this_program_is_gone(guarding: str):
    with at_bench(guarding=guarding) as bench:
        bench.drive_until_fast()
        bench.vehicle._master._closed.set()  # its thread ends as with its process
        bench.vehicle._master._keeper.join()
        gone = time.monotonic()
        bench.until(lambda: bench.speed() == 0.0)
        assert time.monotonic() - gone < WATCHDOG_S + RAMP_WALL_S + 0.2
        bench.until(bench.braked)
        assert [drive.wheel.state for drive in bench.peer.drives] == [WheelState.FAULT] * 2
        # Nothing is left of it that could be closed.
        bench.vehicle._master.bus.close()
        bench.vehicle._closed.set()


def test_who_only_looks_sets_nothing(apart: Bench):
    vehicle = apart.connect(look=True)
    state = vehicle.state()
    assert (state.battery_volts, state.braked, state.emergency_stop) == (26.4, None, False)
    who = vehicle.identity()
    assert (who.model, who.serial, who.firmware) == ("CiA 402, Simulated wheel drive", "7001 and 7002", "1.4")
    assert vehicle.ping() < 0.5
    vehicle.examine(0.1)
    vehicle.stop()
    vehicle.close()
    # Uploads of values and of the parts of a text; aborts of nothing.
    assert {message.arbitration_id for message in apart.bus.frames} == {0x601, 0x602}
    assert {message.data[0] >> 5 for message in apart.bus.frames} == {2, 3}
