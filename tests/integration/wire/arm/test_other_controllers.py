"""The arm driver at controllers that are not as its own simulated one: refused in words at once, or understood."""

import itertools
import struct
import time
from collections.abc import Callable
from contextlib import closing

import pytest

from drivers.arm.ur import UrArm
from drivers.clock import Clock
from drivers.errors import DeviceFault, NotConnectedError
from tests.support.wire.arm_bench import ArmBench
from tests.support.wire.meddler import Change, Meddler, packet

pytestmark = pytest.mark.wire


@pytest.fixture(scope="module")
def bench():
    with ArmBench() as bench:
        yield bench


def instead(wanted: str, payload: Callable[[bytes], bytes]) -> Change:
    """Packets of one kind with another payload."""
    return lambda kind, data: [packet(kind, payload(data) if kind == wanted else data)]


def every_fourth() -> Change:
    """As a controller of 125 Hz."""
    count = itertools.count()
    return lambda kind, data: [packet(kind, data)] if kind != "U" or next(count) % 4 == 0 else []


def half_and_silence() -> Change:
    """Half of the first state, and nothing any more."""
    count = itertools.count()

    def change(kind: str, data: bytes) -> list[bytes]:
        whole = packet(kind, data)
        return [whole] if kind != "U" else [whole[: len(whole) // 2]] if next(count) == 0 else []

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (instead("V", lambda data: b"\0"), "RTDE does not speak version 2. Update the controller's software"),
        (instead("O", lambda data: b""), r"asked for 13 variables it answers b''. End other programs"),
        (instead("O", lambda data: b"\0"), "asked for 13 variables it answers"),
        (
            instead("O", lambda data: data.replace(b"VECTOR3D", b"NOT_FOUND").replace(b"INT32,", b"IN_USE,", 1)),
            "its states have no .*payload_cog. Update",
        ),
        (instead("S", lambda data: b"\0"), "does not begin to send its states"),
        (instead("U", lambda data: data[:-24]), "a state of 241 bytes came, 265 were agreed"),
        (every_fourth(), "tells its state every 8.0 ms. This driver is for arms that do every 2 ms"),
        (half_and_silence(), "no answer within 1 s. See that it is switched on"),
        (lambda kind, data: [b"\0\0U"], "a packet of 0 bytes came, which is none of RTDE"),
        (lambda kind, data: [], "no answer within 1 s"),
    ],
    ids=["version 1", "empty recipe", "no recipe", "not found", "no start", "short", "125 Hz", "half", "zeros", "mute"],
)
def test_who_answers_otherwise_is_refused_with_the_reason_before_anything_begins(
    bench: ArmBench, change: Change, words: str
):
    begun = time.monotonic()
    with Meddler(bench.address, change) as cable, pytest.raises(NotConnectedError, match=words):
        UrArm("arm", cable.address, connect_timeout=1.0, clock=Clock())
    assert time.monotonic() - begun < 3.0
    assert not bench.ask("show")["moving"]


def test_text_messages_between_the_states_are_passed_over(bench: ArmBench):
    """Messages of both versions of the protocol: length, text, length, source, level."""
    text, source = b"Socket vision opened.", b"URControl"
    message = packet("M", bytes([len(text)]) + text + bytes([len(source)]) + source + b"\2")
    count = itertools.count()

    def change(kind: str, data: bytes) -> list[bytes]:
        whole = packet(kind, data)
        return [message, whole] if kind == "U" and next(count) % 25 == 0 else [whole]

    with Meddler(bench.address, change) as cable, closing(UrArm("arm", cable.address, clock=Clock())) as arm:
        arm.move_joints(arm.state().joints + 0.02, 0.5, 1.0).wait(10.0)
        arm.latch_clock()
        assert arm.examine(0.2)


def test_a_recovery_mode_is_named_with_what_to_do(bench: ArmBench):
    """The joints stand outside the safety limits: programs may not run, a person moves the arm back by hand."""

    def change(kind: str, data: bytes) -> list[bytes]:
        if kind == "U" and len(data) == 265:
            at = 1 + 8 + 4 * 48 + 2 * 8 + 2 * 4
            data = data[:at] + struct.pack(">I", 1 << 3) + data[at + 4 :]
        return [packet(kind, data)]

    with Meddler(bench.address, change) as cable, closing(UrArm("arm", cable.address, clock=Clock())) as arm:
        with pytest.raises(DeviceFault, match=r"outside its safety limits.*At the pendant, move it back") as met:
            arm.move_joints(arm.state().joints, 0.5, 1.0)
        assert (met.value.code, met.value.recoverable) == ("arm.recovery_mode", False)
