"""What a check works at: the open cell, the person beside it, slow moves, and where pictures go.

The cell is opened anew when its configuration was changed. Nothing of one check is needed by the next but what stands
in the configuration, and where a camera was seen to see its board last.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from cell.apps.commission.check import Result
from cell.config.cell_config import load_config
from cell.config.job import Job, load_job
from cell.devices.devices import Devices
from cell.devices.simulated.process import cause_fault, make_ready
from cell.motion.kinematics import HOME, Joints
from cell.procedures.arm.moves import Mover, moved_once_more
from cell.run.recorded_work import WorkContext
from drivers.errors import RefusedError
from drivers.interfaces import Frame, Image
from statemachine.step import Observer

if TYPE_CHECKING:
    from cell.config.cell_config import CellConfig
    from cell.run.session.supervisor import Cell

SLOW_JOINT = math.radians(15.0)
"""Of the leading joint in free moves, rad/s."""
SLOW_TOOL = 0.15
"""Of any point of tool and part in free moves, m/s."""
WIDEST_PICTURE = 640


class Person:
    """Whoever stands beside the cell: confirms what is to move, says what sensors cannot see, lends a hand. `ask` shows
    a text and gives yes or no."""

    def __init__(self, ask: Callable[[str], bool]) -> None:
        self._ask = ask

    def go_ahead(self, text: str) -> bool:
        """Whether what `text` announces may begin."""
        return self._ask(f"{text}\n  A hand on the emergency stop. Go ahead?")

    def sees(self, question: str) -> bool:
        """Yes or no to a question about what there is to be seen."""
        return self._ask(question)

    def again(self, question: str) -> bool:
        """Whether something was changed meanwhile and is to be measured again."""
        return self._ask(question)

    def does(self, task: str, by_itself: Callable[[], None] | None = None) -> bool:
        """Have a person do something; False if they would not. A simulated person does it as `by_itself` says."""
        return self._ask(f"{task} Done?")


class SimulatedPerson(Person):
    """Of a simulated cell: agrees to everything, has changed nothing, and says so through `notify`."""

    def __init__(self, notify: Callable[[str], None]) -> None:
        def agree(text: str) -> bool:
            notify(f"{text} (simulated person: yes)")
            return True

        super().__init__(agree)

    def again(self, question: str) -> bool:
        return False

    def does(self, task: str, by_itself: Callable[[], None] | None = None) -> bool:
        agreed = super().does(task)
        if by_itself is not None:
            by_itself()
        return agreed


class SlowMover(Mover):
    """Moves that are planned anew, once, after a fault that a program may clear by itself, such as a lost program."""

    def to(self, base_from_flange: pin.SE3, what: str, within: float = 0.0) -> None:
        moved_once_more(self._arm, lambda: Mover.to(self, base_from_flange, what, within))

    def to_joints(self, joints: Joints, settle: bool = True) -> None:
        moved_once_more(self._arm, lambda: Mover.to_joints(self, joints, settle))


class Declined(RefusedError):
    """A person did not want this check to go on."""


@dataclass
class CommissionWorkplace:
    """`path` is the configuration's file, `open_cell` connects the cell as it now says. `folder` takes pictures.
    `simulated`: all of its devices are, and their world can be told what to do."""

    path: Path
    open_cell: Callable[[], Cell]
    person: Person
    folder: Path
    job_file: str
    simulated: bool
    context: WorkContext | None = None
    heard: Observer | None = None
    """Is told what goes on in a check, such as a question to a person."""
    last_views: dict[str, pin.SE3] = field(default_factory=dict)
    """base_from_flange at which each camera saw its board last."""
    _cell: Cell | None = None
    _config: CellConfig | None = None
    _confirmed: set[tuple[str, ...]] = field(default_factory=set)

    @property
    def cell(self) -> Cell:
        """The cell, opened if need be."""
        return self.connect()

    @property
    def config(self) -> CellConfig:
        """Its configuration as the file has it, read anew after `close`."""
        if self._config is None:
            self._config = load_config(self.path)
        return self._config

    @property
    def devices(self) -> Devices:
        """Its devices."""
        return self.cell.devices

    @property
    def job(self) -> Job:
        """The first job."""
        return load_job(self.job_file)[0]

    def connect(self) -> Cell:
        """Open the cell as the file now says, unless it is open."""
        if self._cell is None:
            self._cell = self.open_cell()
        return self._cell

    def close(self) -> None:
        """Let go of the cell; `cell` opens it again."""
        self._config = None
        if self._cell is not None:
            cell, self._cell = self._cell, None
            cell.close()

    def fill_claw(self) -> None:
        """At a simulated cell: what a person's hands do, who puts the job's part into the claw."""
        from cell.devices.simulated.described import Described

        described = Described.of(self.job_file)
        if self.cell.simulated is not None:
            self.cell.simulated.make_ready(described)
        elif self.cell.config.cell.truth:
            make_ready(self.cell.config.cell.truth, described.drawing(self.config).as_json())

    def cause(self, fault: str) -> None:
        """At a simulated cell: cause a fault by its name."""
        if self.cell.simulated is not None:
            self.cell.simulated.fault(fault)
        else:
            cause_fault(self.cell.config.cell.truth, fault)

    def confirm(self, axis: str, moves: str, far: str, fast: str) -> None:
        """A person's word before an axis moves so far and so fast for the first time in this session, or `Declined`."""
        if (axis, far, fast) in self._confirmed:
            return
        if not self.person.go_ahead(f"{axis} moves for the first time: {moves}, {far}, {fast}."):
            raise Declined(f"{axis} was not to move")
        self._confirmed.add((axis, far, fast))

    def look_around(self) -> None:
        """Raise when the work is to end; wait while it is paused."""
        if self.context is not None:
            self.context.safe_point()

    def mover(self) -> Mover:
        """Planned moves of the arm at the speed of somebody who stands beside it; the vehicle is braked first. The claw
        may hold the job's part: ways keep clear of it either way."""
        self.confirm(
            "the arm as a whole", "planned ways above the deck", "up to its whole reach",
            f"at most {math.degrees(SLOW_JOINT):.0f} deg/s and {1e3 * SLOW_TOOL:.0f} mm/s",
        )  # fmt: skip
        self.brake()
        arm, devices = self.config.arm, self.devices
        slow = {
            "max_joint_speed": min(arm.max_joint_speed, SLOW_JOINT),
            "max_tool_speed": min(arm.max_tool_speed, SLOW_TOOL),
        }
        config = self.config.model_copy(update={"arm": arm.model_copy(update=slow)})
        return SlowMover(devices.arm, devices.clock, config, self.job, self.look_around, interlocks=devices.interlocks)

    def brake(self) -> None:
        """The vehicle braked, as the arm needs it."""
        if not self.devices.vehicle.state().braked:
            self.devices.vehicle.recover()

    def fold(self) -> None:
        """The arm to its folded posture above the deck, unless it is there."""
        if np.abs(self.devices.arm.state().joints - HOME).max() > math.radians(1.0):
            self.mover().to_joints(HOME)

    def home_rail(self) -> None:
        """The rail's zero, if this program has not found it."""
        rail = self.devices.rail
        if not rail.state().homed_here:
            self.confirm("rail", "it searches its home switch", "its whole travel at most", "half its configured speed")
            rail.home().wait(120.0)

    def keep(self, result: Result, name: str, frame: Frame, marks: ArrayLike | None = None) -> None:
        """Keep a picture for the protocol, with points (n, 2) px marked in it, and the whole frame in the run."""
        if self.context is not None:
            self.context.keep(name, frame)
        pictures = self.folder / "pictures"
        pictures.mkdir(parents=True, exist_ok=True)
        path = pictures / f"{name}.png"
        cv2.imwrite(str(path), _shown(frame.image, marks))
        told = f"pictures/{path.name}"
        if told not in result.pictures:
            result.pictures.append(told)


def _shown(image: Image, marks: ArrayLike | None) -> cv2.typing.MatLike:
    picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    share = min(1.0, WIDEST_PICTURE / image.shape[1])
    small = cv2.resize(picture, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    for x, y in [] if marks is None else np.asarray(marks) * share:
        cv2.circle(small, (round(float(x)), round(float(y))), 2, (0, 200, 0), -1)
    return small
