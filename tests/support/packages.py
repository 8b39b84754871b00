"""Packages as an installer leaves them: modules beside a dist-info folder that names their entry points."""

import textwrap
from pathlib import Path

RAIL = '''
"""A rail of another maker, in memory."""

from typing import Annotated, ClassVar, Literal

from drivers.make import RailConfig
from drivers.make import Make
from drivers.common.units import quantity
from drivers.errors import InterlockError, LimitError
from drivers.interfaces import Identity, LinkStatistics, RailState


class AcmeRailConfig(RailConfig):
    ADDRESS: ClassVar[str] = "port"
    driver: Literal["acme"] = "acme"
    port: str
    belt: Annotated[float, quantity("mm", 1, 10)]


class Done:
    done = True

    def wait(self, timeout):
        pass


class AcmeRail:
    def __init__(self, name, config, clock):
        self.name, self.travel, self.statistics = name, config.travel, LinkStatistics()
        self._clock, self._port = clock, config.port
        self._position, self._homed = 0.0, False

    def identity(self):
        return Identity("Acme belt rail", "A-17", "3.1", self._port)

    def ping(self):
        return 0.0

    def state(self):
        return RailState(self._clock.now(), self._position, 0.0, self._homed, False, False, False, self._homed)

    def home(self):
        self._position, self._homed = 0.0, True
        return Done()

    def move_to(self, position, speed=None):
        if not self._homed:
            raise InterlockError(self.name, "is not homed; home it first")
        if not self.travel[0] <= position <= self.travel[1]:
            raise LimitError(self.name, f"position {position} m is outside its travel")
        self._position = position
        return Done()

    def sweep_start(self, start, stop, speed):
        return start

    def sweep(self, start, stop, speed):
        raise InterlockError(self.name, "this rail does not sweep")

    def stop(self):
        pass

    def close(self):
        pass


MAKE = Make(
    "rail", "acme", AcmeRailConfig, lambda name, config, around: AcmeRail(name, config, around.clock),
    calibrated=frozenset({"belt"}),
)
'''


def install(folder: Path, package: str, version: str, entry_points: str, **modules: str) -> Path:
    """Put a package into `folder`, which is then to be on the path; `modules` are its files' texts by module name."""
    folder.mkdir(parents=True, exist_ok=True)
    info = folder / f"{package.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n")
    (info / "entry_points.txt").write_text(f"[assembly_cell.devices]\n{textwrap.dedent(entry_points).strip()}\n")
    for name, text in modules.items():
        (folder / f"{name}.py").write_text(text)
    return folder


def with_acme_rail(text: str, port: str = "/dev/acme0", belt: str = "2 mm") -> str:
    """A configuration's text with that maker's rail in it."""
    kept = ("lead", "travel", "max_speed", "acceleration")
    lines, table = [], ""
    for line in text.splitlines():
        if line.startswith("["):
            table = line[1 : line.index("]")]
            lines.append(line)
            if table == "rail":
                lines += ['driver = "acme"', f'port = "{port}"', f'belt = "{belt}"']
        elif table != "rail" or line.split(" = ")[0] in (*kept, ""):
            lines.append(line)
    return "\n".join(lines) + "\n"
