"""Laser and claw on relay boards over a pseudo terminal: what is known of a relay, and when; and who else can tell."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from unittest.mock import Mock

import pytest
from numato_usb_relay.relay import Relay as VendorsClient

from drivers.clock import Clock
from drivers.errors import Aborted, CellError, DeadlineError, DeviceFault, InterlockError, NotConnectedError
from drivers.relay.boards import BoardClaw, BoardLaser, LcusBoard, RelayPort, open_board, open_numato
from sim_backends.peers.switches import LcusPeer, NumatoPeer, RelayBoard
from tests.support import until

pytestmark = pytest.mark.wire

LASER, CLAW, FEEDBACK = 2, 3, 1


@dataclass
class Wired:
    """What hangs on the board: a laser, and a claw whose feedback is low while it holds."""

    on: dict[int, bool] = field(default_factory=lambda: {LASER: False, CLAW: True})
    held: bool = True
    stuck: bool = False
    """A contact has welded: what is on stays on."""
    told: list[tuple[int, bool]] = field(default_factory=list)

    def board(self, first: int) -> RelayBoard:
        def setter(relay: int) -> object:
            def set_it(on: bool) -> None:
                self.told.append((relay, on))
                self.on[relay] = on or self.stuck
                self.held = self.held and self.on[CLAW]

            return set_it, lambda: self.on[relay]

        wired = {relay: setter(relay) for relay in self.on}
        return RelayBoard(wired, {FEEDBACK: lambda: not self.held}, first)  # type: ignore[arg-type]


@pytest.fixture
def wired() -> Wired:
    return Wired()


@pytest.fixture
def numato(wired: Wired) -> Iterator[str]:
    peer = NumatoPeer(wired.board(0), pty=True)
    peer.start()
    yield str(peer.pty)
    peer.stop()


@pytest.fixture
def lcus(wired: Wired) -> Iterator[LcusPeer]:
    peer = LcusPeer(wired.board(1), pty=True)
    peer.start()
    yield peer
    peer.stop()


def lcus_laser(url: str) -> BoardLaser:
    return BoardLaser(LcusBoard(RelayPort("laser", "laser", url, baud=9600)), LASER)


def becomes(value: bool, wired: Wired, relay: int = LASER) -> bool:
    """Whether the relay is, within half a second of the wall."""
    return until(lambda: wired.on[relay] == value, 0.5)


def test_laser_and_claw_share_one_board_and_its_port(numato: str, wired: Wired):
    laser = BoardLaser(open_board("laser", "laser", "numato", numato, baud=19200), LASER)
    board = open_numato("claw", "claw", numato, baud=19200)
    claw = BoardClaw(board, CLAW, FEEDBACK, active_high=False, clock=Clock())
    assert claw.holding
    with laser.lit():
        assert (wired.on[LASER], laser.is_on) == (True, True)
        laser.close()
        assert not wired.on[LASER]
    claw.release()
    assert not claw.holding
    with pytest.raises(DeviceFault, match="input 1 of the board does not show a held part") as met:
        claw.grip(0.1)
    assert met.value.code == "claw.no_part"
    claw.close()
    with pytest.raises(NotConnectedError):
        claw.ping()


def test_a_relay_that_sticks_says_so_when_it_is_switched_off_and_when_it_is_closed(numato: str, wired: Wired):
    laser = BoardLaser(open_board("laser", "laser", "numato", numato, baud=19200), LASER)
    sticks = pytest.raises(DeviceFault, match="shows on after it was switched off")
    with sticks, laser.lit():
        wired.stuck = True
    for act in (laser.stop, laser.close):
        with pytest.raises(DeviceFault, match="shows on after it was switched off") as met:
            act()
        assert met.value.code == "laser.relay"
    with pytest.raises(NotConnectedError), laser.lit():
        pytest.fail("lit after close")
    wired.stuck = False
    laser.close()
    assert not wired.on[LASER]
    with pytest.raises(NotConnectedError):
        laser.ping()


def test_a_stop_while_it_is_being_lit_leaves_it_off(numato: str, wired: Wired, monkeypatch):
    """Between two attempts, or before the first."""
    laser = BoardLaser(open_board("laser", "laser", "numato", numato, baud=19200), LASER)
    monkeypatch.setattr(laser, "_off_after_death", laser.stop)
    with pytest.raises(Aborted, match="stopped before it was lit"), laser.lit():
        pytest.fail("lit")
    assert not wired.on[LASER] and (LASER, True) not in wired.told
    laser.close()


def test_a_close_that_the_board_does_not_hear_can_be_done_again(numato: str, wired: Wired, monkeypatch):
    laser = BoardLaser(open_board("laser", "laser", "numato", numato, baud=19200), LASER)
    with laser.lit():
        with monkeypatch.context() as mute, pytest.raises(DeadlineError):
            mute.setattr(laser._board, "switch", Mock(side_effect=DeadlineError("laser", "no answer")))
            laser.close()
        assert wired.on[LASER]
    assert not wired.on[LASER]
    laser.close()


def test_the_makers_own_client_agrees_with_the_simulated_board(numato: str, wired: Wired):
    client = VendorsClient(numberRelays=8, port=numato, name="usb", timeout=0.1)
    assert (client.version, client.id) == ("00000009", "sim00001")
    client.relay_on(LASER)
    assert becomes(True, wired)
    assert (client.relay_read(LASER), client.relay_read(5), client.gpio_read(FEEDBACK)) == ("on", "off", "0")


def test_a_board_of_another_make_is_told_by_what_it_does_not_answer(lcus: LcusPeer):
    with pytest.raises(DeadlineError, match="of this make"):
        open_board("laser", "laser", "numato", str(lcus.pty), baud=9600)


def test_a_board_that_cannot_be_asked_is_first_switched_off_and_said_to_be_so(lcus: LcusPeer, wired: Wired):
    wired.on[LASER] = True
    laser = lcus_laser(str(lcus.pty))
    assert becomes(False, wired)
    assert not laser.is_on
    assert "cannot be asked" in laser.how_known
    with laser.lit():
        assert becomes(True, wired)
    assert becomes(False, wired)
    assert wired.told[-2:] == [(LASER, False)] * 2
    laser.close()


def test_after_a_lost_link_nobody_knows_such_a_relay_until_it_is_switched_off(lcus: LcusPeer, wired: Wired):
    laser = lcus_laser(lcus.url)
    with pytest.raises(DeviceFault) as lost, laser.lit():
        assert becomes(True, wired)
        lcus.drop()
        Clock().sleep(0.1)
        _ = laser.is_on
    assert lost.value.code == "laser.link_lost"
    # What ends the context opens the port anew, and says it again.
    assert becomes(False, wired)
    lcus.drop()
    Clock().sleep(0.1)
    for code in ("laser.link_lost", "laser.unknown"):
        with pytest.raises(DeviceFault) as met:
            _ = laser.is_on
        assert met.value.code == code
    laser.stop()
    assert not laser.is_on
    laser.close()


def test_what_is_lit_while_it_is_closed_goes_off(numato: str, wired: Wired, monkeypatch):
    laser = BoardLaser(open_board("laser", "laser", "numato", numato, baud=19200), LASER)
    closer = threading.Thread(target=laser.close)
    waited: list[bool] = []

    def lighting() -> None:
        closer.start()
        closer.join(0.3)
        waited.append(closer.is_alive())

    monkeypatch.setattr(laser, "_off_after_death", lighting)
    with contextlib.suppress(CellError), laser.lit():
        pass
    closer.join(10.0)
    assert waited == [True] and not wired.on[LASER]


def test_who_only_looks_sends_nothing(lcus: LcusPeer, wired: Wired):
    laser = BoardLaser(LcusBoard(RelayPort("laser", "laser", str(lcus.pty), baud=9600)), LASER, control=False)
    with pytest.raises(InterlockError), laser.lit():
        pass
    with pytest.raises(DeviceFault, match=r"laser\.unknown"):
        _ = laser.is_on
    laser.close()
    assert wired.told == []


OWNER = """
import sys, time
from drivers.relay.boards import open_board
from drivers.relay.boards import BoardLaser
laser = BoardLaser(open_board("laser", "laser", sys.argv[1], sys.argv[2], baud=9600), 2)
with laser.lit():
    print("lit", flush=True)
    time.sleep(60)"""


@pytest.mark.parametrize("make", ["numato", "lcus"])
def test_the_laser_goes_off_when_its_owner_is_killed(make: str, wired: Wired, request):
    port = request.getfixturevalue(make)
    url = port if isinstance(port, str) else str(port.pty)
    with subprocess.Popen([sys.executable, "-c", OWNER, make, url], stdout=subprocess.PIPE) as owner:
        assert owner.stdout is not None
        assert owner.stdout.readline() == b"lit\n"
        assert becomes(True, wired)
        os.kill(owner.pid, signal.SIGKILL)
    assert becomes(False, wired)
