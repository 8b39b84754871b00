"""Makes of lasers and claws that do not hang on the arm: relay boards on a serial port, and a gripper on its socket."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, TypeVar

from cell.base.addresses import Endpoint, Port
from cell.base.units import whole
from cell.makes.make import AnyMake, ClawConfig, DeviceConfig, LaserConfig, Make, Surroundings, real_path

if TYPE_CHECKING:
    from drivers.claw.robotiq import RobotiqClaw
    from drivers.relay.switched import BoardClaw, BoardLaser

NUMATO_BAUDS = (9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)
"""Speeds of a board on RS-232 or behind a serial server; over its own USB none of them matters."""

NumatoRelay = Annotated[int, whole(0, 31, meaning=": relays as the board counts them, from 0")]
NumatoInput = Annotated[int, whole(0, 31, meaning=": the board's GPIO as it counts them, from 0")]
Count = Annotated[int, whole(0, 255, meaning=" as the gripper counts it: 0 open, slowest, weakest; 255 the other end")]


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
        """See `DeviceConfig`."""
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
        """See `DeviceConfig`."""
        return super().wire() | {"feedback": self.feedback, "active_high": self.held_is == "high"}


class RobotiqClawConfig(ClawConfig):
    """A Robotiq gripper, on the socket of its program on the arm's controller; `inside`: it holds by spreading."""

    driver: Literal["robotiq"] = "robotiq"
    address: Annotated[str, Endpoint]
    open_at: Count = 0
    closed_at: Count = 255
    speed: Count = 128
    force: Count = 64
    inside: bool = False

    def wire(self) -> dict[str, object]:
        """See `DeviceConfig`."""
        return {"make": self.driver, "place": self.address}


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
    from drivers.relay.boards import open_board
    from drivers.relay.switched import BoardLaser

    board = open_board(name, "laser", config.driver, config.url, baud=config.baud)
    return BoardLaser(board, config.relay, control=not around.look)


def _numato_claw(name: str, config: NumatoClawConfig, around: Surroundings) -> BoardClaw:
    from drivers.relay.boards import open_numato
    from drivers.relay.switched import BoardClaw

    return BoardClaw(
        open_numato(name, "claw", config.url, baud=config.baud),
        config.relay,
        config.feedback,
        active_high=config.held_is == "high",
        clock=around.clock,
        control=not around.look,
    )


def _robotiq(name: str, config: RobotiqClawConfig, around: Surroundings) -> RobotiqClaw:
    from drivers.claw.robotiq import Grip, RobotiqClaw

    grip = Grip(config.open_at, config.closed_at, config.speed, config.force, config.inside)
    return RobotiqClaw(name, config.address, grip, clock=around.clock, control=not around.look)


Board = TypeVar("Board", bound=OnBoard)


def _at_url(record: Board, endpoint: Mapping[str, object]) -> Board:
    return record.model_copy(update={"url": endpoint["url"]})


def _at_address(record: RobotiqClawConfig, endpoint: Mapping[str, object]) -> RobotiqClawConfig:
    return record.model_copy(update={"address": endpoint["address"]})


_OPTICS = frozenset(("baseline", "tan_theta"))

SWITCH_MAKES: tuple[AnyMake, ...] = (
    Make("laser", "numato", NumatoLaserConfig, _laser, _OPTICS, simulated=_at_url),
    Make("laser", "lcus", LcusLaserConfig, _laser, _OPTICS, simulated=_at_url),
    Make("claw", "numato", NumatoClawConfig, _numato_claw, simulated=_at_url),
    Make("claw", "robotiq", RobotiqClawConfig, _robotiq, simulated=_at_address),
)
