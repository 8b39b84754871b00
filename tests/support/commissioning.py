"""A commissioning of a simulated cell that is not as its configuration says.

The world is built from one configuration, the product works with another: it knows the truth from its devices alone.
"""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from cell.apps.commission.check import CommissionCheck, Result, write_protocol
from cell.apps.commission.sequence import CHECKS, Commissioning, begin, chosen
from cell.apps.commission.workplace import Person, SimulatedPerson
from cell.config.cell_config import default_toml

SEED = 3


def same(text: str) -> str:
    """The configuration as it is."""
    return text


class Shown:
    """What was shown of each check, in order."""

    def __init__(self) -> None:
        self.rows: list[tuple[str, str, Result | None]] = []

    def __call__(self, check: CommissionCheck, verdict: str, result: Result | None) -> None:
        self.rows.append((check.name, verdict, result))

    @property
    def found(self) -> list[str]:
        return [str(finding) for _, _, result in self.rows if result is not None for finding in result.findings]


def files(folder: Path, truth: Callable[[str], str] = same, cell: Callable[[str], str] = same) -> None:
    """Configurations of the world and of the product, each the one that ships, changed."""
    text = default_toml()
    (folder / "true.toml").write_text(truth(text), encoding="utf-8")
    (folder / "cell.toml").write_text(cell(text), encoding="utf-8")


def opened(folder: Path, shown: Shown, ask: Callable[[str], bool] | None = None, job: str = "pot") -> Commissioning:
    person = SimulatedPerson(lambda text: None) if ask is None else Person(ask)
    return begin(
        folder / "cell.toml", person, shown, job=job, sim="all", seed=SEED, clock="virtual", truth=folder / "true.toml"
    )


def commissioned(folder: Path, until: str, ask: Callable[[str], bool] | None = None) -> tuple[bool, Shown]:
    shown = Shown()
    made = opened(folder, shown, ask)
    with closing(made.workplace):
        good = made.go(chosen((), until))
        write_protocol(made.progress, CHECKS, made.workplace.config)
    return good, shown


def replaced(old: str, new: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new)

    return change
