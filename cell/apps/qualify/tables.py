"""The answer of a campaign as tables of text, for the screen and for the page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from cell.apps.qualify.answer import BAD, JobAnswer, WorstWorld
from cell.apps.qualify.compare import PairedComparison
from cell.apps.qualify.intervals import Share
from cell.run.batch import GOOD

MOST_WORLDS, MOST_CHANGED = 20, 30
"""Rows of the tables of the worst worlds and of the changed ones; the JSON has all."""


class TextTable(NamedTuple):
    """A table for people; columns whose name begins with `>` are numbers."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]


def tables_of(answer: JobAnswer) -> Iterator[TextTable]:
    """All that the answer says, the most asked for first; what there is nothing of is left out."""
    names = {"placed": "placed", "corrected": "  of which corrected", **{name: name for name in BAD}}
    shares = [
        (names[name], *_share(share))
        for name, share in answer.shares.items()
    ]  # fmt: skip
    shares.append(("placed outside the tolerance, unnoticed", *_share(answer.unnoticed)))
    if answer.covered is not None:
        shares.append(("true place within the stated 95 % bound", *_share(answer.covered)))
    title = f"how {answer.worlds} worlds of {answer.level} ended"
    yield TextTable(title, ("outcome", ">worlds", ">share", ">95 % interval"), shares)
    yield _figures(answer)
    if answer.cycle is not None:
        times = [(step.name, f"{step.mean_s:.2f} s", f"{100 * step.share:.0f} %") for step in answer.steps]
        title = f"cycle time: mean {answer.cycle.mean_s:.1f} s, 95 % below {answer.cycle.p95_s:.1f} s"
        yield TextTable(title, ("step", ">mean", ">share"), times)
    if answer.reasons:
        reasons = [(str(why.count), why.outcome, why.step, why.reason, str(why.seed)) for why in answer.reasons]
        yield TextTable("why worlds did not place", (">worlds", "outcome", "step", "reason", ">first seed"), reasons)
    shown = answer.worst[:MOST_WORLDS]
    more = f", {len(shown)} of {len(answer.worst)}" if len(shown) < len(answer.worst) else ""
    yield TextTable(f"the worst worlds{more}", (">seed", "outcome", "why"), [_world(world) for world in shown])


def comparison_tables(compared: PairedComparison) -> Iterator[TextTable]:
    """The comparison with another campaign; differences are this one less the other."""
    difference, low, high = compared.yields
    rows = [("yield", f"{100 * difference:+.1f} %", f"[{100 * low:+.1f}, {100 * high:+.1f}]", str(compared.pairs))]
    for figure in compared.figures:
        ends = "" if figure.low is None or figure.high is None else f"[{figure.low:+.3g}, {figure.high:+.3g}]"
        rows.append((figure.name, f"{figure.mean:+.3g} {figure.unit}".strip(), ends, str(figure.n)))
    code = compared.other["code_hash"]
    title = f"less the campaign of code {code}, on the same {compared.pairs} seeds"
    yield TextTable(title, ("figure", ">mean difference", ">95 % interval", ">worlds"), rows)
    if compared.changed:
        changed = [(str(one.seed), one.before, one.now, one.reason) for one in compared.changed[:MOST_CHANGED]]
        title = f"seeds whose outcome changed: {len(compared.changed)}"
        yield TextTable(title, (">seed", "before", "now", "reason"), changed)


def _figures(answer: JobAnswer) -> TextTable:
    rows = []
    for figure in answer.figures:
        numbers = (figure.mean, figure.sd, figure.p95, figure.worst)
        told = "" if figure.cpk is None else f"{figure.cpk:.2f}"
        limit = ("≤ " if figure.bound == "at most" else "≥ ") + _digits(figure.limit)
        rows.append((figure.name, *map(_digits, numbers), limit, figure.unit, told, str(figure.n)))
    return TextTable(
        "figures beside their limits, the lowest Cpk first",
        ("figure", ">mean", ">σ", ">95 %", ">worst", ">limit", "unit", ">Cpk", ">worlds"), rows,
    )  # fmt: skip


def _digits(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def _world(world: WorstWorld) -> tuple[str, str, str]:
    near = f"{world.figure}: {100 * (world.used or 0.0):.0f} % of its limit" if world.figure else ""
    return str(world.seed), world.outcome, near if world.outcome in GOOD else world.reason


def _share(share: Share) -> tuple[str, str, str]:
    return f"{share.count:.4g}", f"{100 * share.share:.1f} %", f"[{100 * share.low:.1f}, {100 * share.high:.1f}] %"
