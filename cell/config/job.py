"""A job file: the part, where it goes, and how the cell measures and approaches that place.

Frames: place P (table top, z up), board D, nominal surface S, part Q. A mesh is named relative to the job file.
"""

import os
import re
from dataclasses import dataclass
from importlib.resources import files
from itertools import combinations
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, ValidationInfo, model_validator

from cell.base.toml_file import below, read_toml, validate
from cell.config.cell_config import StationObstacle, checked_board, once_each
from cell.measure.vision.board.view import parse_board
from drivers.common.addresses import Name, checked_name
from drivers.common.units import KEPT, number, quantity, shown, whole
from drivers.errors import ConfigError
from drivers.make import Exposure, Mounting, Offset, Pose, Table

LEAST_LINES, MOST_LINES = 10, 20_000
"""Lines of one sweep: fewer show no surface, more do not fit into memory."""
LONGEST_SWEEP_S = 100.0
"""The step of the laser sweep has 120 s."""

Speed = Annotated[float, quantity("mm/s", 0.1, 500)]
Share = Annotated[float, number(-1, 1)]
AreaSide = Annotated[float, quantity("mm", 1, 1000)]
"""Of a direction, along one axis."""


def _checked_job_name(text: str, info: ValidationInfo) -> str:
    # What a run has kept may be an item of a job.
    return text if info.context == KEPT and job_and_item(text)[1] is not None else checked_name(text)


class JobSection(Table):
    """The job as a whole; `kind` says which steps it has (`cell.procedures.steps.kinds`)."""

    name: Annotated[str, AfterValidator(_checked_job_name)]
    kind: Annotated[str, Name] = "place"


class BoardSection(Table):
    """The board fixed beside the placement area."""

    spec: Annotated[str, AfterValidator(checked_board)]
    place_from_board: Pose


class ApproachSection(Table):
    """The vehicle's way: from start along a straight line over staging to target, all in the place frame."""

    start: Pose
    staging: Pose
    target: Pose
    speed: Annotated[float, quantity("m/s", 0.02, 1.5)]
    tolerance: Annotated[float, quantity("mm", 1, 100)]
    tolerance_angle: Annotated[float, quantity("deg", 0.3, 10)]


class PhotoSection(Table):
    """How the board is photographed and what a photograph has to be like."""

    stand_off: Annotated[float, quantity("mm", 100, 5000)]
    look_down: Annotated[float, quantity("deg", 0, 90)]
    max_obliquity: Annotated[float, quantity("deg", 5, 80)]
    max_residual: Annotated[float, number(0.01, 10)]
    count: Annotated[int, whole(1, 100)]


def _checked_mesh_name(text: str) -> str:
    if not text.strip() or not text.isprintable():
        raise ValueError(f"{shown(text)} is no file; name an STL or PLY beside the job")
    return text


class AreaSection(Table):
    """An area of the surface whose waviness is told by itself: a rectangle along x and y of the surface's frame."""

    name: Annotated[str, Name]
    centre: tuple[Offset, Offset]
    size: tuple[AreaSide, AreaSide]

    @property
    def corners(self) -> NDArray[np.float64]:
        """Its lowest and its highest x and y (2, 2), m."""
        return np.array(self.centre) + 0.5 * np.outer((-1.0, 1.0), self.size)


class SurfaceSection(Table):
    """The nominal surface that the part is placed onto, and how well the board tells where it is."""

    mesh: Annotated[str, AfterValidator(_checked_mesh_name)]
    mesh_unit: Literal["m", "mm"]
    place_from_surface: Pose
    prior_sigma: Annotated[float, quantity("mm", 0.01, 100)]
    prior_sigma_angle: Annotated[float, quantity("deg", 0.01, 20)]
    area: tuple[AreaSection, ...] = ()

    @model_validator(mode="after")
    def _distinct_areas(self) -> Self:
        once_each("area", [area.name for area in self.area])
        return self


class FeatureSection(Table):
    """What people measure of a placed part, in the part's frame: a flat counts along its normal, an edge, a hole or a
    pin across its direction. `axis` (3,) is that normal or direction; its length does not count."""

    name: Annotated[str, Name]
    kind: Literal["flat", "edge", "hole", "pin"]
    at: tuple[Offset, Offset, Offset]
    axis: tuple[Share, Share, Share]
    tolerance: Annotated[float, quantity("mm", 0.01, 10)]

    @model_validator(mode="after")
    def _has_direction(self) -> Self:
        if not max(map(abs, self.axis)) >= 1e-3:
            raise ValueError(f"axis {self.axis} has no direction; give a flat's normal, else the feature's own")
        return self


class PartSection(Table):
    """The part as drawn, in its own frame; its underside is held against the scanned surface before the descent."""

    mesh: Annotated[str, AfterValidator(_checked_mesh_name)]
    mesh_unit: Literal["m", "mm"]
    feature: tuple[FeatureSection, ...] = ()

    @model_validator(mode="after")
    def _distinct_features(self) -> Self:
        once_each("feature", [feature.name for feature in self.feature])
        return self


class SwathSection(Table):
    """One sweep of several: `across` along the surface's y axis, from its middle.

    The head is turned about the surface's x axis (`roll`) and y axis (`pitch`), through the middle of what it scans.
    """

    across: Annotated[float, quantity("mm", -200, 200)] = 0.0
    roll: Annotated[float, quantity("deg", -40, 40)] = 0.0
    pitch: Annotated[float, quantity("deg", -20, 20)] = 0.0


class ScanSection(Table):
    """The laser sweep: along the surface's x axis by the rail, or with mode "arm" by the arm alone."""

    stand_off: Annotated[float, quantity("mm", 50, 1000)]
    length: Annotated[float, quantity("mm", 1, 2000)]
    speed: Speed
    frame_rate: Annotated[float, quantity("Hz", 1, 1000)]
    exposure: Exposure
    mode: Literal["rail", "arm"] = "rail"
    largest_hole: Annotated[float, quantity("mm", 0, 10)] = 0.0015
    swath: Annotated[tuple[SwathSection, ...], Field(min_length=1, max_length=20)] = (SwathSection(),)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.exposure * self.frame_rate > 1.0:
            raise ValueError(
                f"exposure {1e3 * self.exposure:g} ms is longer than a frame at {self.frame_rate:g} Hz (allowed: at "
                f"most {1e3 / self.frame_rate:.4g} ms); shorten it or lower frame_rate"
            )
        lines = self.length * self.frame_rate / self.speed
        if not LEAST_LINES <= lines <= MOST_LINES:
            raise ValueError(
                f"length, speed and frame_rate make {lines:.0f} lines (allowed: {LEAST_LINES} to {MOST_LINES}); "
                "change speed or frame_rate"
            )
        if (time := len(self.swath) * self.length / self.speed) > LONGEST_SWEEP_S:
            raise ValueError(
                f"{len(self.swath)} sweeps of {1e3 * self.length:g} mm at {1e3 * self.speed:g} mm/s take {time:.0f} s "
                f"(allowed: at most {LONGEST_SWEEP_S:.0f} s); raise speed or take fewer"
            )
        return self


Edge = Annotated[float, quantity("mm", 1, 1_000)]


class GraspSection(Table):
    """How the claw holds the part, and how exactly. A `load` measures that in the nest: its `sigma` does not count."""

    flange_from_part: Mounting
    size: tuple[Edge, Edge, Edge]
    sigma: Annotated[float, quantity("mm", 0, 5)] = 1e-4
    sigma_angle: Annotated[float, quantity("mrad", 0, 50)] = 1e-3

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(6, 6) of the part's place in the claw about its origin, m² and rad², the same in every direction."""
        return np.diag([self.sigma**2] * 3 + [self.sigma_angle**2] * 3)


class PlaceSection(Table):
    """How the part is put down, and how exactly."""

    surface_from_part: Pose
    approach: Annotated[float, quantity("mm", 5, 500)]
    speed: Speed
    contact_speed: Annotated[float, quantity("mm/s", 0.1, 50)]
    contact_force: Annotated[float, quantity("N", 2, 120)]
    contact_travel: Annotated[float, quantity("mm", 0.1, 10)]
    tolerance: Annotated[float, quantity("mm", 0.01, 10)]
    tolerance_angle: Annotated[float, quantity("mrad", 0.1, 100)]
    verify: Literal["all", "seen", "none"] = "all"
    corrections: Annotated[int, whole(0, 5)] = 1
    accept: Annotated[float, quantity("mm", 0.01, 10)] | None = None

    @model_validator(mode="after")
    def _descends(self) -> Self:
        if not self.approach > self.contact_travel:
            raise ValueError(
                f"approach {1e3 * self.approach:g} mm is not above contact_travel {1e3 * self.contact_travel:g} mm, "
                "where contact is looked for; raise approach"
            )
        if self.accept is not None and self.accept > self.tolerance:
            raise ValueError(
                f"accept {1e3 * self.accept:g} mm is more than tolerance {1e3 * self.tolerance:g} mm; lower accept"
            )
        if self.contact_speed > self.speed:
            raise ValueError(
                f"contact_speed {1e3 * self.contact_speed:g} mm/s exceeds speed {1e3 * self.speed:g} mm/s; the part is "
                "set down slower than it is brought"
            )
        return self


class NestSection(Table):
    """Where on the vehicle the part lies that is to be loaded, or comes to lie that is unloaded; how exactly the arm
    finds that, and how exactly it lies."""

    base_from_part: Mounting
    sigma: Annotated[float, quantity("mm", 0.01, 5)] = 2e-4
    sigma_angle: Annotated[float, quantity("mrad", 0.1, 50)] = 2e-3
    tolerance: Annotated[float, quantity("mm", 0.05, 10)] = 1e-3
    tolerance_angle: Annotated[float, quantity("mrad", 0.5, 100)] = 15e-3


class BatchSection(Table):
    """What a batch does after a refusal that left its part untouched: it ends, asks a person, or tries the next part.

    A part that is misplaced, a fault and an abort always end it. No measurement depends on it.
    """

    on_refusal: Literal["end", "ask", "skip"] = "end"


class StopSection(Table):
    """A station of several, told apart by its board. What is left out is as in [board], [approach] and [[obstacle]].

    `place_from_stop` is where its place frame lies in the place frame of the first stop, which has none.
    """

    name: Annotated[str, Name]
    place_from_stop: Pose | None = None
    board: BoardSection | None = None
    approach: ApproachSection | None = None
    obstacle: tuple[StationObstacle, ...] | None = None

    @property
    def frame(self) -> pin.SE3:
        """Its place frame in that of the first stop."""
        return pin.SE3.Identity() if self.place_from_stop is None else self.place_from_stop.se3()


@dataclass(frozen=True, eq=False)
class OtherStop:
    """Another station of a job, whose place frame lies at `place_from_stop` in the place frame of its own."""

    name: str
    place_from_stop: pin.SE3
    board: BoardSection
    approach: ApproachSection
    obstacles: tuple[StationObstacle, ...]


class ItemSection(Table):
    """One part of several: its kind, nest, surface and stop. What is left out is as in [nest] and [surface], or the
    first stop."""

    kind: Literal["load", "unload"]
    stop: Annotated[str, Name] | None = None
    base_from_part: Mounting | None = None
    place_from_surface: Pose | None = None


class Job(Table):
    """A job, as typed and checked records."""

    job: JobSection
    board: BoardSection
    approach: ApproachSection
    photo: PhotoSection
    surface: SurfaceSection
    scan: ScanSection
    grasp: GraspSection
    place: PlaceSection
    part: PartSection | None = None
    nest: NestSection | None = None
    batch: BatchSection = Field(default=BatchSection(), exclude=True)
    obstacle: tuple[StationObstacle, ...] = ()
    stop: tuple[StopSection, ...] = ()
    item: tuple[ItemSection, ...] = ()

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        once_each("obstacle", [obstacle.name for obstacle in self.obstacle])
        if self.item and self.nest is None:
            raise ValueError("[[item]] takes parts from nests, or to them: give [nest]")
        if (problem := self._stop_problem() or self._twice_there()) is not None:
            raise ValueError(problem)
        return self

    def _twice_there(self) -> str | None:
        """Which item would put a part where one lies already, or take one from where none is left."""
        known: list[tuple[str, pin.SE3, bool]] = []
        for k, item in enumerate(self.item, 1):
            assert self.nest is not None
            nest = (item.base_from_part or self.nest.base_from_part).se3()
            place = (item.place_from_surface or self.surface.place_from_surface).se3()
            for where, pose, full in (("nest", nest, item.kind == "unload"), ("place", place, item.kind == "load")):
                where = f"{where} at {item.stop}" if where == "place" and item.stop else where
                same = [was for at, was_at, was in known if at == where and was_at.isApprox(pose, 1e-6)]
                if same and same[-1] is full:
                    return f"item {k}: after those before it its {where} {'has a part' if full else 'is empty'} already"
                known.append((where, pose, full))
        return None

    def _stop_problem(self) -> str | None:
        """What is wrong with the stops, or with how items name them."""
        names = [stop.name for stop in self.stop]
        once_each("stop", names)
        used = {item.stop or (names or [""])[0] for item in self.item} - {""}
        if unknown := sorted(used - set(names)):
            return f'item.stop "{unknown[0]}" is no [[stop]] (there: {", ".join(names) or "none"}); correct its name'
        if idle := [name for name in names if name not in used]:
            return f'stop {idle[0]} has no item: write stop = "{idle[0]}" under an [[item]], or leave the stop out'
        for k, stop in enumerate(self.stop):
            once_each(f"stop {stop.name}: obstacle", [obstacle.name for obstacle in stop.obstacle or ()])
            if (stop.place_from_stop is None) is not (k == 0):
                what = "give place_from_stop" if k else "leave out place_from_stop"
                return (
                    f"stop {stop.name}: {what}; it tells of each further stop where it lies in the frame of {names[0]}"
                )
        return self._boards_alike()

    def _boards_alike(self) -> str | None:
        """Which two stops have boards that nobody tells apart."""
        seen = [(stop.name, parse_board((stop.board or self.board).spec)) for stop in self.stop]
        for (one, first), (other, second) in combinations(seen, 2):
            if first.kind == second.kind and {first.cols, first.rows} == {second.cols, second.rows}:
                return (
                    f"stops {one} and {other} have boards of {first.cols} x {first.rows} points, by which nobody tells "
                    "before which one the vehicle stands; give one of them a board of other counts"
                )
        return None

    def of_item(self, number: int) -> Self:
        """The job of an item, counted from 1: with its kind, nest, surface and stop. Items and stops leave nothing
        out."""
        assert self.nest is not None
        lies, place = self.nest.base_from_part, self.surface.place_from_surface
        stops = tuple(
            stop.model_copy(
                update={
                    "board": stop.board or self.board,
                    "approach": stop.approach or self.approach,
                    "obstacle": self.obstacle if stop.obstacle is None else stop.obstacle,
                }
            )
            for stop in self.stop
        )
        whole = [
            {
                "base_from_part": item.base_from_part or lies,
                "place_from_surface": item.place_from_surface or place,
                "stop": item.stop or next((stop.name for stop in stops), None),
            }
            for item in self.item
        ]
        items = tuple(item.model_copy(update=told) for item, told in zip(self.item, whole, strict=True))
        own, name = items[number - 1], f"{job_and_item(self.job.name)[0]}#{number}"
        nest = self.nest.model_copy(update={"base_from_part": own.base_from_part})
        surface = self.surface.model_copy(update={"place_from_surface": own.place_from_surface})
        job = self.job.model_copy(update={"name": name, "kind": own.kind})
        there = next((stop for stop in stops if stop.name == own.stop), self)
        at = {"board": there.board, "approach": there.approach, "obstacle": there.obstacle, "stop": stops}
        return self.model_copy(update={"job": job, "nest": nest, "surface": surface, "item": items, **at})

    @property
    def at_stop(self) -> str | None:
        """The name of the stop of the job of an item; None where it has no stops."""
        number = job_and_item(self.job.name)[1]
        return self.item[number - 1].stop if self.stop and number is not None else None

    @property
    def other_stops(self) -> list[OtherStop]:
        """The other stops of the job of an item."""
        return [
            OtherStop(stop.name, self._place_from(stop.name), stop.board, stop.approach, stop.obstacle)
            for stop in self.stop
            if stop.name != self.at_stop and stop.board and stop.approach and stop.obstacle is not None
        ]

    def _place_from(self, stop: str | None) -> pin.SE3:
        """The place frame of this stop in that of the job of an item."""
        frames = {each.name: each.frame for each in self.stop}
        here = frames.get(self.at_stop or "", pin.SE3.Identity())
        return here.inverse() * frames.get(stop or "", pin.SE3.Identity())

    @property
    def other_items(self) -> list[tuple[int, pin.SE3, pin.SE3]]:
        """The other items of the job of an item: their numbers, nests (base_from_part) and places (place_from_part)."""
        own, on = job_and_item(self.job.name)[1], self.place.surface_from_part.se3()
        return [
            (k, item.base_from_part.se3(), self._place_from(item.stop) * item.place_from_surface.se3() * on)
            for k, item in enumerate(self.item, 1)
            if k != own and item.base_from_part is not None and item.place_from_surface is not None
        ]

    @property
    def unloads(self) -> bool:
        """Whether the part lies on the surface at first, and is set down in the nest."""
        return self.nest is not None and self.job.kind != "load"

    @property
    def place_from_board(self) -> pin.SE3:
        """Pose of the board in the place frame."""
        return self.board.place_from_board.se3()


def shipped_jobs() -> list[str]:
    """Names of the jobs that ship."""
    return sorted(entry.name.removesuffix(".toml") for entry in _job_folder().iterdir() if entry.name.endswith(".toml"))


def job_and_item(name: str | Path) -> tuple[str, int | None]:
    """A job's name or file, and the number of an item of it: `tray4#2` is the second one of `tray4`."""
    found = re.fullmatch(r"(.+)#([1-9]\d{0,2})", os.fspath(name))
    return (os.fspath(name), None) if found is None else (found[1], int(found[2]))


def item_names(name: str | Path) -> list[str]:
    """The names of a job's items, in their order; its own where it has none, or is one itself."""
    file, number = job_and_item(name)
    items = validate(Job, read_toml(job_path(file), "job", "cell new-job"), file).item if number is None else ()
    return [f"{file}#{k}" for k in range(1, len(items) + 1)] or [str(name)]


def job_path(name: str | Path) -> Path:
    """The file of a job: a path, or a name: `NAME.toml` of the present folder, else the job of that name that ships. So
    the `pot.toml` that `cell init` wrote is the job `pot` in its folder."""
    name, _ = job_and_item(name)
    path = Path(name)
    if path.suffix == ".toml" or path.is_file():
        return path
    if re.fullmatch(r"[\w.+-]+", str(name)) and Path(f"{name}.toml").is_file():
        return Path(f"{name}.toml")
    if str(name) in shipped_jobs():
        return _job_folder() / f"{name}.toml"
    raise ConfigError(
        f"job {shown(str(name))} is neither a file, nor {shown(f'{name}.toml')} in the present folder, nor one that "
        f"ships ({', '.join(shipped_jobs())}); `cell new-job` makes one for a mesh of yours"
    )


def require_job_name(name: str) -> None:
    """`ConfigError` unless this names a job, never a path: `NAME.toml` of the present folder, or one that ships. A file
    of the present folder is a regular one in it; a link to elsewhere and a pipe are none."""
    own, _ = job_and_item(name)
    path = job_path(name) if re.fullmatch(r"[\w+-][\w.+-]{0,63}", own) else Path(name)
    if not (ships(path) or (path == Path(f"{own}.toml") and below(Path(), path.name) is not None)):
        raise ConfigError(
            f"there is no job {shown(name)}; a job is named, never addressed: {shown(f'{name[:64]}.toml')} in the "
            f"present folder, or one that ships ({', '.join(shipped_jobs())})"
        )


def ships(path: Path) -> bool:
    """Whether a job's file is one of those that ship, which nobody changes."""
    return path.parent == _job_folder()


def load_job(name: str | Path) -> tuple[Job, Path]:
    """Read and check a job; also gives the path of its surface's mesh. Raises `ConfigError`.

    Meshes exist; that of the part is named by its whole path. Of a job with items it is that of the first one, or of
    the one that is named with its number.
    """
    path, (_, number) = job_path(name), job_and_item(name)
    job = validate(Job, read_toml(path, "job", "cell new-job"), str(path))
    mesh = _mesh_of(path, "surface", job.surface.mesh)
    if job.part is not None:
        part = job.part.model_copy(update={"mesh": str(_mesh_of(path, "part", job.part.mesh).resolve())})
        job = job.model_copy(update={"part": part})
    if number is not None and number > len(job.item):
        raise ConfigError(f"{path} has {len(job.item)} items: there is no item {number}")
    return job.of_item(number or 1) if job.item else job, mesh


def _mesh_of(path: Path, section: str, name: str) -> Path:
    mesh = path.parent / name
    if not mesh.is_file():
        raise ConfigError(f"{path}: {section}.mesh {name!r} is not a file (looked for {mesh}); name an STL or PLY")
    return mesh


def shipped_mesh(mesh: Path) -> str | None:
    """The name of the shipped surface that this file is a copy of, byte for byte; None for one's own."""
    for name in shipped_jobs():
        shipped = _job_folder() / f"{name}.ply"
        # Only what the simulated world has in closed form is named as its job.
        if (
            shipped.is_file()
            and mesh.stat().st_size == shipped.stat().st_size
            and mesh.read_bytes() == shipped.read_bytes()
        ):
            return name
    return None


def _job_folder() -> Path:
    return Path(str(files("cell").joinpath("jobs")))
