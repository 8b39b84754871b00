"""Relay boards and the gripper, byte by byte and word by word, without their wires."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sim_backends.clock import SteppedClock
from sim_backends.peers.switches import PART_AT, LcusPeer, NumatoPeer, RelayBoard, RobotiqPeer
from sim_backends.world.drawing import STOCK
from sim_backends.world.world import World


def board(first: int, on: dict[int, bool]) -> RelayBoard:
    wired = {relay: (lambda value, r=relay: on.__setitem__(r, value), lambda r=relay: on[r]) for relay in on}
    return RelayBoard(wired, {1: lambda: False}, first)


def test_a_board_with_a_command_line_repeats_answers_and_prompts() -> None:
    on = {2: False}
    said: list[bytes] = []
    peer = NumatoPeer(board(0, on))
    rest = peer._hear(
        b"relay on 2\rrelay read 2\rgpio read 1\rgpio read 2\rrelay readall\rrelay on 9\rver\rrel", said.append
    )
    assert (rest, on) == (b"rel", {2: True})
    assert said == [
        b"relay on 2\n\r>", b"relay read 2\n\ron\n\r>", b"gpio read 1\n\r0\n\r>", b"gpio read 2\n\r1\n\r>",
        b"relay readall\n\r04\n\r>", b"relay on 9\n\r>", b"ver\n\r00000009\n\r>",
    ]  # fmt: skip
    peer.stop()


def test_a_board_of_four_bytes_switches_for_the_right_sum_only_and_never_answers() -> None:
    on = {1: False, 3: True}
    said: list[bytes] = []
    peer = LcusPeer(board(1, on))
    assert peer._hear(bytes([0xA0, 1, 1, 0xA2, 0xFF, 0xA0, 3, 0, 0xA3, 0xA0, 3, 1, 0x00]), said.append) == bytes(
        [3, 1, 0]
    )
    assert (on, said) == ({1: True, 3: False}, [])
    peer.stop()


@pytest.fixture
def world() -> World:
    cell = replace(STOCK.cell, claw_output=None, grip_input=None)
    return World(1, "ideal", drawing=replace(STOCK, cell=cell), clock=SteppedClock())


def test_the_gripper_tells_what_it_finds_and_obeys_only_while_it_is_active(world: World) -> None:
    peer = RobotiqPeer(world, world.clock)

    def after(seconds: float, *lines: str) -> list[str]:
        world.clock.sleep(seconds)
        world.arm.tick(world.clock.now())
        return [peer.answer(line) for line in lines]

    assert after(0.1, "GET STA", "GET OBJ", "GET POS") == ["STA 3", "OBJ 2", f"POS {PART_AT}"]
    assert after(0.1, "SET POS 0 SPE 255", "SET POS 256", "SET STA 3", "GET NONSENSE") == ["ack", "?", "?", "?"]
    assert after(0.1, "GET OBJ") == ["OBJ 0"]
    assert after(1.0, "GET OBJ", "GET PRE", "SET POS 255") == ["OBJ 3", "PRE 0", "ack"]
    assert after(2.0, "GET OBJ", "GET POS") == ["OBJ 3", "POS 255"], "closed on nothing"
    peer.fault("claw.overcurrent")
    assert after(0.1, "GET FLT", "SET POS 0") == ["FLT 14", "ack"]
    assert after(1.0, "GET POS", "SET ACT 0", "SET ACT 1", "GET STA", "GET FLT")[0] == "POS 255"
    assert (after(0.1, "GET STA", "GET FLT"), after(2.0, "GET STA")) == (["STA 1", "FLT 0"], ["STA 3"])
    peer.stop()
