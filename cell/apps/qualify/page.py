"""The answer of a campaign as tables of text for screen and page, and the page: one HTML file with its plots."""

from collections.abc import Iterator, Sequence
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cell.apps.qualify.answer import BAD, FigureSpread, JobAnswer, PairedComparison, WorstWorld, limited, values_of
from cell.apps.qualify.intervals import Share
from cell.apps.qualify.rows import Row, number, shown
from cell.base.storage import replacing
from cell.run.batch import GOOD
from cell.run.report.page import render

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


PAGE = "qualify.html"
MOST_HISTOGRAMS = 9
COLOURS = {
    "placed": "#4d8f4d", "corrected": "#8fbf6f", "refused": "#d0a000", "misplaced": "#c0392b", "faulted": "#c0392b",
    "aborted": "#888888", "error": "#7d3c98",
}  # fmt: skip
FAR = 6.0
"""A limit is drawn up to so many times the largest value."""
NARROWEST = 0.12
"""Share of a plot's width that all bars together take at least."""
VALUES, LIMIT, DPI = "#2c5f9e", "#c0392b", 110


class PagePlot(NamedTuple):
    """A plot as PNG, and what it shows."""

    title: str
    png: bytes


def write_page(folder: Path, answer: JobAnswer, rows: Sequence[Row], more: Sequence[TextTable] = ()) -> Path:
    """Write the page of an answer and the rows behind it, with `more` tables at its end; gives its file."""
    style = files("cell.run.report.page").joinpath("page.css").read_text(encoding="utf-8")
    tables = [*tables_of(answer), *more]
    plots = list(plots_of(answer, rows))
    good = answer.unnoticed.count == 0 and answer.yields.count == answer.yields.of
    text = render(
        __package__, "qualify.html.jinja", answer=answer, style=style, tables=tables, plots=plots, good=good,
        commands=list(dict.fromkeys(world.command for world in answer.worst[:MOST_WORLDS])),
    )  # fmt: skip
    with replacing(folder / PAGE) as file:
        file.write(text.encode("utf-8"))
    return folder / PAGE


def plots_of(answer: JobAnswer, rows: Sequence[Row]) -> Iterator[PagePlot]:
    """The yield with its intervals, the figures beside their limits, and the cycle times."""
    yield PagePlot("Outcomes, with the 95 % intervals of their shares", _png(_outcomes(answer)))
    if answer.figures:
        yield PagePlot("Figures beside their limits", _png(_histograms(answer, rows)))
    if times := [number(row.get("cycle_s")) for row in rows if row["outcome"] in GOOD]:
        yield PagePlot("Cycle time of good worlds", _png(_cycle_times(times)))


def _outcomes(answer: JobAnswer) -> Figure:
    names = list(answer.shares)
    figure = Figure(figsize=(8.6, 0.7 + 0.36 * len(names)), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    for k, name in enumerate(names):
        share = answer.shares[name]
        value, low, high = 100 * share.share, 100 * share.low, 100 * share.high
        axes.barh(k, value, 0.62, color=COLOURS.get(name, VALUES))
        axes.errorbar(value, k, xerr=[[value - low], [high - value]], color="black", capsize=3, linewidth=1)
        # Inside a long bar there is room before its end, beside a short one after it.
        inside = value > 60
        axes.text(
            low - 1.5 if inside else high + 1.5, k, str(share), va="center", ha="right" if inside else "left",
            color="white" if inside else "black", fontsize=9,
        )  # fmt: skip
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlim(0, 103)
    axes.set_xlabel(f"% of {answer.worlds} worlds")
    return _tidy(figure)


def _histograms(answer: JobAnswer, rows: Sequence[Row]) -> Figure:
    columns = limited(rows)
    by_name = {shown(name): name for name in columns}
    told = answer.figures[:MOST_HISTOGRAMS]
    across = 3
    down = -(-len(told) // across)
    figure = Figure(figsize=(8.6, 2.1 * down), dpi=DPI, layout="constrained")
    panels = np.atleast_1d(figure.subplots(down, across, squeeze=False)).ravel()
    for axes, spread in zip(panels, told, strict=False):
        name = by_name[spread.name, spread.unit]
        values, _, _ = values_of(rows, name, columns[name])
        _histogram(axes, values, spread)
    for axes in panels[len(told) :]:
        axes.set_axis_off()
    return _tidy(figure)


def _histogram(axes: Axes, values: np.ndarray[tuple[int], np.dtype[np.float64]], spread: FigureSpread) -> None:
    low, high = float(values.min()), float(values.max())
    limits = [-spread.limit, spread.limit] if spread.bound == "at most" and low < 0 else [spread.limit]
    # One far away would squeeze the values into one bar; it stands in the title.
    limits = [limit for limit in limits if abs(limit) <= FAR * max(abs(low), abs(high))]
    ends = [low, high, *limits, *([0.0] if low >= 0 and spread.bound == "at most" else [])]
    # Bars of values that are all but the same would be too narrow to see.
    pad = max(0.0, 0.5 * (NARROWEST * max(max(ends) - min(ends), 1e-6) - (high - low)))
    axes.hist(values, bins=min(30, max(8, len(values) // 8)), range=(low - pad, high + pad), color=VALUES)
    for limit in limits:
        axes.axvline(limit, color=LIMIT, linestyle="--", linewidth=1.2)
    if 0.0 in ends:
        axes.set_xlim(left=0)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    words = spread.name if len(spread.name) <= 38 else f"{spread.name[:37]}…"
    sign = "≤" if spread.bound == "at most" else "≥"
    told = "" if spread.cpk is None else f", Cpk {spread.cpk:.2f}"
    axes.set_title(f"{words}\n{sign} {spread.limit:.3g} {spread.unit}{told}", fontsize=8)
    axes.set_xlabel(spread.unit, fontsize=8)


def _cycle_times(times: Sequence[float]) -> Figure:
    figure = Figure(figsize=(8.6, 2.2), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    axes.hist(times, bins=min(40, max(8, len(times) // 5)), color=VALUES)
    p95 = float(np.percentile(times, 95))
    axes.axvline(float(np.mean(times)), color="black", linewidth=1.2, label=f"mean {np.mean(times):.1f} s")
    axes.axvline(p95, color=LIMIT, linestyle="--", linewidth=1.2, label=f"95 % below {p95:.1f} s")
    axes.legend(fontsize=8, frameon=False)
    axes.set_xlabel("s of the cell's clock")
    axes.set_ylabel("worlds")
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    return _tidy(figure)


def _tidy(figure: Figure) -> Figure:
    for axes in figure.axes:
        axes.tick_params(labelsize=8)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    return figure


def _png(figure: Figure) -> bytes:
    file = BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()
