"""Two campaigns on the same seeds, world by world: the difference in yield and in each figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from cell.apps.qualify.answer import limited
from cell.apps.qualify.campaign import Campaign
from cell.apps.qualify.intervals import mean_difference, share_difference
from cell.apps.qualify.rows import ROWS, Row, RowStore, number, shown
from cell.run.batch import GOOD
from drivers.errors import ConfigError

IDENTITY = ("job_hash", "configuration_hash", "code_hash")
ALWAYS = ("cycle_s", "true_error_max_mm", "stated_bound_mm")
"""Columns that are compared beside the figures."""


@dataclass(frozen=True)
class FigureDifference:
    """This campaign less the other: the mean of the paired differences, its 95 % interval, and of how many worlds."""

    name: str
    unit: str
    mean: float
    low: float | None
    high: float | None
    n: int


@dataclass(frozen=True)
class ChangedWorld:
    """A seed whose outcome changed, and why it is as it is now."""

    seed: int
    before: str
    now: str
    reason: str


@dataclass(frozen=True)
class PairedComparison:
    """`pairs` worlds of both campaigns; `other` names what differs there. `yields` is the difference in yield with the
    ends of its interval, as shares; differences are this campaign less the other."""

    other: Mapping[str, str]
    pairs: int
    yields: tuple[float, float, float]
    figures: Sequence[FigureDifference]
    changed: Sequence[ChangedWorld]

    def as_dict(self) -> dict[str, object]:
        """JSON-ready."""
        return asdict(self)


def other_rows(campaign: Campaign, folder: Path) -> list[Row]:
    """The rows in `folder` to compare with: of the same job and level, from the version that ran last.

    In the campaign's own folder that is another code, job or configuration. `ConfigError` where there is none.
    """
    if not (folder / ROWS).is_dir():
        raise ConfigError(f"--compare {folder}: it holds no campaign (there is no {folder / ROWS}); name its --out")
    rows = RowStore(folder).rows(job=campaign.of.job, level=campaign.level)
    if folder.resolve() == campaign.folder.resolve():
        own = campaign.wanted
        rows = [row for row in rows if any(row[name] != own[name] for name in IDENTITY)]
    if not rows:
        raise ConfigError(
            f"--compare {folder}: it holds no other worlds of job {campaign.of.job} at level {campaign.level}; run "
            "`cell qualify` with the other version first"
        )
    newest = max(rows, key=lambda row: number(row.get("ended_s")))
    return [row for row in rows if all(row[name] == newest[name] for name in IDENTITY)]


def compare(rows: Sequence[Row], others: Sequence[Row]) -> PairedComparison:
    """Pair by seed. `ConfigError` where no seed is in both."""
    before = {row["seed"]: row for row in others}
    pairs = [(row, before[row["seed"]]) for row in rows if row["seed"] in before]
    if not pairs:
        raise ConfigError("the two campaigns have no seed in common; give the same --first-seed, then compare again")
    good = [(now["outcome"] in GOOD, was["outcome"] in GOOD) for now, was in pairs]
    changed = [
        ChangedWorld(int(number(now["seed"])), str(was["outcome"]), str(now["outcome"]), str(now["reason"]))
        for now, was in pairs if now["outcome"] != was["outcome"]
    ]  # fmt: skip
    other = pairs[0][1]
    return PairedComparison(
        {name: str(other[name]) for name in IDENTITY}, len(pairs),
        share_difference(good.count((True, False)), good.count((False, True)), len(pairs)),
        figures=_differences(pairs), changed=changed,
    )  # fmt: skip


def _differences(pairs: Sequence[tuple[Row, Row]]) -> list[FigureDifference]:
    found = []
    for name in dict.fromkeys((*ALWAYS, *limited([now for now, _ in pairs]))):
        both = [number(now[name]) - number(was[name]) for now, was in pairs if name in now and name in was]
        if both:
            mean, low, high = mean_difference(both)
            found.append(FigureDifference(*shown(name), mean, low, high, n=len(both)))
    return found
