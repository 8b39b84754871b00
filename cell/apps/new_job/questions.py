"""Questions of a new job, each with its default: answered by an option, by a person, or by the default itself; and
from the answers to a mesh laid on the table and to a job without its scan.

An answer is checked by the job file's own rule for that value. A wrong one is told with the range that is allowed; a
person is asked again, an option ends the command. The file that comes of the answers has every value with its unit.

The unit of a mesh: files such as STL do not say it. It is asked, or told by the size, never assumed in silence.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import pinocchio as pin
from pydantic import BaseModel, TypeAdapter, ValidationError

from cell.apps.new_job.mesh_file import Drawn, MeshBody
from cell.apps.new_job.surface import METRES, UP, Laid, centred, faces_down, lay, open_side, overlapping, raised
from cell.base.toml_file import wording
from cell.config.job import BoardSection, GraspSection, Job, JobSection, PlaceSection, SurfaceSection
from cell.measure.geometry.poses import from_parts
from cell.measure.vision.board.view import centre_of, parse_board
from cell.procedures.sought_part import pose_record
from cell.run.report.page import render
from drivers.common.addresses import checked_name
from drivers.common.units import parse_quantity, shown
from drivers.errors import ConfigError
from drivers.make import Mounting, Pose

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
    """The file of a job, as `job.toml.jinja` has it. `heading` are the lines of comment at its top: where it comes
    from, what was decided."""
    return render(
        __package__, "job.toml.jinja", job=job, heading=heading, mm=mm, deg=deg, pose=pose_text,
        mms=lambda lengths: ", ".join(map(mm, lengths)),
    )  # fmt: skip


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


def _plain(value: float) -> str:
    """No more digits than were meant: what arithmetic added in the last place is not."""
    return f"{round(value, 6):.10g}".replace("-0", "0") if round(value, 6) == 0 else f"{round(value, 6):.10g}"


PROGRESS_S = 3.0

T = TypeVar("T")
P = TypeVar("P", bound=Pose)


@dataclass(eq=False)
class Asker:
    """Asks the questions. `given` are the options by name, None for those that were not given; `ask` puts a question
    with its default to a person, None where nobody is there; `notify` says something to that person.

    `used` collects what was answered, as options that would answer the same.
    """

    given: Mapping[str, str | None]
    ask: Callable[[str, str | None], str] | None
    notify: Callable[[str], None]
    used: dict[str, str] = field(default_factory=dict)
    _told: float = -math.inf

    def progress(self, text: str) -> None:
        """Tell how far something is, unless that was told less than `PROGRESS_S` ago."""
        if time.monotonic() >= self._told + PROGRESS_S:
            self._told = time.monotonic()
            self.notify(f"  {text} …")

    def get(self, option: str, question: str, default: str | None, parse: Callable[[str], T]) -> T:
        """The answer to a question, by `parse`, which raises `ValueError` or `ConfigError` for a wrong one. Raises
        `ConfigError` for a wrong option, and for a question without default that nobody answers."""
        text = self.given.get(option)
        if text is None and self.ask is None:
            if default is None:
                raise ConfigError(f"{question}? Nobody is asked with --yes, and there is no default: give --{option}")
            text = default
        while True:
            answer = text
            if answer is None:
                assert self.ask is not None
                answer = self.ask(question, default)
            try:
                found = parse(answer)
            except (ValueError, ConfigError) as error:
                if text is not None:
                    raise ConfigError(f"--{option}: {error}") from error
                self.notify(str(error))
                continue
            if answer != default:
                self.used[option] = answer
            return found


def checked(record: type[BaseModel], key: str) -> Callable[[str], Any]:
    """Parses a value by the rule of the key of a job's section."""
    adapter = _rule(record, key)
    return lambda text: _by(adapter, text.strip())


def three(record: type[BaseModel], key: str) -> Callable[[str], object]:
    """Parses three values, such as "70 mm, 36 mm, 20 mm", by the rule of the key."""
    adapter = _rule(record, key)

    def parse(text: str) -> object:
        parts = [part.strip() for part in text.split(",")]
        if len(parts) != 3:
            raise ValueError(f'{shown(text)} has {len(parts)} values; write three, such as "70 mm, 36 mm, 20 mm"')
        return _by(adapter, parts)

    return parse


def pose(kind: type[P]) -> Callable[[str], P]:
    """Parses "x, y, z" or "x, y, z; roll, pitch, yaw", each with its unit."""

    def parse(text: str) -> P:
        halves = [[part.strip() for part in half.split(",")] for half in text.split(";")]
        if len(halves) > 2 or any(len(half) != 3 for half in halves):
            raise ValueError(
                f'{shown(text)} is no pose; write three lengths, and three angles if it is turned, such as "0 mm, '
                '0 mm, 5 mm; 0 deg, 0 deg, 90 deg"'
            )
        turn = halves[1] if len(halves) == 2 else ["0 deg"] * 3
        made: P = _by(TypeAdapter(kind), {"translation": halves[0], "rotation": turn})
        return made

    return parse


def pose_words(where: Pose | Mounting) -> str:
    """A pose as `pose` reads it."""
    there, turn = (", ".join(map(write, each)) for write, each in ((mm, where.translation), (deg, where.rotation)))
    return f"{there}; {turn}".replace('"', "")


def choice(*words: str) -> Callable[[str], str]:
    """Parses one of these words."""

    def parse(text: str) -> str:
        if text.strip() not in words:
            raise ValueError(f"{shown(text)} is none of {', '.join(words)}; write one of them")
        return text.strip()

    return parse


def _rule(record: type[BaseModel], key: str) -> TypeAdapter[Any]:
    rule: Any = record.model_fields[key]
    kind: Any = Annotated[rule.annotation, *rule.metadata] if rule.metadata else rule.annotation
    return TypeAdapter(kind)


def _by(adapter: TypeAdapter[Any], value: object) -> Any:
    try:
        return adapter.validate_python(value)
    except ValidationError as error:
        raise ValueError("; ".join(dict.fromkeys(wording(problem) for problem in error.errors()))) from error


LISTED = 9
PART_HEIGHT = 0.02
"""How thick a part is taken to be whose size nobody gave, m."""
WIDEST_PART = (0.1, 0.07)
"""How long and wide such a part is at most, m: wider ones come near the deck while the cell is
calibrated, or hide the board from the camera."""
FINGERS_FREE = 0.010
"""How far the surface may rise above the part's origin, m: the fingers hold the part a little above it."""
ON_TABLE = 0.05
"""A mesh whose lowest point is no more than this above its own z = 0, m, is drawn with the table's top there."""


def laid_mesh(asker: Asker, drawn: Drawn) -> tuple[Laid, str]:
    """The mesh in the surface frame, and in words what was answered of unit, bodies and side."""
    bodies = _bodies(asker, drawn)
    longest = float(np.ptp(np.concatenate([body.vertices for body in bodies]), axis=0).max())
    unit, why = _unit(asker, drawn, longest)
    asker.notify(f"unit: {why}")
    up = asker.get("up", "Which axis of the mesh points up", "z", choice(*UP))
    turn = asker.get("turn", "Turn about it, or auto: the longer side along the sweep", "auto", _turn)
    laid = lay(bodies, unit, up, turn)
    lowest = METRES[unit] * min(float(body.vertices[:, 2].min()) for body in bodies)
    if up == "z" and 1e-6 < lowest <= ON_TABLE:
        laid = replace(raised(laid, lowest), foot=0.0)
        asker.notify(
            f"height: the mesh's own z = 0 is taken as the table's top, its lowest point is {1e3 * lowest:.4g} mm above"
        )
    if faces_down(laid):
        words = "More of the mesh faces down than up: turn its triangles round (yes), or else turn it over with --up"
        if asker.get("flip", words, None, choice("yes", "no")) == "yes":
            laid = replace(laid, faces=laid.faces[:, ::-1].copy())
            asker.notify("triangles: all turned round")
    return centred(laid), unit


def _bodies(asker: Asker, drawn: Drawn) -> list[MeshBody]:
    for note in drawn.notes:
        asker.notify(f"mesh: {note}")
    if len(drawn.bodies) == 1:
        return list(drawn.bodies)
    asker.notify(f"mesh: {len(drawn.bodies)} bodies that share no corner, in the file's unit:")
    for k, body in enumerate(drawn.bodies[:LISTED]):
        sides = " x ".join(f"{side:.4g}" for side in body.size)
        asker.notify(f"  {k + 1}: {sides}, {len(body.triangles)} triangles, {'closed' if body.closed else 'open'}")
    for one, other in overlapping(drawn.bodies[:LISTED]):
        asker.notify(
            f"  {one + 1} and {other + 1} overlap: what lies inside is no surface, and what lies double counts once"
        )

    def parse(text: str) -> list[MeshBody]:
        if text.strip() == "all":
            return list(drawn.bodies)
        try:
            return [drawn.bodies[range(1, len(drawn.bodies) + 1).index(int(word))] for word in text.split(",")]
        except ValueError as error:
            raise ValueError(
                f'{shown(text)}: write "all" or numbers from 1 to {len(drawn.bodies)}, such as 1,2'
            ) from error

    return asker.get("bodies", "Which of them are the surface", "all", parse)


def _unit(asker: Asker, drawn: Drawn, longest: float) -> tuple[str, str]:
    if drawn.unit is not None:
        return drawn.unit, f"stated in the file; the longest side is {1e3 * METRES[drawn.unit] * longest:.4g} mm"
    try:
        default, why = told_by_size(longest)
    except ConfigError:
        if asker.ask is None and asker.given.get("unit") is None:
            raise
        default, why = "", ""
    possible = ", ".join(possible_units(longest)) or "none of them a size that can be swept"
    question = f"Unit of the mesh, whose longest side is {longest:.4g} ({size_words(longest)}; likely: {possible})"
    unit = asker.get("unit", question, default or None, choice(*METRES))
    words = f"{unit}: the longest side is {1e3 * METRES[unit] * longest:.4g} mm"
    return unit, why if unit == default and asker.given.get("unit") is None else words


def _turn(text: str) -> float | None:
    return None if text.strip() == "auto" else parse_quantity(text, "deg", -360, 360)


def station(asker: Asker, like: Job, name: str, mesh: str, laid: Laid) -> Job:
    """The job at its board and place, with its part, but with the scan of `like`."""
    box = open_side(laid).box
    spec = asker.get("board", "The board beside the place", like.board.spec, checked(BoardSection, "spec"))
    where = asker.get(
        "board-place", "Where the board is, in the place frame", pose_words(_same_centre(like, spec)), pose(Pose)
    )
    stands = asker.get(
        "place", "Where the middle of the mesh stands on the table, in the place frame", "0 mm, 0 mm, 0 mm", pose(Pose)
    )
    on_place = pose_record(stands.se3() * from_parts((0.0, 0.0, laid.foot)))
    prior = asker.get("prior", "How exactly the board tells where the surface is, 1 sigma",
                      _bare(mm(like.surface.prior_sigma)), checked(SurfaceSection, "prior_sigma"))  # fmt: skip
    angle = _bare(deg(like.surface.prior_sigma_angle))
    prior_angle = asker.get(
        "prior-angle", "And how it is turned, 1 sigma", angle, checked(SurfaceSection, "prior_sigma_angle")
    )
    grasp = _grasp(asker, like, box)
    seat = asker.get("part-place", "Where the part's origin is when it is placed, in the surface frame",
                     pose_words(_seat(box, laid.foot)), pose(Pose))  # fmt: skip
    tolerance = asker.get("tolerance", "How exactly it has to be placed", _bare(mm(like.place.tolerance)),
                          checked(PlaceSection, "tolerance"))  # fmt: skip
    tolerance_angle = asker.get("tolerance-angle", "And turned", f"{1e3 * like.place.tolerance_angle:g} mrad",
                                checked(PlaceSection, "tolerance_angle"))  # fmt: skip
    return like.model_copy(
        update={
            "job": JobSection(name=name, kind=like.job.kind),
            "board": BoardSection.model_construct(spec=spec, place_from_board=where),
            "surface": like.surface.model_copy(
                update={"mesh": mesh, "mesh_unit": "mm", "place_from_surface": on_place, "prior_sigma": prior,
                        "prior_sigma_angle": prior_angle}
            ),
            "grasp": grasp,
            "place": like.place.model_copy(
                update={"surface_from_part": seat, "tolerance": tolerance, "tolerance_angle": tolerance_angle}
            ),
        }
    )  # fmt: skip


def _grasp(asker: Asker, like: Job, box: tuple[np.ndarray, np.ndarray]) -> GraspSection:
    sides = [min(float(side), widest) for side, widest in zip(np.ptp(box, axis=0)[:2], WIDEST_PART, strict=True)]
    default = ", ".join(_bare(mm(round(max(side, 0.001), 3))) for side in (*sides, PART_HEIGHT))
    size = asker.get("part-size", "The part's length, width and height", default, three(GraspSection, "size"))
    held = asker.get("grasp", "Where the claw holds it: the part's origin in the flange's frame",
                     pose_words(like.grasp.flange_from_part), pose(Mounting))  # fmt: skip
    sigma = asker.get(
        "grasp-sigma", "How exactly, 1 sigma", _bare(mm(like.grasp.sigma)), checked(GraspSection, "sigma")
    )
    sigma_angle = asker.get("grasp-sigma-angle", "And how exactly turned, 1 sigma",
                            f"{1e3 * like.grasp.sigma_angle:g} mrad", checked(GraspSection, "sigma_angle"))  # fmt: skip
    return GraspSection.model_construct(flange_from_part=held, size=size, sigma=sigma, sigma_angle=sigma_angle)


def _seat(box: tuple[np.ndarray, np.ndarray], foot: float) -> Pose:
    """The part's origin as low as the surface's highest point lets the claw's fingers be, but on the table."""
    height = max(-foot, math.ceil(1e3 * (float(box[1][2]) - FINGERS_FREE)) / 1e3)
    return Pose.model_construct(translation=(0.0, 0.0, height), rotation=(0.0, 0.0, 0.0))


def _same_centre(like: Job, spec: str) -> Pose:
    """The template's place of the board; for another board the one that keeps the middle where it was."""
    if spec == like.board.spec:
        return like.board.place_from_board
    moved = from_parts(centre_of(parse_board(like.board.spec)) - centre_of(parse_board(spec)))
    where: pin.SE3 = like.place_from_board * moved
    return pose_record(where)


def job_name(asker: Asker, mesh: Path) -> str:
    """The new job's name, which is that of its files."""
    default = "".join(c if c.isalnum() or c in "-_" else "-" for c in mesh.stem).strip("-") or "part"
    return asker.get("name", "Name of the job and its files", default, checked_name)


def _bare(quoted: str) -> str:
    return quoted.strip('"')
