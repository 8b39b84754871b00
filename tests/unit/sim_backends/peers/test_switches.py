"""A relay board of four-byte commands, without its wire. The other boards have clients of their makers."""

from sim_backends.peers.switches import LcusPeer, RelayBoard


def test_a_board_of_four_bytes_switches_for_the_right_sum_only_and_never_answers():
    on = {1: False, 3: True}
    said: list[bytes] = []
    wired = {relay: (lambda value, r=relay: on.__setitem__(r, value), lambda r=relay: on[r]) for relay in on}
    peer = LcusPeer(RelayBoard(wired, {}, 1))
    rest = peer._hear(bytes([0xA0, 1, 1, 0xA2, 0xFF, 0xA0, 3, 0, 0xA3, 0xA0, 3, 1, 0x00]), said.append)
    assert rest == bytes([3, 1, 0])
    assert (on, said) == ({1: True, 3: False}, [])
    peer.stop()
