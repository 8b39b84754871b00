"""Scheduled faults of a simulated cell: `arm.protective_stop@laser_sweep:40%` happens when that step is 40 % done."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from cell.devices.simulated.process import Simulation
from drivers.errors import ConfigError
from sim_backends.faults import FAULT_NAMES
from statemachine.runner import Event

_FORM = re.compile(r"(?P<fault>[a-z_.]+)@(?P<step>[a-z_]+)(:(?P<percent>\d+(\.\d+)?)\s*%)?")


@dataclass(frozen=True)
class Injection:
    """A fault by name, and the step and the fraction (0 to 1) of it at which it happens."""

    fault: str
    step: str
    fraction: float

    @classmethod
    def parse(cls, text: str, steps: Sequence[str]) -> Injection:
        """From `fault@step:percent%`, or `fault@step` for its start; `ConfigError` lists what is known.

        `steps` are the names of the job's steps.
        """
        match = _FORM.fullmatch(text.strip())
        if match is None:
            raise ConfigError(f'"{text}" is no scheduled fault: write it as "arm.protective_stop@laser_sweep:40%"')
        fault, step, percent = match["fault"], match["step"], float(match["percent"] or 0.0)
        if fault not in FAULT_NAMES:
            raise ConfigError(f'"{text}": the simulated cell has no fault "{fault}"; known: {", ".join(FAULT_NAMES)}')
        if step not in steps:
            raise ConfigError(f'"{text}": there is no step "{step}"; the steps are {", ".join(steps)}')
        if percent > 100.0:
            raise ConfigError(f'"{text}": {percent:g} % is outside 0 % to 100 %')
        return cls(fault, step, percent / 100.0)

    def __str__(self) -> str:
        return f"{self.fault}@{self.step}:{100 * self.fraction:g}%"


class Injector:
    """An observer of a run that causes each fault once, by `cause(name)`.

    `missed` has what was scheduled and did not happen: not reached, or not to be caused, and why.
    """

    def __init__(self, cause: Callable[[str], None], injections: Sequence[Injection]) -> None:
        self.injections = tuple(injections)
        self._cause = cause
        self._waiting = list(injections)
        self._failed: dict[Injection, str] = {}

    @classmethod
    def scheduled(cls, texts: Sequence[str], steps: Sequence[str], simulated: Simulation | None) -> Injector:
        """For texts that `Injection.parse` takes; `ConfigError` also for a fault that this cell cannot have."""
        injections = [Injection.parse(text, steps) for text in texts]
        if simulated is None:
            raise ConfigError(f"{', '.join(map(str, injections))} can only happen to a simulated cell")
        for injection in injections:
            simulated.require_fault(injection.fault)
        return cls(simulated.fault, injections)

    def __call__(self, event: Event) -> None:
        """Take an event of the runner."""
        match event.kind:
            case "step_started":
                fraction = 0.0
            case "progress":
                fraction = float(str(event.data["fraction"]))
            case "step_done":
                fraction = 1.0
            case _:
                return
        for injection in list(self._waiting):
            if injection.step == event.step and fraction >= injection.fraction:
                self._waiting.remove(injection)
                try:
                    self._cause(injection.fault)
                # The others are still to happen, and the report tells of this one.
                except Exception as error:
                    self._failed[injection] = f"could not be caused: {error}"

    @property
    def missed(self) -> dict[str, str]:
        """Why each fault that did not happen did not."""
        early = {str(injection): "the run did not come that far" for injection in self._waiting}
        return early | {str(injection): why for injection, why in self._failed.items()}
