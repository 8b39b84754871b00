"""A job as the text of its file: every value with its unit, each section with what it means.

The unit of a mesh: files such as STL do not say it. It is asked, or told by the size, never assumed in silence."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cell.config.job import Job, SwathSection
from drivers.errors import ConfigError
from drivers.make import Pose

METRES = {"mm": 1e-3, "m": 1.0, "inch": 0.0254}
LIKELY = (0.015, 0.45)
"""How long, m, the longer side of a surface is that one cell can sweep."""


def possible_units(longest: float) -> list[str]:
    """The units in which a mesh of this longest side is of a size that can be swept."""
    return [unit for unit, scale in METRES.items() if LIKELY[0] <= longest * scale <= LIKELY[1]]


def told_by_size(longest: float) -> tuple[str, str]:
    """The one unit that makes sense, and why, in words. Raises `ConfigError` where that is none, or several."""
    found = possible_units(longest)
    sizes = size_words(longest)
    if len(found) == 1:
        return found[0], f"taken as {found[0]}: of {sizes}, that alone can be swept"
    if not found:
        raise ConfigError(
            f"the mesh's longest side is {longest:.4g}: {sizes} (allowed: {1e3 * LIKELY[0]:g} to {1e3 * LIKELY[1]:g} "
            "mm), so no unit makes it a surface that one cell sweeps; cut it to what the part is placed onto, or name "
            "its unit with --unit"
        )
    raise ConfigError(
        f"the mesh's longest side is {longest:.4g}: {sizes}; which it is cannot be told: name it with --unit "
        f"{'|'.join(METRES)}"
    )


def size_words(longest: float) -> str:
    """What that side is in each unit."""
    return ", ".join(f"{1e3 * longest * scale:.4g} mm if in {unit}" for unit, scale in METRES.items())


def job_text(job: Job, heading: Sequence[str]) -> str:
    """The file of a job. `heading` are the lines of comment at its top: where it comes from, what was decided."""
    lines = [f"# {line}" for line in heading]
    lines += ["", *_station_lines(job), "", *_scan_lines(job), "", *_part_lines(job)]
    if job.part is not None:
        about = "  # beside this file, in the part's own frame: its underside is held against the scanned surface"
        lines += [
            *_look_lines(job),
            "",
            "[part]",
            f'mesh = "{job.part.mesh}"{about}',
            f'mesh_unit = "{job.part.mesh_unit}"',
            "# What is measured of the placed part, each with its own tolerance, in the part's frame:",
            "# [[part.feature]]",
            '# name = "left edge"',
            '# kind = "edge"                      # a flat counts along its axis; edge, hole and pin across it',
            '# at = ["-22 mm", "0 mm", "5 mm"]',
            "# axis = [0, 1, 0]",
            '# tolerance = "0.4 mm"',
        ]
    for obstacle in job.obstacle:
        lines += ["", "[[obstacle]]", f'name = "{obstacle.name}"', f"size = [{', '.join(map(mm, obstacle.size))}]"]
        lines.append(f"place_from_centre = {pose_text(obstacle.place_from_centre)}")
    return "\n".join(lines) + "\n"


def _look_lines(job: Job) -> list[str]:
    """How the placed part is looked at: the end of [place]."""
    place = job.place
    lines = [
        f'verify = "{place.verify}"         # of the placed part: all has to be seen, or what shows, or none',
        f"corrections = {place.corrections}         # how often at most it is gripped and placed again, 0 to 5",
    ]
    if place.accept is not None:
        lines.append(f"accept = {mm(place.accept)}                   # farther off, on average, it is corrected")
    return lines


def _station_lines(job: Job) -> list[str]:
    approach, photo = job.approach, job.photo
    return [
        "[job]",
        f'name = "{job.job.name}"',
        *([] if job.job.kind == "place" else [f'kind = "{job.job.kind}"']),
        "",
        "[board]                             # fixed beside the placement area",
        f'spec = "{job.board.spec}"',
        f"place_from_board = {pose_text(job.board.place_from_board)}",
        "",
        "[approach]                          # the vehicle in the place frame, driving along its x axis",
        f"start = {pose_text(approach.start)}",
        f"staging = {pose_text(approach.staging)}",
        f"target = {pose_text(approach.target)}",
        f'speed = "{approach.speed:.6g} m/s"',
        f"tolerance = {mm(approach.tolerance)}",
        f"tolerance_angle = {deg(approach.tolerance_angle)}",
        "",
        "[photo]",
        f"stand_off = {mm(photo.stand_off)}                # from the target camera to the board's centre",
        f"look_down = {deg(photo.look_down)}                # of the optical axis below the horizon while driving",
        f"max_obliquity = {deg(photo.max_obliquity)}",
        f"max_residual = {photo.max_residual:.6g}                  # RMS of the dots, px",
        f"count = {photo.count}                           # photographs that are averaged",
    ]


def _scan_lines(job: Job) -> list[str]:
    surface, scan = job.surface, job.scan
    return [
        "[surface]",
        f'mesh = "{surface.mesh}"        # beside this file: what of the mesh the sweeps see, in its own frame',
        f'mesh_unit = "{surface.mesh_unit}"',
        f"place_from_surface = {pose_text(surface.place_from_surface)}",
        f"prior_sigma = {mm(surface.prior_sigma)}                # how well the board tells where it is, 1 sigma",
        f"prior_sigma_angle = {deg(surface.prior_sigma_angle)}",
        "",
        "[scan]",
        f"stand_off = {mm(scan.stand_off)}                # from the scan camera to the surface's z = 0",
        f"length = {mm(scan.length)}",
        f'speed = "{1e3 * scan.speed:.6g} mm/s"',
        f'frame_rate = "{scan.frame_rate:.6g} Hz"',
        f'exposure = "{1e3 * scan.exposure:.6g} ms"',
        f'mode = "{scan.mode}"                       # "rail", or "arm": the arm moves the scan head',
        f"largest_hole = {mm(scan.largest_hole)}             # across, that is interpolated",
        f"swath = [{', '.join(_swath(swath) for swath in scan.swath)}]",
    ]


def _part_lines(job: Job) -> list[str]:
    grasp, place = job.grasp, job.place
    return [
        "[grasp]",
        f"flange_from_part = {pose_text(grasp.flange_from_part)}",
        f"size = [{', '.join(map(mm, grasp.size))}]",
        f"sigma = {mm(grasp.sigma)}                    # how exactly the claw holds it, 1 sigma: nothing sees it",
        f'sigma_angle = "{1e3 * grasp.sigma_angle:.6g} mrad"',
        "",
        "[place]",
        f"surface_from_part = {pose_text(place.surface_from_part)}",
        f"approach = {mm(place.approach)}                  # the straight line above the place pose",
        f'speed = "{1e3 * place.speed:.6g} mm/s"',
        f'contact_speed = "{1e3 * place.contact_speed:.6g} mm/s"',
        f'contact_force = "{place.contact_force:.6g} N"',
        f"contact_travel = {mm(place.contact_travel)}             # before and behind the place pose, for contact",
        f"tolerance = {mm(place.tolerance)}",
        f'tolerance_angle = "{1e3 * place.tolerance_angle:.6g} mrad"',
    ]


def mm(metres: float) -> str:
    """A length, quoted."""
    return f'"{_plain(1e3 * metres)} mm"'


def deg(radians: float) -> str:
    """An angle, quoted."""
    return f'"{_plain(math.degrees(radians))} deg"'


def pose_text(pose: Pose) -> str:
    """A pose as an inline table."""
    there, turn = ", ".join(map(mm, pose.translation)), ", ".join(map(deg, pose.rotation))
    return f"{{ translation = [{there}], rotation = [{turn}] }}"


def _swath(swath: SwathSection) -> str:
    keys = [f"across = {mm(swath.across)}"]
    keys += [f"{name} = {deg(angle)}" for name, angle in (("roll", swath.roll), ("pitch", swath.pitch)) if angle]
    return f"{{ {', '.join(keys)} }}"


def _plain(value: float) -> str:
    """No more digits than were meant: what arithmetic added in the last place is not."""
    return f"{round(value, 6):.10g}".replace("-0", "0") if round(value, 6) == 0 else f"{round(value, 6):.10g}"
