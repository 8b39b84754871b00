"""What a verification found out about the laser, kept with the calibration for the jobs that come after it.

A job has only the plate on the claw, which may have been knocked, and so has to state a turn of the laser as an
uncertainty. A verification has seen the stripe on a board. What it confirms is written into the stored calibration with
its date, what it contradicts is taken out of it. The calibration itself is not changed.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from cell.config.calibrations.store import CellCalibration, save_calibration
from cell.measure.calibration.drift.reference_plate import ConfirmedTurn
from cell.procedures.verify.verdict import Verification


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
