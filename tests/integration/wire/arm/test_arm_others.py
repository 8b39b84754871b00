"""The arm driver beside others: what they set, hold or switch at the arm is noticed and named, or is no fault."""

import socket
import time
from contextlib import closing, nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from cell.measure.geometry.poses import to_ur
from cell.motion.kinematics import arm_kinematics
from drivers.arm.faults import fault, require_named
from drivers.arm.ur import UrArm
from drivers.clock import Clock
from drivers.errors import DeviceFault, NotConnectedError
from drivers.interfaces import ArmSafety
from tests.support.wire.arm_bench import held_input, soon
from tests.support.wire.cable import Cable
from tests.support.wire.shared_arm import shared_arm

pytestmark = pytest.mark.wire

STATE_AGE = 0.15
"""More than a state may be old that a motion begins with, s."""
PAYLOAD = (1.5, (0.0, 0.0, 0.05))


def connect(address, **options):
    return UrArm("arm", address, payload=PAYLOAD, clock=Clock(), **options)


running, shared, bench, arm = shared_arm(connect)


def send(address, script):
    """As another program would: beside the one that runs."""
    with socket.create_connection((address, 30002), timeout=2.0) as connection:
        connection.sendall(f"sec other():\n  {script}\nend\n".encode())
        connection.recv(4096)


def nudge(arm):
    state = arm.state()
    arm.move_joints(state.joints + 0.02, 0.5, 1.0).wait(10.0)


def test_a_payload_that_another_has_set_is_named_before_the_next_motion_and_recover_sets_it_again(arm, bench):
    nudge(arm)
    send(bench.address, "set_payload(4.0, [0.0, 0.0, 0.05])")
    assert soon(lambda: bench.ask("show")["payload"] == 4.0)
    Clock().sleep(STATE_AGE)
    before = bench.ask("show")["q"]
    with pytest.raises(DeviceFault, match=r"4\.000 kg .* set was 1\.500 kg .* nothing was moved") as caught:
        nudge(arm)
    assert caught.value.code == "arm.wrong_payload"
    assert caught.value.recoverable
    assert bench.ask("show")["q"] == before
    arm.recover()
    nudge(arm)
    arm.set_payload(2.5, np.array([0.0, 0.01, 0.02]))
    nudge(arm)
    arm.set_payload(PAYLOAD[0], np.array(PAYLOAD[1]))


def test_a_program_that_another_client_starts_is_a_program_that_ended_and_can_be_recovered(arm, bench):
    moving = arm.move_joints(arm.state().joints + 0.5, 0.2, 1.0)
    with socket.create_connection((bench.address, 30001), timeout=2.0) as other:
        other.sendall(b'def other():\n  textmsg("mine now")\n  sleep(0.1)\nend\n')
        other.recv(4096)
        with pytest.raises(DeviceFault) as caught:
            moving.wait(10.0)
    assert caught.value.code == "arm.program_stopped"
    arm.recover()
    nudge(arm)


def test_reduced_mode_is_no_fault_to_connect_to_move_in_and_to_recover_in(bench):
    bench.ask("reduced_mode")
    with closing(connect(bench.address)) as arm:
        assert arm.state().safety is ArmSafety.NORMAL
        nudge(arm)
        arm.recover()
        nudge(arm)


def test_a_tool_that_another_has_set_is_named_before_the_next_motion(bench):
    arm = connect(
        bench.address, forward_of=lambda table: lambda joints: to_ur(arm_kinematics("UR10e", table).fk(joints))
    )
    nudge(arm)
    send(bench.address, "set_tcp(p[0, 0, 0.1, 0, 0, 0])")
    assert soon(lambda: bench.ask("show")["tcp"][2][3] == pytest.approx(0.1))
    Clock().sleep(STATE_AGE)
    with pytest.raises(DeviceFault, match=r"100\.000 mm .* away from where the cell's model") as caught:
        nudge(arm)
    assert caught.value.code == "arm.wrong_kinematics"
    assert "another tool at the pendant" in caught.value.hint
    arm.close()


def test_local_control_is_said_at_connecting_recovering_and_before_each_motion(arm, bench):
    bench.ask("local_control")
    with pytest.raises(DeviceFault, match="in local control") as caught:
        arm.recover()
    assert caught.value.code == "arm.local_control"
    assert not caught.value.recoverable
    assert "remote control at the pendant" in caught.value.hint
    assert arm.identity().model == "UR10e"
    stands = bench.ask("show")["q"]
    with pytest.raises(DeviceFault, match="in local control"):
        nudge(arm)
    assert bench.ask("show")["q"] == stands
    with pytest.raises(DeviceFault, match="in local control"):
        connect(bench.address)
    looking = connect(bench.address, control=False)
    assert looking.state().safety is ArmSafety.NORMAL
    looking.close()
    bench.ask("clear")
    arm.recover()
    nudge(arm)


def test_an_arm_that_calls_itself_otherwise_is_refused_with_both_names(bench):
    with pytest.raises(DeviceFault, match=r'it calls itself UR10e, arm\.model is "UR5e"') as caught:
        connect(bench.address, model="UR5e")
    assert caught.value.code == "arm.wrong_model"
    connect(bench.address, model="UR10e").close()


@pytest.mark.parametrize(
    ("told", "model", "same"),
    [("UR10", "UR10e", True), ("UR10e", "UR10", False), ("UR3", "UR30", False), ("UR30", "UR3e", False),
     ("could not understand: get robot model", "UR5e", True), ("ur20", "UR20", True)],
)  # fmt: skip
def test_an_e_series_arm_may_leave_out_its_e(told, model, same):
    board = SimpleNamespace(ask=lambda question: told)
    with nullcontext() if same else pytest.raises(DeviceFault, match=told):
        require_named("arm", board, model)


@pytest.mark.parametrize(
    ("name", "told"),
    [(b"input_int_register_0", "registers are already in use"),
     (b"tool_digital_output", "digital outputs are already in use")],
)  # fmt: skip
def test_an_input_that_another_client_holds_is_named_at_connecting(bench, name, told):
    with held_input(bench.address, name), pytest.raises(NotConnectedError, match=told):
        connect(bench.address)
    arm = connect(bench.address)
    nudge(arm)
    arm.close()


def test_a_port_that_tells_no_kinematics_costs_two_seconds_and_is_named(bench):
    with Cable(bench.address, but=(30001,), silent=(30001,)) as cable:
        begun = time.monotonic()
        arm = connect(cable.address)
        arm.close()
        assert time.monotonic() - begun < 6.0
        assert "port 30001" in arm.untold and "sent none within 2 s" in arm.untold


def test_a_silent_port_for_the_outputs_setting_is_named(bench):
    with (
        Cable(bench.address, but=(30002,), silent=(30002,)) as cable,
        pytest.raises(NotConnectedError, match=r"port 30002 of the arm is silent for 1 s.*Open that port"),
    ):
        connect(cable.address, safe_off_outputs=(0,))


def test_another_kinematics_does_not_send_people_to_the_model():
    assert "model" not in str(fault("arm", "arm.wrong_kinematics", ""))
