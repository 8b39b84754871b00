"""Kinds of jobs: which steps a job consists of, in their order. A job chooses one with `job.kind`.

A step is one file with a `JobStep`; a kind is one line that lists steps. Kinds of other packages come by entry points
of the group `assembly_cell.kinds`, each a `Kind`.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import entry_points

from cell.config.job import Job
from cell.procedures.placed_part import PlacedPart
from cell.procedures.steps import (
    board_photo,
    drive_to_target,
    invert_pose,
    laser_sweep,
    pick,
    pick_nest,
    place,
    reconstruct,
    set_down,
    verify,
    verify_nest,
)
from cell.procedures.steps.workplace import JobStep, Workplace
from drivers.errors import ConfigError
from statemachine.runner import StepContext
from statemachine.sequence import JobState, Sequence
from statemachine.step import Policy

GROUP = "assembly_cell.kinds"


@dataclass(frozen=True)
class Kind:
    """A kind of job. Raises ValueError when two steps have one name, or one needs what no earlier one makes."""

    name: str
    steps: tuple[JobStep, ...]

    def __post_init__(self) -> None:
        self.sequence()
        made: set[type] = set()
        for step in self.steps:
            if missing := [need.__name__ for need in step.needs if not any(issubclass(m, need) for m in made)]:
                raise ValueError(f"step {step.name} needs {', '.join(missing)}, which no step before it makes")
            made.add(step.makes)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its steps, in their order."""
        return tuple(step.name for step in self.steps)

    @property
    def places(self) -> bool:
        """Whether one of its steps places a part, or sees one in its nest."""
        return any(issubclass(step.makes, place.PlaceResult | PlacedPart) for step in self.steps)

    @property
    def sees_place(self) -> bool:
        """Whether it looks at the part in its place on the surface, where a scan head that was bumped shows: a part
        and the nest that it is set into are both seen by such a head as it gripped."""
        return verify.STEP in self.steps

    def sequence(self) -> Sequence:
        """A sequence at its start; it ends placed only where a step places."""
        return Sequence(self.names, JobState.PLACED if self.places else JobState.DONE)

    def policy(self, *, simulated_person: bool = False) -> Policy:
        """How each step is watched."""
        return Policy(tuple(step.policy for step in self.steps), simulated_person=simulated_person)

    def work(self, workplace: Workplace) -> dict[str, Callable[[StepContext], object]]:
        """What the runner calls, by the steps' names; each attempt enters the gate anew."""
        return {step.name: partial(_enter, workplace, step) for step in self.steps}

    def require_steps(self, names: Iterable[str]) -> None:
        """`ConfigError` when one of these names is no step of this kind."""
        if unknown := [name for name in names if name not in self.names]:
            raise ConfigError(f"there is no step {', '.join(unknown)}; the steps are {', '.join(self.names)}")

    def until(self, name: str | None) -> "Kind":
        """This kind up to the step of that name; all of it without one. `ConfigError` when there is no such step."""
        if name is None:
            return self
        self.require_steps([name])
        return replace(self, steps=self.steps[: self.names.index(name) + 1])

    def with_step(self, step: JobStep, after: str, name: str) -> "Kind":
        """The kind `name`: this one with one more step, after the one of the name `after`."""
        at = self.names.index(after) + 1
        return replace(self, name=name, steps=(*self.steps[:at], step, *self.steps[at:]))


def _enter(workplace: Workplace, step: JobStep, context: StepContext) -> object:
    with workplace.devices.gate.entered(context.token):
        context.check()
        workplace.retried |= context.attempt > 1
        if (workplace.needs_part or workplace.held is not None) and step is not drive_to_target.STEP:
            note, when = partial(place.note_part, context), f"before the step {step.name}"
            place.require_in_claw(workplace.devices.claw, workplace.part, note, when)
        workplace.devices.interlocks.work_with(workplace.calibration.configuration)
        workplace.mover.hold = context.safe_point
        workplace.frames.begin()
        result = step.work(workplace, context)
    # What a later step finds by this type, and whether the job ends placed, rests on it.
    if not isinstance(result, step.makes):
        raise TypeError(f"step {step.name} made a {type(result).__name__}, not the {step.makes.__name__} it promises")
    return result


PLACE = Kind(
    "place", (drive_to_target.STEP, board_photo.STEP, laser_sweep.STEP, reconstruct.STEP, invert_pose.STEP, place.STEP)
)


LOAD = PLACE.with_step(pick_nest.STEP, after=drive_to_target.STEP.name, name="load")
"""Places a part that it takes from a nest on the vehicle."""
UNLOAD = Kind("unload", (*PLACE.steps[:-1], pick.STEP, set_down.STEP, verify_nest.STEP))
"""Takes a part from its surface: the sweep looks for the part itself, which is gripped and set into a nest."""
BUILT_IN = {kind.name: kind for kind in (PLACE, LOAD, UNLOAD)}
LOOKING = {kind.name: kind.with_step(verify.STEP, after=place.STEP.name, name=kind.name) for kind in (PLACE, LOAD)}
"""Kinds whose placed part is looked at, by their names."""


def kind_of(job: Job) -> Kind:
    """The kind of this job; raises what `find_kind` raises."""
    kind = find_kind(job.job.kind)
    looks = kind in (PLACE, LOAD) and job.part is not None and job.place.verify != "none"
    return LOOKING[kind.name] if looks else kind


def find_kind(name: str) -> Kind:
    """The kind of this name; `ConfigError` that lists what is installed, or says what is wrong with a foreign one."""
    if name in BUILT_IN:
        return BUILT_IN[name]
    found = {entry.name: entry for entry in entry_points(group=GROUP) if entry.name not in BUILT_IN}
    if name not in found:
        known = ", ".join(sorted((*BUILT_IN, *found)))
        raise ConfigError(f'job.kind "{name}": there is no such kind of job; installed: {known}')
    try:
        kind = found[name].load()
    # Also a module that ends the program when it is imported.
    except (Exception, SystemExit) as error:
        raise ConfigError(f'job.kind "{name}": {found[name].value} cannot be used: {error}') from error
    if not isinstance(kind, Kind):
        raise ConfigError(f'job.kind "{name}": {found[name].value} is a {type(kind).__name__}, no kind of job')
    return kind
