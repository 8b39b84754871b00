"""What each act does: to the world, to the computer that the cell runs on, and to the files of a run that is left."""

import resource
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from cell.devices.simulated.direct import VirtualCell
from lab.bench.schedules.schedule import POWER_CUT, Entry
from sim_backends.models.arm import Power
from statemachine.journal import FILE_NAME

JOURNAL_FILES = (FILE_NAME, f"{FILE_NAME}-wal")
FRAME_BYTES, TAIL = 4096 + 24, 0.8
"""Of a page in SQLite's write-ahead log, and the share of power cuts that tear the newest one; others tear the base."""


def do_to_world(virtual: VirtualCell, entry: Entry) -> None:
    """An act of `WORLD_ACTS`; its amount is in mm, and turns by as many mrad."""
    world, m = virtual.world, 1e-3 * (entry.amount or 5.0)
    match entry.act:
        case "vehicle_bumped":
            world.vehicle.push(virtual.clock.now(), 0.6 * m, 0.8 * m, 0.2 * m)
        case "surface_moved":
            pushed = np.eye(4)
            c, s = np.cos(m), np.sin(m)
            pushed[:2, :2], pushed[:2, 3] = [[c, -s], [s, c]], (0.8 * m, 0.6 * m)
            world.slide(pushed)
        case "part_taken":
            world.part.take_away()
        case _:
            raise ValueError(f"{entry.act} is nothing that is done to the world")


def make_well(virtual: VirtualCell) -> None:
    """As a person does before a run is resumed: buttons are released, all is powered, cameras answer again."""
    virtual.clear_faults()
    virtual.scan_camera.model.clear()
    virtual.target_camera.model.clear()
    virtual.world.arm.set_power(Power.RUNNING)


class Computer:
    """The computer of the cell: its disk may be full, its clock be set; only inside its context. A full disk is the
    process's limit of a file's size: nothing that is written makes a file longer."""

    def __enter__(self) -> Self:
        self._limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        self._time, self._strftime = time.time, time.strftime
        self._ahead = 0.0
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.free_disk()
        time.time, time.strftime = self._time, self._strftime

    def fill_disk(self) -> None:
        """No file gets longer any more."""
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, self._limits[1]))

    def free_disk(self) -> None:
        """There is room again."""
        resource.setrlimit(resource.RLIMIT_FSIZE, self._limits)

    def step_clock(self, seconds: float) -> None:
        """Somebody, or a time server, sets the wall's clock by so much."""
        self._ahead += seconds
        now, shown = self._time, self._strftime

        def strftime(form: str, at: Any = None) -> str:
            return shown(form, time.localtime(now() + self._ahead) if at is None else at)

        time.time = lambda: now() + self._ahead
        time.strftime = strftime


@dataclass(frozen=True)
class LeftRun:
    """A run whose process has gone, by `act`: its folder, and its journal's files as they were then."""

    act: str
    folder: Path
    files: dict[str, bytes]

    @classmethod
    def taken(cls, folder: Path, entry: Entry) -> Self:
        """Take the files as they are now; a power cut has torn one of them."""
        files = {name: (folder / name).read_bytes() for name in JOURNAL_FILES if (folder / name).exists()}
        if entry.act == POWER_CUT:
            name, log = JOURNAL_FILES
            if entry.amount < TAIL and log in files:
                lost = 1 + round(entry.amount / TAIL * (FRAME_BYTES - 1))
                files[log] = files[log][:-lost]
            else:
                files[name] = files[name][: round((entry.amount - TAIL) / (1 - TAIL) * len(files[name]))]
        return cls(entry.act, folder, files)

    def restore(self) -> None:
        """Let the folder be as the process left it."""
        for name in (*JOURNAL_FILES, f"{FILE_NAME}-shm", "report.json"):
            (self.folder / name).unlink(missing_ok=True)
        for name, content in self.files.items():
            (self.folder / name).write_bytes(content)
