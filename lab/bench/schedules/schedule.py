"""A schedule: which job in which world, and what happens to it when. It is data, drawn from a seed by one function."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Self

import numpy as np

from sim_backends.direct.cell import NAMES as FAULTS

KILL, POWER_CUT = "kill", "power_cut"
WORLD_ACTS = ("vehicle_bumped", "surface_moved", "part_taken")
PERSON_ACTS = ("pause", "abort", "late_word")
"""What people ask of the run; `late_word` is a confirmation, which comes when it is asked for."""
COMPUTER_ACTS = (KILL, POWER_CUT, "full_disk", "clock_step")
ACTS = (*PERSON_ACTS, *WORLD_ACTS, *COMPUTER_ACTS)
MEANWHILE = ("", *WORLD_ACTS, "arm.protective_stop", "arm.emergency_stop", "vehicle.emergency_stop")
"""What may happen while a run is held, or waits for a person."""

CLAW = "claw"
"""The time in which the claw opens or closes on a part, from its note in the journal on; an instant like a step."""
LASTS_S = {
    "": 90.0, CLAW: 0.5, "drive_to_target": 15.0, "board_photo": 1.3, "laser_sweep": 14.0, "reconstruct": 0.1,
    "invert_pose": 0.1, "place": 18.0, "verify": 15.0, "pick": 12.0, "pick_nest": 20.0, "set_down": 12.0,
    "verify_nest": 15.0,
}  # fmt: skip
"""About how long each step lasts, s of the cell; "" is the whole run."""
AMOUNTS: dict[str, Callable[[np.random.Generator], float]] = {
    "pause": lambda rng: rng.uniform(0.1, 60.0),
    "late_word": lambda rng: rng.uniform(0.0, 120.0),
    "vehicle_bumped": lambda rng: rng.choice([-1, 1]) * 10 ** rng.uniform(-1.0, 1.7),
    "surface_moved": lambda rng: rng.choice([-1, 1]) * 10 ** rng.uniform(-1.0, 1.3),
    "power_cut": lambda rng: rng.uniform(0.0, 1.0),
    "clock_step": lambda rng: rng.choice([-1, 1]) * 10 ** rng.uniform(0.0, 4.9),
}
"""How the amount of each act is drawn that has one: s, mm for what is moved, the share of a file that is lost."""


@dataclass(frozen=True)
class Entry:
    """`act` happens when so much (`share`) of what step `step` usually lasts has passed since it began; "" is the run.
    `amount` is its size, see `AMOUNTS`; `meanwhile` happens while it holds the run."""

    act: str
    step: str = ""
    share: float = 0.0
    amount: float = 0.0
    meanwhile: str = ""

    @property
    def after_s(self) -> float:
        """Seconds of the cell since the step began."""
        return self.share * LASTS_S.get(self.step, 10.0)


@dataclass(frozen=True)
class Schedule:
    """One day of one cell."""

    job: str
    seed: int
    level: str = "nominal"
    entries: tuple[Entry, ...] = ()

    def as_json(self) -> str:
        """One line; what has its default is left out."""
        plain = asdict(self)
        plain["entries"] = [{key: value for key, value in entry.items() if value} for entry in plain["entries"]]
        return json.dumps(plain)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """From such a line; ValueError for one that is none."""
        try:
            plain = json.loads(text)
            entries = tuple(Entry(**entry) for entry in plain.pop("entries", ()))
            made = cls(**plain, entries=entries)
        except (TypeError, AttributeError, KeyError) as error:
            raise ValueError(f"this is no schedule: {error}") from error
        for entry in entries:
            if entry.act not in (*FAULTS, *ACTS) or entry.meanwhile not in MEANWHILE:
                raise ValueError(f"{entry.act!r} or {entry.meanwhile!r} is no act: {', '.join((*FAULTS, *ACTS))}")
        return made

    def without(self, number: int) -> Self:
        """This one less an entry."""
        return replace(self, entries=self.entries[:number] + self.entries[number + 1 :])


def draw(
    seed: int, jobs: Sequence[tuple[str, tuple[str, ...]]], levels: Sequence[str], seeds: Sequence[int],
    wanted: Callable[[str, str], float] = lambda step, act: 1.0,
) -> Schedule:  # fmt: skip
    """The schedule of `seed`, of the `jobs` (each with the names of its steps), `levels` and `seeds` of worlds.
    `wanted(step, act)` weighs what may happen where."""
    rng = np.random.default_rng([seed, 26])
    job, steps = jobs[int(rng.integers(len(jobs)))]
    level, world = str(rng.choice(list(levels))), int(rng.choice(list(seeds)))
    places = [(step, act) for step in ("", CLAW, *steps) for act in (*FAULTS, *ACTS)]
    weights = np.array([wanted(*place) for place in places])
    count = min(int(rng.integers(1, 5)), len(places))
    chosen = rng.choice(len(places), size=count, replace=False, p=weights / weights.sum())
    entries = tuple(_entry(rng, *places[int(number)]) for number in chosen)
    return Schedule(job, world, level, entries)


def _entry(rng: np.random.Generator, step: str, act: str) -> Entry:
    amount = AMOUNTS[act](rng) if act in AMOUNTS else 0.0
    meanwhile = str(rng.choice(list(MEANWHILE))) if act in ("pause", "late_word") and rng.random() < 0.7 else ""
    return Entry(act, step, round(float(rng.uniform(0.0, 1.0)), 3), round(float(amount), 3), meanwhile)
