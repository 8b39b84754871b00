"""TMCL telegrams against the vendor's manual and the vendor's own library."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pytrinamic.tmcl import TMCLReply, TMCLRequest

from drivers.rail.tmcl.link import Axis, TelegramError, TmclCommand, TmclRequest, decode_firmware, decode_reply

BYTE = st.integers(0, 255)
VALUE = st.integers(-(2**31), 2**31 - 1)


@pytest.mark.parametrize(
    ("request_", "telegram"),
    [
        (TmclRequest(1, TmclCommand.ROTATE_RIGHT, 0, 0, 350), "01 01 00 00 00 00 01 5e 61"),
        (TmclRequest(1, TmclCommand.MOTOR_STOP, 0, 0), "01 03 00 00 00 00 00 00 04"),
        (TmclRequest(1, TmclCommand.MOVE_TO, 0, 0, 1000), "01 04 00 00 00 00 03 e8 f0"),
        (TmclRequest(1, TmclCommand.MOVE_TO, 0, 0, -1), "01 04 00 00 ff ff ff ff 01"),
        (TmclRequest(1, TmclCommand.GET_AXIS, Axis.POSITION, 0), "01 06 01 00 00 00 00 00 08"),
    ],
)
def test_telegrams_read_as_in_the_manual(request_: TmclRequest, telegram: str) -> None:
    assert request_.encode() == bytes.fromhex(telegram)


@given(BYTE, BYTE, BYTE, BYTE, VALUE)
def test_requests_are_byte_for_byte_those_of_the_vendors_library(
    address: int, command: int, kind: int, motor: int, value: int
) -> None:
    ours = TmclRequest(address, command, kind, motor, value).encode()
    assert ours == bytes(TMCLRequest(address, command, kind, motor, value).to_buffer())


@given(BYTE, BYTE, BYTE, BYTE, VALUE)
def test_replies_of_the_vendors_library_are_understood(
    host: int, module: int, status: int, command: int, value: int
) -> None:
    data = bytes(TMCLReply(host, module, status, command, value).to_buffer())
    reply = decode_reply(data, TmclRequest(module, command, 0, 0))
    assert (reply.host, reply.module, reply.status, reply.command, reply.value) == (
        host,
        module,
        status,
        command,
        value,
    )


@given(st.integers(0, 8), st.integers(1, 255))
def test_any_changed_byte_is_noticed(index: int, change: int) -> None:
    data = bytearray(TMCLReply(2, 1, 100, 6, 123456).to_buffer())
    data[index] ^= change
    with pytest.raises(TelegramError, match="checksum"):
        decode_reply(bytes(data), TmclRequest(1, 6, 1, 0))


@pytest.mark.parametrize("length", [0, 8, 10])
def test_a_reply_has_nine_bytes(length: int) -> None:
    with pytest.raises(TelegramError, match=f"{length} bytes"):
        decode_reply(bytes(length), TmclRequest(1, 6, 1, 0))


def test_the_answer_of_another_module_or_to_another_command_is_refused() -> None:
    data = bytes(TMCLReply(2, 3, 100, 6, 0).to_buffer())
    with pytest.raises(TelegramError, match="module 3 instead of 1"):
        decode_reply(data, TmclRequest(1, 6, 1, 0))
    with pytest.raises(TelegramError, match="command 6 instead of 5"):
        decode_reply(data, TmclRequest(3, 5, 1, 0))


def test_the_firmware_text_is_eight_characters_after_the_hosts_address() -> None:
    assert decode_firmware(b"\x021260V112") == "1260V112"
    with pytest.raises(TelegramError):
        decode_firmware(b"\x021260V1\x00\xff")


def test_a_value_beyond_32_bits_is_refused() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        TmclRequest(1, 4, 0, 0, 2**31).encode()
