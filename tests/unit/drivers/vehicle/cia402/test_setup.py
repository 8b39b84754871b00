"""Promises of `drivers.vehicle.cia402.setup`."""

from dataclasses import replace

import pytest

from drivers.errors import ConfigError, DeviceFault
from sim_backends.peers.vehicle.canopen import WheelState
from sim_backends.peers.vehicle.canopen_node import WRONG_VALUE, Abort
from tests.support.canopen_bench import SETTINGS, WATCHDOG_S, WHEELS, Bench, at_bench, fault_of, with_output_brake

pytestmark = pytest.mark.wire


def test_a_drive_that_does_not_watch_us_is_refused_before_anything_moves(apart: Bench):
    apart.peer.drives[1].wheel.connection_lost = lambda: None  # type: ignore[method-assign]
    apart.peer.drives[1].node._lost = lambda: None
    vehicle = apart.connect()
    with pytest.raises(DeviceFault, match=r"the right drive stays enabled.*6007h") as met:
        vehicle.enable()
    assert met.value.code == "vehicle.watchdog"
    with pytest.raises(DeviceFault, match="left drive: our heartbeat stayed away"):
        vehicle.drive(0.1, 0.0)
    vehicle.close()
    assert apart.peer.model.planar(apart.world.now())[0] == 0.0
    assert apart.braked()


def test_a_drive_that_somebody_else_turns_is_told_and_left_alone(apart: Bench):
    values = apart.peer.drives[0].node._values
    values[0x6041, 0].read, values[0x606C, 0].read = lambda: 0x0237, lambda: 3000
    with pytest.raises(DeviceFault, match=r"left drive turns its wheel at 0\.157 m/s") as met:
        apart.connect()
    assert met.value.code == "vehicle.disturbed"
    # Uploads and the parts of a text: nothing is set.
    assert {message.data[0] >> 5 for message in apart.bus.frames} <= {2, 3}


def test_a_drive_that_counts_otherwise_than_configured_is_refused(apart: Bench):
    with pytest.raises(ConfigError, match=r"counts 4096 per turn.*counts_per_turn is 1024"):
        apart.connect(replace(WHEELS, counts=1024))
    with pytest.raises(ConfigError, match=r'measures speed in 0\.1 rpm.*velocity_unit is "rpm"'):
        apart.connect(replace(WHEELS, velocity_unit="rpm"))


def test_units_that_contradict_each_other_end_driving():
    """A drive that does not say in what it measures: at a tenth of the speed that it counts."""
    made = Bench(replace(SETTINGS, velocity_unit="rpm"))
    for drive in made.peer.drives:
        del drive.node._values[0x60A9, 0]
    try:
        made.connect().enable()
        with pytest.raises(DeviceFault, match=r"speed is 0\.(09\d*|10?\d?) times what its counts say") as met:
            made.drive_on(4.0, 0.05)
        assert met.value.code == "vehicle.units"
        made.until(lambda: made.speed() == 0.0)
    finally:
        made.vehicle.close()
        made.peer.stop()


@pytest.mark.parametrize("locks", [False, True])
def test_a_brake_on_an_output_follows_it(locks: bool):
    settings, wheels = with_output_brake(locks)
    with at_bench(settings, wheels=wheels) as bench:
        bench.until(lambda: not bench.braked())
        assert {drive._outputs >> 17 & 1 for drive in bench.peer.drives} == {not locks}
        bench.drive_until_fast()
        bench.vehicle.brake()
        bench.until(bench.braked)
        assert {drive._outputs >> 17 & 1 for drive in bench.peer.drives} == {locks}


def test_a_value_that_is_not_needed_may_be_refused_and_one_that_is_may_not(apart: Bench):
    def refuse(value: int) -> None:
        raise Abort(WRONG_VALUE)

    apart.peer.drives[0].node._values[0x605D, 0].write = refuse
    apart.connect().close()
    apart.peer.drives[0].node._values[0x6085, 0].write = refuse
    with pytest.raises(DeviceFault, match=r"node number 1 refuses 6085h \(quick stop deceleration\)") as met:
        apart.connect()
    assert met.value.code == "vehicle.setup"


def test_drives_of_few_objects_drive_and_what_is_missing_is_named(apart: Bench):
    """No options, no inputs and outputs, no supply voltage; they say neither how they count nor in what unit."""
    for drive in apart.peer.drives:
        for index in (0x605A, 0x605D, 0x605E, 0x6079, 0x608F, 0x60A9, 0x60FD, 0x60FE):
            for key in [key for key in drive.node._values if key[0] == index]:
                del drive.node._values[key]
    with pytest.raises(DeviceFault, match=r"digital inputs.*cannot be mapped") as met:
        apart.connect()
    assert met.value.code == "vehicle.setup"
    vehicle = apart.connect(replace(WHEELS, stop_input=None))
    vehicle.enable()
    apart.drive_until_fast()
    vehicle.brake()
    assert (vehicle.state().braked, vehicle.state().battery_volts) == (True, None)
    vehicle.close()


def test_a_drive_that_was_switched_off_is_set_up_again_and_its_counts_are_not_trusted(bench: Bench):
    bench.drive_until_fast()
    node = bench.peer.drives[0].node
    bench.peer.drives[0].wheel.state = WheelState.DISABLED
    node._values[0x1800, 1].value |= 1 << 31
    node.boot()
    assert fault_of(bench).code == "vehicle.command_lost"
    assert "left drive was restarted" in bench.vehicle.state(10.0 * WATCHDOG_S + 60.0).interruption
    bench.vehicle.enable()
    bench.drive_until_fast()
