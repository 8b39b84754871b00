"""A job file: the part, where it goes, and how the cell measures and approaches that place.

Frames: place P (table top, z up), board D, nominal surface S, part Q. A mesh is named relative to the job file.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal

import pinocchio as pin
from pydantic import AfterValidator, Field

from cell.config import CellConfig, Length, Pose, Table, checked_board, read_toml, validate
from cell.units import quantity
from drivers.errors import ConfigError

RAMP_MARGIN = 0.0005
"""What the rail's driver adds to each ramp of a sweep, m."""

Speed = Annotated[float, quantity("mm/s", 0.1, 500)]


class JobSection(Table):
    """The job as a whole."""

    name: str = Field(min_length=1, max_length=64)


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
    tolerance: Annotated[float, quantity("mm", 1, 200)]
    tolerance_angle: Annotated[float, quantity("deg", 0.1, 10)]


class PhotoSection(Table):
    """How the board is photographed and what a photograph has to be like."""

    stand_off: Annotated[float, quantity("mm", 100, 5000)]
    look_down: Annotated[float, quantity("deg", 0, 90)]
    max_obliquity: Annotated[float, quantity("deg", 5, 80)]
    max_residual: Annotated[float, Field(gt=0, le=10)]
    count: Annotated[int, Field(ge=1, le=100)]


class SurfaceSection(Table):
    """The nominal surface that the part is placed onto, and how well the board tells where it is."""

    mesh: str = Field(min_length=1)
    mesh_unit: Literal["m", "mm"]
    place_from_surface: Pose
    prior_sigma: Annotated[float, quantity("mm", 0.01, 100)]
    prior_sigma_angle: Annotated[float, quantity("deg", 0.01, 20)]


class SwathSection(Table):
    """One sweep of several: `across` along the surface's y axis from its middle, the head turned about the surface's x
    axis (`roll`) and y axis (`pitch`) through the middle of what it scans."""

    across: Annotated[float, quantity("mm", -200, 200)] = 0.0
    roll: Annotated[float, quantity("deg", -40, 40)] = 0.0
    pitch: Annotated[float, quantity("deg", -20, 20)] = 0.0


class ScanSection(Table):
    """The laser sweep: along the surface's x axis by the rail, or with mode "arm" by the arm alone."""

    stand_off: Annotated[float, quantity("mm", 50, 1000)]
    length: Annotated[float, quantity("mm", 1, 2000)]
    speed: Speed
    frame_rate: Annotated[float, quantity("Hz", 1, 1000)]
    exposure: Annotated[float, quantity("ms", 0.01, 1000)]
    mode: Literal["rail", "arm"] = "rail"
    largest_hole: Annotated[float, quantity("mm", 0, 10)] = 0.0015
    swath: Annotated[tuple[SwathSection, ...], Field(min_length=1, max_length=20)] = (SwathSection(),)


class GraspSection(Table):
    """How the claw holds the part."""

    flange_from_part: Pose
    size: tuple[Length, Length, Length]


class PlaceSection(Table):
    """How the part is put down, and how exactly."""

    surface_from_part: Pose
    approach: Annotated[float, quantity("mm", 5, 500)]
    speed: Speed
    contact_speed: Annotated[float, quantity("mm/s", 0.1, 50)]
    contact_force: Annotated[float, quantity("N", 2, 120)]
    contact_travel: Annotated[float, quantity("mm", 0.1, 10)]
    tolerance: Annotated[float, quantity("mm", 0.01, 50)]
    tolerance_angle: Annotated[float, quantity("mrad", 0.1, 200)]


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

    @property
    def place_from_board(self) -> pin.SE3:
        """Pose of the board in the place frame."""
        return self.board.place_from_board.se3()


def shipped_jobs() -> list[str]:
    """Names of the jobs that ship."""
    return sorted(entry.name.removesuffix(".toml") for entry in _job_folder().iterdir() if entry.name.endswith(".toml"))


def job_path(name: str | Path) -> Path:
    """The file of a job: a path, or the name of a job that ships."""
    path = Path(name)
    if path.suffix == ".toml" or path.exists():
        return path
    if str(name) in shipped_jobs():
        return _job_folder() / f"{name}.toml"
    raise ConfigError(f"job {name} is neither a file nor one that ships ({', '.join(shipped_jobs())})")


def load_job(name: str | Path) -> tuple[Job, Path]:
    """Read and check a job; also gives the path of its mesh, which exists. Raises `ConfigError`."""
    path = job_path(name)
    job = validate(Job, read_toml(path, "job", "cell init"), str(path))
    mesh = path.parent / job.surface.mesh
    if not mesh.is_file():
        raise ConfigError(
            f"{path}: surface.mesh {job.surface.mesh!r} is not a file (looked for {mesh}); name an STL or PLY"
        )
    return job, mesh


def require_fit(job: Job, config: CellConfig) -> None:
    """Raise `ConfigError` when the job asks for more than the cell's devices may do; nothing has moved yet."""
    rail = config.rail
    ramps = job.scan.speed**2 / rail.acceleration + 2 * RAMP_MARGIN
    room = rail.travel[1] - rail.travel[0]
    problems = []
    if job.scan.mode == "rail" and job.scan.length + ramps > room:
        problems.append(
            f"scan.length {1e3 * job.scan.length:g} mm and its ramps of {1e3 * ramps:.2f} mm exceed rail.travel, "
            f"{1e3 * room:g} mm"
        )
    for name, asked, allowed, limit in (
        ("scan.speed", job.scan.speed, rail.max_speed, "rail.max_speed"),
        ("approach.speed", job.approach.speed, config.vehicle.max_speed, "vehicle.max_speed"),
        ("place.speed", job.place.speed, config.arm.max_tool_speed, "arm.max_tool_speed"),
    ):
        if asked > allowed:
            problems.append(f"{name} {1e3 * asked:g} mm/s exceeds {limit}, {1e3 * allowed:g} mm/s")
    if problems:
        raise ConfigError(f"job {job.job.name} does not fit this cell:\n  " + "\n  ".join(problems))


def _job_folder() -> Path:
    return Path(str(files("cell").joinpath("jobs")))
