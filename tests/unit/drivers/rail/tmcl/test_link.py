"""TMCL telegrams against the vendor's manual and the vendor's own library."""

import itertools
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pytrinamic.tmcl import TMCLReply, TMCLRequest

from drivers.clock import Clock
from drivers.errors import DeadlineError, DeviceError, DeviceFault, NotConnectedError
from drivers.interfaces import LinkStatistics
from drivers.rail.tmcl.link import Axis, TelegramError, TmclLink, TmclRequest, decode_firmware, decode_reply
from tests.support.wire.rail_bench import Bench, connect, reply

BYTE = st.integers(0, 255)
VALUE = st.integers(-(2**31), 2**31 - 1)


@given(BYTE, BYTE, BYTE, BYTE, VALUE)
def test_requests_are_byte_for_byte_those_of_the_vendors_library(
    address: int, command: int, kind: int, motor: int, value: int
):
    ours = TmclRequest(address, command, kind, motor, value).encode()
    assert ours == bytes(TMCLRequest(address, command, kind, motor, value).to_buffer())


@given(BYTE, BYTE, BYTE, BYTE, VALUE)
def test_replies_of_the_vendors_library_are_understood(host: int, module: int, status: int, command: int, value: int):
    data = bytes(TMCLReply(host, module, status, command, value).to_buffer())
    reply = decode_reply(data, TmclRequest(module, command, 0, 0))
    found = (reply.host, reply.module, reply.status, reply.command, reply.value)
    assert found == (host, module, status, command, value)


@given(st.integers(0, 8), st.integers(1, 255))
def test_any_changed_byte_is_noticed(index: int, change: int):
    data = bytearray(TMCLReply(2, 1, 100, 6, 123456).to_buffer())
    data[index] ^= change
    with pytest.raises(TelegramError, match="checksum"):
        decode_reply(bytes(data), TmclRequest(1, 6, 1, 0))


@pytest.mark.parametrize("length", [0, 8, 10])
def test_a_reply_has_nine_bytes(length: int):
    with pytest.raises(TelegramError, match=f"{length} bytes"):
        decode_reply(bytes(length), TmclRequest(1, 6, 1, 0))


def test_the_answer_of_another_module_or_to_another_command_is_refused():
    data = bytes(TMCLReply(2, 3, 100, 6, 0).to_buffer())
    with pytest.raises(TelegramError, match="module 3 instead of 1"):
        decode_reply(data, TmclRequest(1, 6, 1, 0))
    with pytest.raises(TelegramError, match="command 6 instead of 5"):
        decode_reply(data, TmclRequest(3, 5, 1, 0))


def test_the_firmware_text_is_eight_characters_after_the_hosts_address():
    assert decode_firmware(b"\x021260V112") == "1260V112"
    with pytest.raises(TelegramError):
        decode_firmware(b"\x021260V1\x00\xff")


def test_a_value_beyond_32_bits_is_refused():
    with pytest.raises(ValueError, match="does not fit"):
        TmclRequest(1, 4, 0, 0, 2**31).encode()


@pytest.mark.wire
def test_a_lost_reply_is_asked_for_once_more_and_counted(homed: Bench):
    homed.peer.fault("rail.drop_reply")
    homed.rail.move_to(0.03).wait(20.0)
    assert (homed.carriage(), homed.rail.statistics.errors["retries"]) == (pytest.approx(0.03, abs=1e-6), 1)
    assert homed.rail.statistics.errors["timeouts"] == 1


@pytest.mark.wire
def test_a_peer_that_dies_in_mid_move_is_a_fault_at_once(homed: Bench):
    motion = homed.rail.move_to(0.09, speed=0.005)
    homed.peer.stop()
    with pytest.raises(DeviceFault) as caught:
        motion.wait(100.0)
    assert caught.value.code == "rail.link_lost"
    with pytest.raises(DeviceFault):
        homed.rail.close()
    homed.rail.close()
    with pytest.raises(NotConnectedError):
        homed.rail.state()


def test_a_port_that_is_not_there_is_named():
    with pytest.raises(NotConnectedError, match="/dev/no-such-port"):
        connect("/dev/no-such-port", Clock())


@pytest.mark.wire
def test_a_silent_module_is_a_deadline(bench: Bench):
    with pytest.raises(DeadlineError, match=r"module address 9 \(rail\.address\), rail\.baud \(9600"):
        connect(bench.peer.url, bench.clock, address=9)


@pytest.mark.wire
def test_a_left_over_answer_is_never_taken_for_the_next_ones(module: Callable[..., str]):
    # To every request this module sends its answer and, unasked, an older position of 51.2 mm behind it.
    def answer(request: bytes) -> bytes:
        return reply(request, 0) + reply(bytes([1, 6, 1, 0]), 1_310_720)

    rail = connect(module(answer), Clock())
    assert [rail.state().position for _ in range(3)] == [0.0, 0.0, 0.0]
    assert rail.statistics.errors["stale_input"] >= 3
    rail.close()


@pytest.mark.wire
@pytest.mark.parametrize("late", [0.2, 0.6, 0.9])
def test_late_answers_never_become_those_to_later_questions(late: float):
    """Two replies are late, those behind them come at once after them: a position is that of its time, or an error."""
    listener, asked, ready = socket.create_server(("127.0.0.1", 0)), itertools.count(), threading.Event()

    def serve() -> None:
        connection, _ = listener.accept()
        with connection:
            while request := connection.recv(9):
                value = 1 if request[1] == 6 and request[2] == 255 else round(25_600 * time.monotonic()) % 2**30
                if ready.is_set() and next(asked) < 2:
                    time.sleep(late)
                connection.sendall(reply(request, value if request[1] == 6 else 0))

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    link = TmclLink(
        "rail", f"socket://127.0.0.1:{listener.getsockname()[1]}", address=1, motor=0, baud=9600, clock=Clock(),
        statistics=LinkStatistics(),
    )  # fmt: skip
    before, clock = time.monotonic(), link._clock
    offset = clock.now() - before
    ready.set()
    right = 0
    for _ in range(8):
        try:
            value, stamp, round_trip = link.get_stamped(Axis.POSITION)
        except DeadlineError:
            continue
        true = (stamp - offset) % (2**30 / 25_600)
        assert abs(value / 25_600 - true) <= 0.5 * round_trip + 0.01
        right += 1
    assert right >= 4
    link.close()
    listener.close()


@pytest.mark.wire
def test_answers_to_another_command_are_refused_twice_then_reported(module: Callable[..., str]):
    def answer(request: bytes) -> bytes:
        return reply(request) if request[1] != 6 else reply(bytes([1, 5]), 7)

    rail = connect(module(answer), Clock())
    with pytest.raises(DeadlineError, match="answer to command 5 instead of 6"):
        rail.state()
    assert rail.statistics.errors["bad_replies"] == 2
    rail.close()


@pytest.mark.wire
@pytest.mark.parametrize(
    "spoilt",
    [
        lambda good: good[:5],
        lambda good: good[:4] + bytes([good[4] ^ 0x10]) + good[5:],
        lambda good: bytes(TMCLReply(2, 9, 100, 6, 5).to_buffer()) + good,
        lambda good: bytes(TMCLReply(2, 1, 1, 6, 0).to_buffer()),
    ],
    ids=["half", "a bit", "another module's before it", "the request had a wrong sum"],
)
def test_a_spoilt_reply_is_asked_for_once_more(module: Callable[..., str], spoilt: Callable[[bytes], bytes]):
    positions = itertools.count()

    def answer(request: bytes) -> bytes:
        good = reply(request, 512_000 if request[1:3] == b"\x06\x01" else 0)
        return spoilt(good) if request[1:3] == b"\x06\x01" and next(positions) == 0 else good

    rail = connect(module(answer), Clock())
    assert (rail.state().position, rail.statistics.errors["retries"]) == (0.02, 1)
    rail.close()


@pytest.mark.wire
def test_an_adapter_that_hears_itself_is_understood(module: Callable[..., str]):
    rail = connect(module(lambda request: request + reply(request, 1), {}), Clock())
    assert rail.state().position == pytest.approx(0.002 / 51_200)
    assert list(rail.statistics.errors) == ["echoes"]
    rail.close()


@pytest.mark.wire
def test_an_adapter_that_hears_itself_alone_is_named(module: Callable[..., str]):
    with pytest.raises(DeadlineError, match="0 of 9 bytes came after the adapter's echo"):
        connect(module(lambda request: request, {}), Clock())


@pytest.mark.wire
@pytest.mark.parametrize("answers", ["refuses", "nothing"])
def test_the_motor_is_told_to_stop_whatever_becomes_of_the_search_and_of_the_replies(
    module: Callable[..., str], answers: str
):
    """A search that cannot be ended, and a module that cannot be heard, which may hear."""
    heard: list[int] = []

    def answer(request: bytes) -> bytes:
        if not heard:
            return reply(request)
        heard.append(request[1])
        return b"" if answers == "nothing" else reply(request, status=6 if request[1] == 13 else 100)

    rail = connect(module(answer), Clock())
    heard.append(0)
    with pytest.raises(DeadlineError if answers == "nothing" else DeviceFault):
        rail.stop()
    assert 3 in heard
    with suppress(DeviceError, DeadlineError):
        rail.close()


@pytest.mark.wire
def test_a_refusal_of_the_module_is_a_fault_in_words(module: Callable[..., str]):
    with pytest.raises(DeviceFault, match="invalid value") as caught:
        connect(module(lambda request: reply(request, status=4)), Clock())
    assert caught.value.code == "tmcl.refused"
