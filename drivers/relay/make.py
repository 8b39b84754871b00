"""The makes `numato` and `lcus` of lasers and claws: relays of a board on a serial port."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from drivers.common.addresses import Port
from drivers.common.units import whole
from drivers.make import AnyMake, ClawConfig, DeviceConfig, LaserConfig, Make, Surroundings, real_path, with_endpoint

if TYPE_CHECKING:
    from drivers.relay.boards import BoardClaw, BoardLaser

NUMATO_BAUDS = (9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)
"""Speeds of a board on RS-232 or behind a serial server; over its own USB none of them matters."""

NumatoRelay = Annotated[int, whole(0, 31, meaning=": relays as the board counts them, from 0")]
NumatoInput = Annotated[int, whole(0, 31, meaning=": the board's GPIO as it counts them, from 0")]


class OnBoard(DeviceConfig):
    """A device on a relay of a board at a serial port. Several devices may be on relays of one board."""

    ADDRESS: ClassVar[str] = "url"

    url: Annotated[str, Port]
    relay: int
    baud: int

    @property
    def place(self) -> str:
        """The port and the relay."""
        return f"{self.url} relay {self.relay}"

    @property
    def held(self) -> str:
        """The port, by the name of what it is."""
        return real_path(self.url)

    def wire(self) -> dict[str, object]:
        return {"make": self.driver, "place": self.held, "relay": self.relay}


class NumatoLaserConfig(OnBoard, LaserConfig):
    """A laser on a relay of a Numato board."""

    CAUTION: ClassVar[str] = (
        "nothing switches the laser off when the cable to its board is cut and the board has a supply of its own"
    )

    driver: Literal["numato"] = "numato"
    relay: NumatoRelay
    baud: Annotated[int, whole(9600, 921600, allowed=NUMATO_BAUDS)] = 19200


class LcusLaserConfig(OnBoard, LaserConfig):
    """A laser on a relay of an LCUS board, which cannot be asked what its relays show."""

    CAUTION: ClassVar[str] = (
        "this board cannot be asked what its relay shows: the laser counts as off when it was told so; and nothing "
        "switches it off when the cable is cut and the board has a supply of its own"
    )

    driver: Literal["lcus"] = "lcus"
    relay: Annotated[int, whole(1, 8, meaning=": relays as the board counts them, from 1")] = 1
    baud: Annotated[int, whole(9600, 115200, allowed=(9600, 115200))] = 9600


class NumatoClawConfig(OnBoard, ClawConfig):
    """A claw that a relay of a Numato board closes; one of its inputs shows a held part, by the level `held_is`."""

    CAUTION: ClassVar[str] = (
        "a board that loses its supply opens its relay, and the claw with it, unless a spring holds"
    )

    driver: Literal["numato"] = "numato"
    relay: NumatoRelay
    feedback: NumatoInput
    held_is: Literal["high", "low"] = "high"
    baud: Annotated[int, whole(9600, 921600, allowed=NUMATO_BAUDS)] = 19200

    def wire(self) -> dict[str, object]:
        return super().wire() | {"feedback": self.feedback, "active_high": self.held_is == "high"}


def line_problems(records: Mapping[str, DeviceConfig]) -> Iterator[str]:
    """What is wrong with how devices share serial ports: only relays of one board, of one make, at one speed, may."""
    boards = {name: record for name, record in records.items() if isinstance(record, OnBoard)}
    for name, board in boards.items():
        for other, record in records.items():
            if other == name or board.held.lower() != record.held.lower():
                continue
            if not isinstance(record, OnBoard):
                yield f"{name}.url and {other}.{record.ADDRESS} are both {board.url}; each has a port of its own"
            elif (record.driver, record.baud) != (board.driver, board.baud):
                yield (
                    f"{name} and {other} are both at {board.url}, so on one board; driver and baud have to be the same "
                    f'("{board.driver}" at {board.baud}, "{record.driver}" at {record.baud})'
                )


def _laser(name: str, config: NumatoLaserConfig | LcusLaserConfig, around: Surroundings) -> BoardLaser:
    from drivers.relay.boards import BoardLaser, open_board

    board = open_board(name, "laser", config.driver, config.url, baud=config.baud)
    return BoardLaser(board, config.relay, control=not around.look)


def _claw(name: str, config: NumatoClawConfig, around: Surroundings) -> BoardClaw:
    from drivers.relay.boards import BoardClaw, open_numato

    return BoardClaw(
        open_numato(name, "claw", config.url, baud=config.baud), config.relay, config.feedback,
        active_high=config.held_is == "high", clock=around.clock, control=not around.look,
    )  # fmt: skip


_OPTICS = frozenset(("baseline", "tan_theta"))

RELAYS: tuple[AnyMake, ...] = (
    Make("laser", "numato", NumatoLaserConfig, _laser, _OPTICS, simulated=with_endpoint("url")),
    Make("laser", "lcus", LcusLaserConfig, _laser, _OPTICS, simulated=with_endpoint("url")),
    Make("claw", "numato", NumatoClawConfig, _claw, simulated=with_endpoint("url")),
)
