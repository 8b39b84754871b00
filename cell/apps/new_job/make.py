"""A new job, from its mesh to its files: asked, proposed, checked as the cell will check it, drawn, then written.

Nothing is written before the job has passed the checks of `cell check`; nothing moves. The picture shows the surface
and what its sweeps see of it, a cut across it, and the arm at the place, from the drawing alone. Lengths in mm.
"""

import math
import shlex
import tempfile
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy.spatial import ConvexHull, cKDTree

from cell.apps.new_job.mesh_file import read_drawing
from cell.apps.new_job.proposal import SEEN_WITHIN, Proposal, known, place_from, propose, sight_problems, told_by_few
from cell.apps.new_job.questions import Asker, choice, job_name, job_text, laid_mesh, pose_text, station
from cell.apps.new_job.surface import Laid, about, as_stl
from cell.apps.new_job.sweeps import FITS, Array, SeenSurface, rivals
from cell.check.fit import require_fit
from cell.check.reach import nominal_scan, station_planner, sweep_problems
from cell.config.cell_config import CellConfig
from cell.config.job import Job, PartSection, SwathSection, load_job
from cell.devices.simulated.described import Described
from cell.measure.geometry.poses import transform
from cell.measure.inversion import NominalSurface, PlacePose, Tolerance
from cell.measure.inversion.nominal import read_mesh
from cell.measure.inversion.part_pose import seen_from_above, shown_by
from cell.motion.collision import Body, CollisionError
from cell.motion.kinematics import HOME, Unreachable
from cell.procedures.arm.photograph import base_from_place_at_target, scan_plans
from cell.procedures.sought_part import pose_record
from drivers.common.units import parse_quantity
from drivers.errors import CellError, ConfigError, NotObservable, RefusedError

STEP_MM = (0.1, 2.0)
"""How far apart lines may be, mm."""


class Made(NamedTuple):
    """The files of a new job: `job`, `mesh`, `picture`; what is known of its place beforehand, and what is not as
    usual, in words."""

    job: Path
    mesh: Path
    picture: Path
    seen: float
    place: PlacePose
    notes: tuple[str, ...]


def make_job(asker: Asker, config: CellConfig, folder: Path, overwrite: bool) -> Made:
    """Ask, propose, check, draw, write. Raises `ConfigError` for answers that fit neither each other nor the cell,
    `NotObservable` when the surface does not tell where it is."""
    drawn = asker.get(
        "mesh", "The mesh of the surface (STL, PLY, STEP)", None,
        lambda text: read_drawing(Path(text.strip()).expanduser()),
    )  # fmt: skip
    mesh = drawn.path
    laid, unit = laid_mesh(asker, drawn)
    name = job_name(asker, mesh)
    targets = folder / f"{name}.toml", _beside(folder / f"{name}.stl", mesh), folder / f"{name}.png"
    part = _part(asker, folder, name)
    written = targets[:2] if part is None or part.same else (*targets[:2], part.target)
    _require_room(asker, (*written, targets[2]), overwrite, given=[mesh] if part is None else [mesh, part.given])
    like, _ = asker.get("like", "A job at the same station (its way, photograph and speeds)", "pot", load_job)
    job = _with_part(asker, station(asker, like, name, targets[1].name, laid), part)
    step = asker.get("step", "Lines of the scan, how far apart", "0.5 mm", lambda t: parse_quantity(t, "mm", *STEP_MM))

    laid, proposal = _proposed(asker, laid, job, config, step=step)
    heading = [*_origin(mesh, unit, targets[1], laid), *proposal.notes]
    with tempfile.TemporaryDirectory() as place:
        there = Path(place)
        (there / targets[1].name).write_bytes(as_stl(proposal.surface, f"{name}: what the sweeps see, mm, z up"))
        (there / targets[0].name).write_text(job_text(proposal.job, heading), encoding="utf-8")
        if part is not None:
            (there / part.target.name).write_bytes(part.given.read_bytes())
        asker.notify("checking the job as the cell does, and whether the surface looks the same elsewhere …")
        notes = _checked(asker, there / targets[0].name, config, proposal)
        nominal = NominalSurface.load(there / targets[1].name, "mm")
        notes = [*proposal.notes, *notes, *told_by_few(proposal.seen, nominal)]
        try:
            found = _place(asker, proposal, nominal, config)
        except RefusedError:
            for note in notes:
                asker.notify(f"note: {note}")
            picture = targets[2].with_stem(f"{name}-refused")
            draw_proposal(picture, proposal, nominal, config, f"job {name}, as it was refused: nothing has moved")
            asker.notify(f"picture: {picture}; look at what the sweeps would see")
            raise
        draw_proposal(targets[2], proposal, nominal, config, f"job {name}, as proposed: nothing has moved")
        asker.notify(f"picture: {targets[2]}; look at it")
        if asker.ask is not None and asker.get("write", "Write the job", "yes", choice("yes", "no")) == "no":
            raise CellError(f"not written, as you said; the picture is {targets[2]}. Again: {_again(asker)}")
        for target in written:
            # Complete beside its target, so that the target is replaced in one step.
            near = target.with_name(f".{target.name}.new")
            near.write_bytes((there / target.name).read_bytes())
            near.replace(target)
    return Made(targets[0], targets[1], targets[2], seen=proposal.share, place=found, notes=tuple(notes))


def _origin(mesh: Path, unit: str, seen: Path, laid: Laid) -> tuple[str, ...]:
    """For the head of the job's file: where its surface comes from."""
    return (
        f"Place onto the surface of {mesh.name}. Written by `cell new-job`; change what is not as it is.",
        f"Of the mesh, in {unit}, what the sweeps see is in {seen.name}: surface_from_mesh =",
        "  " + pose_text(pose_record(laid.surface_from_mesh)),
    )


def _proposed(asker: Asker, laid: Laid, job: Job, config: CellConfig, *, step: float) -> tuple[Laid, Proposal]:
    """The sweeps for the mesh as it lies, or turned by half a turn where only that determines the place."""

    def reachable(tried: Job) -> str | None:
        return next(iter(sweep_problems(tried, config, laid.box)), None)

    asker.notify("choosing sweeps …")
    proposal = propose(laid, job, config, step=step, reachable=reachable, notify=asker.progress)
    if not proposal.open or asker.given.get("turn") is not None:
        return laid, proposal
    # The light comes aslant from behind: from the other side it falls on other flanks.
    asker.notify("choosing sweeps from the other side as well …")
    other = propose(about(laid), job, config, step=step, reachable=reachable, notify=asker.progress)
    if other.open:
        return laid, proposal
    return about(laid), replace(other, notes=(*other.notes, "turned by half a turn, to see more flanks"))


@dataclass(frozen=True)
class _PartFile:
    """The mesh of the part as it was `given`, and where it goes, beside the job."""

    given: Path
    target: Path
    section: PartSection

    @property
    def same(self) -> bool:
        """Whether it lies there already."""
        return self.target.exists() and self.target.samefile(self.given)


def _part(asker: Asker, folder: Path, name: str) -> _PartFile | None:
    """The part's mesh, where one was named; it keeps its own frame."""
    if asker.given.get("part") is None:
        return None
    unit = asker.get("part-unit", "Unit of the part's mesh", "mm", choice("mm", "m"))
    given = asker.get("part", "The mesh of the part (STL, PLY)", None, lambda text: _readable(text, unit))
    target = folder / f"{name}-part{given.suffix.lower()}"
    return _PartFile(given, target, PartSection.model_validate({"mesh": target.name, "mesh_unit": unit}))


def _with_part(asker: Asker, job: Job, part: _PartFile | None) -> Job:
    """The job with this part in place of that of the job that it is like. It looks at what shows of it once it was
    placed; what does not show is told."""
    given = {"part": None if part is None else part.section, "place": job.place.model_copy(update={"accept": None})}
    job = job.model_copy(update=given)
    if part is None:
        return job
    mesh = NominalSurface.load(part.given, part.section.mesh_unit)
    tolerance = Tolerance(job.place.tolerance, job.place.tolerance_angle)
    unseen = shown_by(seen_from_above(mesh, job.place.surface_from_part.se3()), tolerance)
    if not unseen or job.place.verify != "all":
        return job
    asker.notify(f'the part\'s faces do not show {", ".join(unseen)}: verify = "seen", the rest is looked at')
    return job.model_copy(update={"place": job.place.model_copy(update={"verify": "seen"})})


def _readable(text: str, unit: str) -> Path:
    path = Path(text.strip()).expanduser()
    read_mesh(path, unit)
    return path


def _beside(target: Path, mesh: Path) -> Path:
    """Never over the mesh that was given."""
    same = target.exists() and target.samefile(mesh)
    return target.with_name(f"{target.stem}-surface.stl") if same else target


def _require_room(asker: Asker, targets: tuple[Path, ...], overwrite: bool, given: list[Path]) -> None:
    if not targets[0].parent.is_dir():
        raise ConfigError(f"there is no folder {targets[0].parent}; make it first, or name another one with --folder")
    for target in targets:
        if target.exists() and any(map(target.samefile, given)):
            raise ConfigError(f"{target} is a mesh that was given, and would be overwritten; take another --name")
    there = [str(target) for target in targets if target.exists()]
    if not there or overwrite:
        return
    if asker.ask is not None:
        asker.notify(f"there already: {', '.join(there)}")
        if asker.get("overwrite", "Overwrite", "no", choice("yes", "no")) == "yes":
            return
    raise ConfigError(f"{', '.join(there)}: there already; name the job otherwise with --name, or say --overwrite")


def _checked(asker: Asker, path: Path, config: CellConfig, proposal: Proposal) -> list[str]:
    """What `cell check` and the simulation say of the job as it is written; and what the part in the claw hides."""
    try:
        job, mesh = load_job(path)
        if problems := list(sight_problems(job, config, proposal.seen)):
            raise ConfigError(f"job {job.job.name} does not fit this cell:\n  " + "\n  ".join(problems))
        require_fit(job, config, mesh)
    except ConfigError as error:
        raise ConfigError(f"{error}\nNothing was written. Again, changed: {_again(asker)}") from error
    try:
        Described(job, mesh).drawing(config)
        require_fit(job, config, mesh, calibrates=True)
    except ConfigError as error:
        return [f"a real cell does this job, a simulated one does not: {error}"]
    return []


def _place(asker: Asker, proposal: Proposal, nominal: NominalSurface, config: CellConfig) -> PlacePose:
    job = proposal.job
    try:
        known(proposal.seen, nominal, job, config).require()
        _require_single(rivals(proposal.seen, nominal, job), job)
        return place_from(proposal.seen, nominal, job, config)
    except NotObservable as error:
        shift, angle = (_below(1e3 * allowed / 3) for allowed in (job.place.tolerance, job.place.tolerance_angle))
        told = NotObservable(
            f"this surface does not tell where it is, which is known before anything is swept: {error}. Slopes, cones "
            "and fillets that the head sees tell it; upright walls, which it does not see, and flat tops do not. Where "
            f'the surface is fixed to the board more exactly than stated, say so: --prior "{shift} mm", --prior-angle '
            f'"{angle} mrad", or less, and the board decides; where the part may lie shifted or turned by so much, '
            f"say that: --tolerance, --tolerance-angle. No job was written. Again: {_again(asker)}",
            *error.numbers,
        )
        raise told from error
    except RefusedError as error:
        raise RefusedError(
            f"the proposed scan would be refused: {error}. No job was written. Again: {_again(asker)}"
        ) from error


def _require_single(others: list[tuple[Array, float]], job: Job) -> None:
    """Refuse a surface that looks the same somewhere else, where the board does not tell which place it is."""
    if not others:
        return
    (x, y, z), turned = 1e3 * others[0][0], others[0][1]
    away = float(np.linalg.norm(others[0][0]))
    limit = (
        f'--prior "{_below(1e3 * away / 6)} mm"'
        if away > job.place.tolerance
        else f'--prior-angle "{_below(1e3 * turned / 6)} mrad"'
    )
    raise RefusedError(
        f"the surface looks the same elsewhere: shifted by ({x:.1f}, {y:.1f}, {z:.1f}) mm and turned by "
        f"{1e3 * turned:.0f} mrad, {100 * FITS:.0f} % or more of what the sweeps see fits as well ({len(others)} such "
        f"places), and the board leaves that open. Take in an end or a feature that comes once; or, where it is fixed "
        f"to the board as exactly, say {limit} or less"
    )


def _below(most: float) -> str:
    """A number to propose that is well inside `most`: a tenth less, rounded down to two digits."""
    digit = 10.0 ** (math.floor(math.log10(0.9 * most)) - 1)
    return f"{math.floor(0.9 * most / digit) * digit:.2g}"


def _again(asker: Asker) -> str:
    words = [f"--{option} {shlex.quote(text)}" for option, text in asker.used.items() if option != "write"]
    return " ".join(["cell new-job", *words, *(["--yes"] if asker.ask is None else [])])


COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:purple", "tab:brown", "tab:olive", "tab:cyan", "tab:pink")
PLACES = 6000
"""Places drawn evenly over the surface, at which it is looked whether they are seen."""
SHADES = {"part": "tab:red", "surface": "tab:green", "table": "0.75", "board": "tab:blue", "scan head": "tab:orange",
          "target camera": "tab:purple", "deck": "0.6"}  # fmt: skip


def draw_proposal(path: Path, made: Proposal, nominal: NominalSurface, config: CellConfig, title: str) -> None:
    """Draw it to a PNG."""
    figure = Figure(figsize=(18.0, 11.0), dpi=90)
    figure.suptitle(title)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.15, 1.0], left=0.05, right=0.98, bottom=0.06, top=0.91,
                               wspace=0.14, hspace=0.3)  # fmt: skip
    _draw_map(figure, figure.add_subplot(grid[0, 0]), made, nominal)
    _draw_cut(figure.add_subplot(grid[1, 0]), made)
    above, beside = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    _draw_cell(above, beside, made, config, nominal)
    figure.savefig(path)


def _draw_map(figure: Figure, axes: Axes, made: Proposal, nominal: NominalSurface) -> None:
    """The surface from above by its height, what no sweep sees of it in red, the strips of the sweeps, the part."""
    corners = 1e3 * nominal.vertices[nominal.triangles]
    order = np.argsort(corners[:, :, 2].mean(axis=1))
    shown = PolyCollection(
        list(corners[order][:, :, :2]), array=corners[order][:, :, 2].mean(axis=1), cmap="viridis", edgecolors="face",
        linewidths=0.3,
    )  # fmt: skip
    axes.add_collection(shown)
    shares = nominal.areas[nominal.sample_triangles] / np.bincount(nominal.sample_triangles)[nominal.sample_triangles]
    drawn = np.random.default_rng(0).choice(len(nominal.samples), PLACES, p=shares / shares.sum())
    samples = nominal.samples[drawn]
    points = np.concatenate([each.points[each.valid] for each in made.seen])
    missed = np.asarray(cKDTree(points).query(samples, distance_upper_bound=SEEN_WITHIN)[0] > SEEN_WITHIN)
    hidden = 1e3 * samples[missed]
    axes.scatter(hidden[:, 0], hidden[:, 1], color="tab:red", s=3, linewidths=0, label="not seen by any sweep")
    for k, each in enumerate(made.seen):
        axes.plot(*1e3 * _outline(each).T, color=COLOURS[k % len(COLOURS)], linewidth=1.6)
    x, y, _ = 1e3 * np.array(made.job.grasp.size)
    where = 1e3 * made.job.place.surface_from_part.se3().translation
    axes.add_patch(
        Rectangle(
            (where[0] - x / 2, where[1] - y / 2), x, y, fill=False, linestyle=":", edgecolor="k", label="the part"
        )
    )
    axes.autoscale()
    axes.set_aspect("equal")
    axes.set_xlabel("x of the surface in mm, the way of the sweeps →")
    axes.set_ylabel("y in mm")
    axes.set_title(f"from above: {100 * (1 - float(missed.mean())):.0f} % of the surface is seen", fontsize="medium")
    axes.legend(fontsize=7, loc="lower left")
    figure.colorbar(shown, ax=axes, label="height in mm", shrink=0.8, pad=0.02)


def _outline(seen: SeenSurface) -> Array:
    """Around what a sweep sees, (n, 2) m, closed."""
    points = seen.points[seen.valid][:, :2]
    if len(points) < 4:
        return np.empty((0, 2))
    hull = points[ConvexHull(points).vertices]
    return np.vstack([hull, hull[:1]])


def _draw_cut(axes: Axes, made: Proposal) -> None:
    """Across the sweeps: the surface's points, and from where each sweep's camera looks at them."""
    for k, each in enumerate(made.seen):
        colour = COLOURS[k % len(COLOURS)]
        axes.plot([], [], color=colour, label=_sweep_words(k, made.job.scan.swath[k]))
        middle = len(each.rail) // 2
        points = each.points[each.valid]
        some = 1e3 * points[:: max(1, len(points) // 3000)]
        axes.plot(some[:, 1], some[:, 2], ",", color=colour)
        line = each.points[middle][np.isfinite(each.points[middle][:, 0])]
        if len(line):
            eye = each.eyes[middle]
            for end in (line[np.argmin(line[:, 1])], line[np.argmax(line[:, 1])]):
                axes.plot(*1e3 * np.array([eye[1:], end[1:]]).T, color=colour, linewidth=0.9)
            axes.plot(*1e3 * eye[1:], "s", color=colour)
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("y of the surface in mm")
    axes.set_ylabel("height in mm")
    scan = made.job.scan
    axes.set_title(
        f"across the sweeps: camera {1e3 * scan.stand_off:.0f} mm above z = 0, {len(scan.swath)} × "
        f"{1e3 * scan.length:.0f} mm by the {scan.mode}, lines {1e3 * scan.speed / scan.frame_rate:.2f} mm apart",
        fontsize="medium",
    )
    axes.legend(fontsize=7, loc="upper left")


def _sweep_words(k: int, swath: SwathSection) -> str:
    tilts = (("roll", swath.roll), ("pitch", swath.pitch))
    tilt = "".join(f", {name} {np.degrees(angle):.0f}°" for name, angle in tilts if angle)
    return f"sweep {k + 1}: {1e3 * swath.across:+.1f} mm across{tilt}"


def _draw_cell(above: Axes, beside: Axes, made: Proposal, config: CellConfig, nominal: NominalSurface) -> None:
    """The bodies of the collision check in the arm's base, with the arm at the first sweep."""
    job = made.job
    planner = station_planner(job, config, nominal.extent)
    surface = base_from_place_at_target(config, job) * job.surface.place_from_surface.se3()
    plan = scan_plans(config, job, surface, nominal_scan(config))[0]
    try:
        joints, where = planner.reach(plan.base_from_flange, HOME, "the scan pose"), "at the first sweep"
    except (Unreachable, CollisionError):
        joints, where = HOME, "folded: the first sweep is out of reach"
    placed = planner.collisions.placed(joints)
    for axes, (first, second), title in ((above, (0, 1), "from above"), (beside, (0, 2), "from the side")):
        for body in placed:
            hull = 1e3 * _silhouette(body, first, second)
            colour = SHADES.get(body.name, "0.4")
            label = body.name if body.name in SHADES else None
            axes.add_collection(PolyCollection([hull], facecolor=colour, edgecolor="0.2", alpha=0.45, label=label))
            axes.update_datalim(hull)
        axes.autoscale_view()
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("x of the arm's base in mm")
        axes.set_ylabel("y in mm" if second == 1 else "z in mm")
        axes.set_title(f"{title}, the arm {where}", fontsize="medium")
    beside.legend(fontsize=7, loc="upper right")


def _silhouette(body: Body, first: int, second: int) -> Array:
    """Corners (n, 2) m around a body as seen along the third axis."""
    corners = np.array(list(product(*((-h, h) for h in 0.5 * np.array(body.size)))))
    points = transform(body.placement, corners)
    if body.radius is not None:
        angles = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
        circle = np.zeros((24, 3))
        circle[:, first], circle[:, second] = body.radius * np.cos(angles), body.radius * np.sin(angles)
        points = (points[:, None] + circle).reshape(-1, 3)
    flat = points[:, [first, second]]
    made: Array = flat[ConvexHull(flat).vertices]
    return made
