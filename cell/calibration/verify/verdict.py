"""The verdict on a stored calibration in words and numbers: what to do, what it does to the place, what it can see.

The decision itself is `cell.calibration.verify.decision`'s, the pictures are taken by `cell.calibration.verify.views`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cell.calibration.solve.place_effect import scan_effect, target_effect
from cell.calibration.solve.results import PARAMETERS
from cell.calibration.store import CellCalibration
from cell.calibration.verify.decision import FALSE_ALARMS, WORST_FIT, Suspect, Verdict
from cell.calibration.verify.detectability import DETECTED, Detectable
from cell.calibration.verify.hypotheses import SHIFT, TURN
from cell.calibration.verify.looks import CheckObservations, verify
from cell.geometry.poses import from_parts
from cell.job import Job
from cell.report.html import table
from cell.steps.camera_poses import centre_of
from cell.vision import parse_board


@dataclass(frozen=True, eq=False)
class Verification:
    """The verdict with its expected effect on the place: `effects` in m, in the order of `verdict.suspects`."""

    verdict: Verdict
    effects: list[float]
    date: str

    @classmethod
    def of(cls, calibration: CellCalibration, job: Job, seen: CheckObservations) -> Verification:
        """Compare what was seen with the calibration, and reckon the effect for a job."""
        verdict = verify(calibration.scan, calibration.target, seen)
        board = parse_board(job.board.spec)
        camera_from_board = from_parts((0.0, 0.0, job.photo.stand_off)) * from_parts(-centre_of(board))
        place = (camera_from_board * job.place_from_board.inverse()).translation

        def effect(suspect: Suspect) -> float:
            if suspect.chain == "target":
                return target_effect(calibration.target, suspect.change, place)
            # A sweep has the middle of the rail's travel in its middle; where that is, a direction's error is taken up.
            half = 0.5 * job.scan.length
            return scan_effect(calibration.scan, suspect.change, job.scan.stand_off, (-half, half))

        return cls(verdict, [effect(suspect) for suspect in verdict.suspects], calibration.date)

    def __str__(self) -> str:
        return self.reason

    def __repr__(self) -> str:
        return f"<Verification of the calibration of {self.date}: {'good' if self.good else 'not good any more'}>"

    def _repr_html_(self) -> str:
        odds = f"{self.verdict.statistic:.1f}, allowed {self.verdict.threshold:.1f}"
        suspects = ", ".join(f"{s.part} ({s.probability:.0%})" for s in self.verdict.suspects) or "none"
        rows = [("reason", self.reason), ("log odds of a change", odds)]
        title = f"verification: {'good' if self.good else 'not good any more'}"
        return table(title, rows if self.good else [*rows, ("suspected", suspects)])

    @property
    def good(self) -> bool:
        """True when nothing speaks for a change."""
        return self.verdict.good

    @property
    def good_within(self) -> tuple[float, float]:
        """The largest change in mm and in degrees that one part may have undergone unseen; infinite where any may."""
        sizes = {unit: [d.size for d in self.verdict.detectable if d.change.unit == unit] for unit in ("m", "rad")}
        return 1e3 * max(sizes["m"]), float(np.degrees(max(sizes["rad"])))

    @property
    def reason(self) -> str:
        """The decision in words, and the next step."""
        v = self.verdict
        if v.good:
            mm, degrees = self.good_within
            text = (
                f"the calibration of {self.date} is good within {mm:.2f} mm and {degrees:.3f}°: nothing speaks for a "
                f"change (log odds {v.statistic:.1f}, chance reaches {v.threshold:.1f} in {FALSE_ALARMS:.0%} of "
                f"checks), and a larger change of one part would have shown in {DETECTED:.0%} of checks"
            )
            hidden = [f"{d.change.part}, {d.change.kind} ({_size(d)})" for d in v.detectable if not d.enough]
            if not hidden:
                return text
            return (
                f"{text}; the scatter of arm and rail that the calibration found hides more than {1e3 * SHIFT:g} mm or "
                f"{np.degrees(TURN):g}° of: {'; '.join(hidden)}"
            )
        if v.statistic <= v.threshold:
            worst = "; ".join(f"{kind} {v.fit[kind]:.1f} times" for kind in v.badly_fitting)
            return (
                f"the observations fit worse than when the calibration of {self.date} was made, and no moved part "
                f"explains it: {worst} the residuals of then, allowed {WORST_FIT:g}; see whether the boards are clean "
                "and flat and the lenses in focus, then run `cell calibrate`"
            )
        named = " or ".join(
            f"the {s.part}{_DECK.get(s.part, '')} ({s.probability:.0%}, {1e3 * effect:.2f} mm)"
            for s, effect in zip(v.suspects, self.effects, strict=True)
        )
        return (
            f"the calibration of {self.date} is not good any more (log odds {v.statistic:.1f}, allowed "
            f"{v.threshold:.1f}): suspected is {named}, in brackets its probability and the place error to expect; "
            "fasten what is loose, then run `cell calibrate`"
        )

    def summary(self) -> dict[str, Any]:
        """For reports, units in the names."""
        v = self.verdict
        return {
            "good": v.good,
            "reason": self.reason,
            "calibration_date": self.date,
            "log_odds": round(v.statistic, 3),
            "log_odds_allowed": round(v.threshold, 3),
            "residuals_over_calibration": {kind: round(value, 3) for kind, value in v.fit.items()},
            "residuals_allowed": WORST_FIT,
            "suspects": [
                {
                    "part": s.part,
                    "probability": round(s.probability, 3),
                    "change": _named(s.change),
                    "place_error_mm": round(1e3 * effect, 4),
                }
                for s, effect in zip(v.suspects, self.effects, strict=True)
            ]
            if not v.good
            else [],
            "detectable_share": DETECTED,
            "detectable": [
                {
                    "part": d.change.part,
                    "change": d.change.kind,
                    "size": round(_shown(d.size, d.change.unit), 4) if np.isfinite(d.size) else None,
                    "wanted": round(_shown(d.change.wanted, d.change.unit), 4),
                    "unit": _UNITS[d.change.unit] + d.change.where,
                }
                for d in v.detectable
            ],
            "figures": [
                {"name": f.name, "value": round(f.value, 5), "sigma": round(f.sigma, 5), "unit": f.unit}
                for f in v.figures
            ],
        }


_DECK = {
    "scan camera's mount on the flange": ", or the fine board on the deck",
    "target camera's mount on the flange": ", or the large board on the deck",
}


_UNITS = {"m": "mm", "rad": "deg"}


def _shown(size: float, unit: str) -> float:
    """A size in m as mm, one in rad as degrees."""
    return 1e3 * size if unit == "m" else float(np.degrees(size))


def _size(d: Detectable) -> str:
    shown = f"{_shown(d.size, d.change.unit):.3f}"
    return f"up to {shown} mm{d.change.where}" if d.change.unit == "m" else f"up to {shown}°"


def _named(change: np.ndarray) -> dict[str, float]:
    """The parameters that change, px or relative as they are, m as mm and rad as mrad."""
    made = {}
    for k, name in enumerate(PARAMETERS):
        if change[k] == 0.0:
            continue
        plain = name[0] in "fck"
        unit = "" if plain else "_per_mille" if name.startswith("rail") else "_mrad" if _angle(name) else "_mm"
        made[name.replace(" ", "_") + (unit or "_px")] = round(float(change[k]) * (1.0 if plain else 1e3), 4)
    return made


def _angle(name: str) -> bool:
    return "tilt" in name or name.split()[-1] in ("rx", "ry", "rz")
