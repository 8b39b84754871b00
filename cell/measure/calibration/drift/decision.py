"""How good is a stored calibration today? One decision from a view of each deck board and a sweep over the fine one.

Every part of the chain that may have changed is a hypothesis against none
(`cell.measure.calibration.drift.evidence`). Their mean Bayes factor is the statistic; what it exceeds by chance is
found by drawing scores from their own covariance, so that a good calibration is called disturbed in `FALSE_ALARMS` of
all checks. The most probable part is named. What a good verdict is worth is said by
`cell.measure.calibration.drift.detectability`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cell.measure.calibration.drift.detectability import Detectable, detectable
from cell.measure.calibration.drift.evidence import DriftEvidence, Hypothesis, hypotheses, log_factor, log_mean
from cell.measure.calibration.solve.normal import BOARD, PLANE, RAIL, SHARED, AdjustmentState
from cell.measure.calibration.solve.results import PARAMETERS
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import covariance_root

FALSE_ALARMS = 0.03
WORST_FIT = 1.6
"""Residuals larger than this many times the calibration's own have another cause than a moved part."""
DRAWS = 8_000
LEAST_PROBABILITY = 0.1
LENS = PARAMETERS[:9]


@dataclass(frozen=True, eq=False)
class Suspect:
    """A part that may have changed: how probable among the parts, and the most probable change (27,) of the chain.

    `spread` (27, k) is a root of the change's covariance.
    """

    chain: str
    part: str
    probability: float
    change: Array
    spread: Array

    def as_dict(self) -> dict[str, object]:
        """For reports, units in the names."""
        return {"part": self.part, "probability": round(self.probability, 3), "change": _named(self.change)}


@dataclass(frozen=True)
class Figure:
    """One compared quantity with one standard deviation of what a good calibration gives."""

    name: str
    value: float
    sigma: float
    unit: str

    def as_dict(self) -> dict[str, object]:
        """For reports."""
        return {"name": self.name, "value": round(self.value, 5), "sigma": round(self.sigma, 5), "unit": self.unit}


@dataclass(frozen=True, eq=False)
class DriftVerdict:
    """`statistic` is the logarithm of the mean Bayes factor for a change, `threshold` what chance reaches.

    `fit` holds RMS residuals over the calibration's own by kind; `suspects` come most probable first;
    `detectable` says how large a change of each part had to be to be found today.
    """

    statistic: float
    threshold: float
    fit: dict[str, float]
    suspects: list[Suspect]
    figures: list[Figure]
    detectable: list[Detectable]

    @property
    def badly_fitting(self) -> list[str]:
        """Kinds of measurement that fit no change of the calibrated parts."""
        return [kind for kind, value in self.fit.items() if value > WORST_FIT]

    @property
    def changed(self) -> bool:
        """True when a change of some part shows."""
        return self.statistic > self.threshold

    @property
    def good(self) -> bool:
        """True when nothing speaks for a change."""
        return not self.changed and not self.badly_fitting


def verdict(evidences: Mapping[str, DriftEvidence], states: Mapping[str, AdjustmentState]) -> DriftVerdict:
    """Decide, by chain ("scan", "target"), from the evidence and the calibrated states that it was weighed against."""
    tests = [(name, h) for name in evidences for h in hypotheses(name, states[name].camera.fx)]
    found = np.array([log_factor(evidences[name], h, evidences[name].score[None])[0] for name, h in tests])
    rng = np.random.default_rng(0)
    scores = {}
    for name, weighed in evidences.items():
        root = covariance_root(weighed.information)
        scores[name] = rng.normal(size=(DRAWS, root.shape[1])) @ root.T
    drawn = np.stack([log_factor(evidences[name], h, scores[name]) for name, h in tests], axis=1)
    threshold = float(np.quantile(log_mean(drawn), 1 - FALSE_ALARMS))
    fit = {}
    for name, weighed in evidences.items():
        fit[f"{name} dots"] = weighed.dots
        if np.isfinite(weighed.stripe):
            fit["stripe"] = weighed.stripe
    figures = [figure for name in evidences for figure in _figures(name, evidences[name], states[name])]
    seen = detectable(evidences, states, tests, scores=scores, factors=drawn, threshold=threshold)
    return DriftVerdict(
        float(log_mean(found[None])[0]), threshold, fit, _suspects(evidences, tests, found), figures, detectable=seen
    )


def _suspects(
    evidences: Mapping[str, DriftEvidence], tests: list[tuple[str, Hypothesis]], found: Array
) -> list[Suspect]:
    """Parts by probability, where each hypothesis is as probable as any other beforehand."""
    weight = np.exp(found - found.max())
    weight /= weight.sum()
    parts: dict[tuple[str, str], list[int]] = {}
    for k, (chain, h) in enumerate(tests):
        parts.setdefault((chain, h.part), []).append(k)
    made = []
    for (chain, part), members in parts.items():
        _, h = tests[max(members, key=lambda k: weight[k])]
        index, weighed = list(h.index), evidences[chain]
        change = np.zeros(SHARED)
        held = weighed.information[np.ix_(index, index)] + np.diag(1 / np.array(h.size) ** 2)
        change[index] = np.linalg.solve(held, weighed.score[index])
        spread = np.zeros((SHARED, len(index)))
        spread[index] = np.linalg.cholesky(np.linalg.inv(held))
        made.append(Suspect(chain, part, float(weight[members].sum()), change, spread))
    made.sort(key=lambda suspect: -suspect.probability)
    return [s for k, s in enumerate(made) if k == 0 or s.probability >= LEAST_PROBABILITY]


def _figures(name: str, weighed: DriftEvidence, state: AdjustmentState) -> list[Figure]:
    """The board against where the calibration found it, and for the scan head light plane and rail, each by itself."""
    board = np.eye(SHARED)[:, BOARD]
    moved, covariance = weighed.change(board)
    sigma = np.sqrt(np.diag(covariance))
    made = [
        Figure(f"{name} board, {axis} in the base", 1e3 * float(value), 1e3 * float(s), unit)
        for axis, unit, value, s in zip(
            ("x", "y", "z", "about x", "about y", "about z"), ("mm",) * 3 + ("mrad",) * 3, moved, sigma, strict=True
        )
    ]
    if state.plane is not None:
        quantities = (
            ("stripe against the photographed board", [PLANE.stop - 1], 1e3, "mm"),
            ("rail's scale", [RAIL.start], 1e3, "per mille"),
        )
        for text, index, factor, unit in quantities:
            change, spread = weighed.change(np.hstack([board, np.eye(SHARED)[:, index]]))
            made.append(Figure(text, factor * float(change[-1]), factor * float(np.sqrt(spread[-1, -1])), unit))
    return made


def _named(change: Array) -> dict[str, float]:
    """The parameters that change with their units: the lens' in px or none, m as mm, rad as mrad."""
    return {
        name.replace(" ", "_") + _unit(name): round(float(change[k]) * (1.0 if name in LENS else 1e3), 4)
        for k, name in enumerate(PARAMETERS)
        if change[k] != 0.0
    }


def _unit(name: str) -> str:
    if name in LENS:
        return "_px" if name[0] in "fc" else ""
    if name.startswith("rail"):
        return "_per_mille"
    return "_mrad" if "tilt" in name or name.split()[-1] in ("rx", "ry", "rz") else "_mm"
