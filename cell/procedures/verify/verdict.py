"""The verdict on a stored calibration in words and numbers: what to do, what it does to the place, what it can see.

The decision itself is `cell.measure.calibration.drift.decision`'s, the pictures are taken by
`cell.procedures.verify.views`.

What a verification found out about the laser, kept with the calibration for the jobs that come after it.

A job has only the plate on the claw, which may have been knocked, and so has to state a turn of the laser as an
uncertainty. A verification has seen the stripe on a board. What it confirms is written into the stored calibration with
its date, what it contradicts is taken out of it. The calibration itself is not changed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cell.base.storage import table
from cell.config.calibrations.store import CellCalibration, save_calibration
from cell.config.job import Job
from cell.measure.calibration.drift.decision import (
    DETECTED,
    WORST_FIT,
    DriftVerdict,
    Suspect,
    scan_effect,
    target_effect,
)
from cell.measure.calibration.drift.reference_plate import ConfirmedTurn
from cell.measure.calibration.drift.slip import WitnessCheck
from cell.measure.geometry.camera import Array
from cell.measure.geometry.poses import from_parts
from cell.measure.vision import parse_board
from cell.measure.vision.board.view import centre_of
from cell.procedures.verify.views import CheckObservations, check_witness, verify

SHARE = 0.3
"""Of the place's tolerance: what moves the place by less is told and not called bad. A third, with room for an estimate
that falls a little short."""
SURE = 0.95
"""How sure a change's effect is below what is stated as the most."""
_DRAWS = 100


@dataclass(frozen=True, eq=False)
class Verification:
    """The verdict, and what it means at the place of a job, lengths in m.

    `effects` are what the suspects' changes do there, `at_most` what they do in `SURE` of cases, both in the order of
    `verdict.suspects`. `unseen` is what a change does that just fails to show, in the order of `verdict.detectable`.
    `witness` is what the board says to the laser's witness, None without one, and `misled` what a job is off by that
    believes the witness. A turn of the laser that both see is no change of the calibration, for jobs allow for it.
    """

    verdict: DriftVerdict
    effects: list[float]
    at_most: list[float]
    unseen: list[float]
    tolerance: float
    date: str
    witness: WitnessCheck | None = None
    misled: float = 0.0

    @classmethod
    def of(cls, calibration: CellCalibration, job: Job, seen: CheckObservations) -> Verification:
        """Compare what was seen with the calibration, and reckon the effect for a job."""
        scan, effect = calibration.scan, at_place(calibration, job)
        witness = check_witness(scan, seen)
        if witness is not None and witness.corrects:
            scan = scan.pointed(witness.plate, seen.exit_point)
        verdict = verify(scan, calibration.target, seen)

        def at_most(suspect: Suspect) -> float:
            drawn = np.random.default_rng(0).normal(size=(_DRAWS, suspect.spread.shape[1])) @ suspect.spread.T
            return float(np.quantile([effect(suspect.chain, suspect.change + step) for step in drawn], SURE))

        unseen = [effect(d.change.chain, d.step) if np.isfinite(d.size) else np.inf for d in verdict.detectable]
        return cls(
            verdict,
            [effect(suspect.chain, suspect.change) for suspect in verdict.suspects],
            [at_most(suspect) for suspect in verdict.suspects],
            unseen=unseen,
            tolerance=job.place.tolerance,
            date=calibration.date,
            witness=witness,
            misled=0.0 if witness is None else effect("scan", witness.wrong),
        )

    def __str__(self) -> str:
        return self.reason

    def __repr__(self) -> str:
        return f"<Verification of the calibration of {self.date}: {self.word}>"

    def _repr_html_(self) -> str:
        allowed = f"{1e3 * self.tolerance:.2f} mm"
        rows = [("reason", self.reason), ("allowed at the place", allowed)]
        suspects = ", ".join(f"{s.part} ({s.probability:.0%})" for s in self.verdict.suspects) or "none"
        return table(f"verification: {self.word}", [*rows, ("suspected", suspects)] if self.verdict.changed else rows)

    @property
    def hidden(self) -> float:
        """The most that a change of one part does at the place, m, when it just fails to show."""
        return max(self.unseen)

    @property
    def matters(self) -> bool:
        """Whether what changed may move the place by a `SHARE` of its tolerance or more."""
        return self.verdict.changed and max(self.at_most) >= SHARE * self.tolerance

    @property
    def good(self) -> bool:
        """True when nothing speaks for a change, or for one that does too little to the place to matter."""
        return not self.matters and not self.verdict.badly_fitting and not self.plate_moved

    @property
    def plate_moved(self) -> bool:
        """Whether the laser's witness, which jobs believe, was knocked."""
        return self.witness is not None and self.witness.plate_moved

    @property
    def word(self) -> str:
        """The verdict in a word or two."""
        if not self.good:
            return "not good any more"
        return "good, slightly changed" if self.verdict.changed else "good"

    @property
    def reason(self) -> str:
        """The decision in words, in mm at the place, and the next step."""
        if self.witness is None or not (self.plate_moved or self.witness.corrects):
            return self._decision
        if self.witness.corrects:
            by_board = self.good and self.witness.confirmation(0.0) is not None
            how = "by the board's figure, which is kept with the calibration" if by_board else "by the plate's"
            return f"{self._decision}. The laser has turned, {self.witness.words}: jobs allow for it {how}"
        return (
            "the plate on the claw that shows where the laser points (laser.witness) has moved, not the laser: "
            f"it has turned {self.witness.words}, and jobs that believe the plate put the place "
            f"{1e3 * self.misled:.2f} mm off. Fasten the plate, then run `cell calibrate`. Apart from it, "
            f"{self._decision}"
        )

    @property
    def _decision(self) -> str:
        v, allowed = self.verdict, f"{1e3 * self.tolerance:.2f} mm"
        if v.changed and (self.matters or not v.badly_fitting):
            named = " or ".join(
                f"the {s.part}{_DECK.get(s.part, '')} ({s.probability:.0%}): place off by {1e3 * effect:.2f} mm, at "
                f"most {1e3 * most:.2f} mm"
                for s, effect, most in zip(v.suspects, self.effects, self.at_most, strict=True)
            )
            if self.matters:
                return (
                    f"the calibration of {self.date} is not good any more. Changed has {named}; allowed at the place "
                    f"are {allowed}. Fasten what is loose, then run `cell calibrate`"
                )
            return (
                f"the calibration of {self.date} is good, though something seems to have changed a little: {named}; "
                f"allowed at the place are {allowed}. Nothing has to be done now; run `cell calibrate` when there is "
                "time"
            )
        if v.badly_fitting:
            worst = "; ".join(f"{kind} {v.fit[kind]:.1f} times" for kind in v.badly_fitting)
            return (
                f"the calibration of {self.date} is not good any more: the pictures fit worse than when it was made, "
                f"and no moved part explains it: {worst} the residuals of then, allowed {WORST_FIT:g}. See whether the "
                "boards are clean and flat and the lenses in focus, then run `cell calibrate`"
            )
        text = f"the calibration of {self.date} is good: nothing has changed that shows"
        if np.isfinite(self.hidden):
            text += (
                f", and what moves the place by more than {1e3 * self.hidden:.2f} mm would have shown in "
                f"{DETECTED:.0%} of checks like this one (allowed at the place are {allowed})"
            )
        hiding = [
            f"{d.change.part}, {d.change.kind} ({d.words}, {_way(effect)} at the place)"
            for d, effect in zip(v.detectable, self.unseen, strict=True)
            if effect >= SHARE * self.tolerance
        ]
        if not hiding:
            return f"{text}. Go on working"
        return f"{text}. Go on working, but know what could do that unseen: {'; '.join(hiding)}"

    def summary(self) -> dict[str, Any]:
        """For reports, units in the names."""
        v = self.verdict
        return {
            "good": self.good,
            "verdict": self.word,
            "reason": self.reason,
            "calibration_date": self.date,
            "place": {
                "allowed_mm": round(1e3 * self.tolerance, 4),
                "error_mm": round(1e3 * max(self.effects), 4) if v.changed else None,
                "error_at_most_mm": round(1e3 * max(self.at_most), 4) if v.changed else None,
                "shows_from_mm": round(1e3 * self.hidden, 4) if np.isfinite(self.hidden) else None,
            },
            "witness": None if self.witness is None else self.witness.as_dict(),
            "log_odds": round(v.statistic, 3),
            "log_odds_allowed": round(v.threshold, 3),
            "residuals_over_calibration": {kind: round(value, 3) for kind, value in v.fit.items()},
            "residuals_allowed": WORST_FIT,
            "suspects": [
                {
                    **s.as_dict(),
                    "place_error_mm": round(1e3 * effect, 4),
                    "place_error_at_most_mm": round(1e3 * most, 4),
                }
                for s, effect, most in zip(v.suspects, self.effects, self.at_most, strict=True)
            ]
            if v.changed
            else [],
            "detectable_share": DETECTED,
            "detectable": [d.as_dict() for d in v.detectable],
            "figures": [f.as_dict() for f in v.figures],
        }


def at_place(calibration: CellCalibration, job: Job) -> Callable[[str, Array], float]:
    """What a change (27,) of the "scan" or the "target" chain does at the place of a job, m."""
    board = parse_board(job.board.spec)
    camera_from_board = from_parts((0.0, 0.0, job.photo.stand_off)) * from_parts(-centre_of(board))
    place = (camera_from_board * job.place_from_board.inverse()).translation

    def effect(chain: str, change: Array) -> float:
        if chain == "target":
            return target_effect(calibration.target, change, place)
        # A sweep has the middle of the rail's travel in its middle; where that is, a direction's error is taken up.
        half = 0.5 * job.scan.length
        return scan_effect(calibration.scan, change, job.scan.stand_off, (-half, half))

    return effect


_DECK = {
    "scan camera's mount on the flange": ", or the fine board on the deck",
    "target camera's mount on the flange": ", or the large board on the deck",
}


def _way(effect: float) -> str:
    return f"{1e3 * effect:.2f} mm" if np.isfinite(effect) else "any amount"


def keep_confirmed(folder: Path, calibration: CellCalibration, verification: Verification) -> ConfirmedTurn | None:
    """Keep what `verification` says of the laser with the `calibration` stored in `folder`; what is newly kept.

    A verification that finds anything wrong confirms nothing, and what an earlier one had confirmed goes: the plate by
    which jobs would carry it on may have been knocked since, and so may the laser.
    """
    witness, known = verification.witness, calibration.scan.confirmed
    if witness is None:
        return None
    found = witness.confirmation(time.time()) if verification.good else None
    # Good, and the laser as at the calibration: an earlier turn is as true as it was.
    kept = found if found is not None or not verification.good else known
    if kept is not known:
        changed = replace(calibration, scan=replace(calibration.scan, confirmed=kept))
        save_calibration(changed, folder / f"{calibration.name}.json")
    return found
