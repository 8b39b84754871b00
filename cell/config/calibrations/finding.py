"""Which of the stored calibrations holds for the devices and the configuration of now, or why none does."""

import time
from dataclasses import replace
from pathlib import Path

from cell.config.calibrations.store import CalibrationEdited, CellCalibration, name_of, read_calibration
from drivers.errors import CalibrationStale, CellError, NotConnectedError


def find_calibration(
    folder: Path, identities: dict[str, str], configuration: str, max_age: float, kinematics: str = "", untold: str = ""
) -> CellCalibration:
    """The stored calibration of these devices under this configuration, not older than `max_age` s.

    `kinematics` names the arm's table, as of `kinematics_name`; `untold` says why the arm has not told it now, if so.
    An edited copy beside it is passed over; `scan.unread` says so, and jobs warn of it.

    Raises `CalibrationStale` that says what is missing, what differs, or why the file that the cell writes cannot be
    read, `CalibrationEdited` where that file was edited or nothing intact is of these devices, and `NotConnectedError`
    when the arm has to be asked again before anybody can tell.
    """
    found, unreadable, edited = _stored(folder, identities)
    own = [entry for entry in found if entry.identities == identities]
    if not own:
        raise _none_of_these(folder, identities, found, unreadable)
    current = [entry for entry in own if entry.configuration == configuration]
    if not current:
        raise CalibrationStale(
            f"the calibration of {own[-1].date} was made under another configuration ({own[-1].configuration}, now "
            f"{configuration}): optics, mounting, rail or boards were changed since; run `cell calibrate`"
        )
    fitting = [entry for entry in current if entry.kinematics == kinematics]
    if not fitting:
        raise _other_kinematics(current[-1], kinematics, untold)
    newest = max(fitting, key=lambda entry: entry.made)
    age = time.time() - newest.made
    if age > max_age:
        raise CalibrationStale(
            f"the calibration of {newest.date} is {age / 86400:.1f} days old, allowed are {max_age / 86400:.1f}; run "
            "`cell calibrate`"
        )
    if newest.scan.refused:
        raise CalibrationStale(
            f"the calibration of {newest.date} holds no more, as was found since: {newest.scan.refused}. Then run "
            "`cell calibrate`"
        )
    notes = (f"{error} It is passed over, and the calibration of {newest.date} is used." for error in edited)
    return replace(newest, scan=replace(newest.scan, unread=(*newest.scan.unread, *notes)))


def _none_of_these(
    folder: Path, identities: dict[str, str], found: list[CellCalibration], unreadable: list[tuple[str, str]]
) -> CalibrationStale:
    """Nothing stored is of these devices: what is stored instead, and what could not be read."""
    devices = ", ".join(f"{name} {serial}" for name, serial in sorted(identities.items()))
    return CalibrationStale(
        f"{folder} holds no calibration of these devices ({devices}), of {len(found)} stored"
        + (f" and {len(unreadable)} unreadable ({', '.join(name for name, _ in unreadable)})" if unreadable else "")
        + _exchanged(found, identities)
        + "; run `cell calibrate`"
        + "".join(f". {why}" for _, why in unreadable)
    )


def _other_kinematics(newest: CellCalibration, kinematics: str, untold: str) -> CellError:
    """The arm's table is another one now; or the arm did not tell it, so that nobody knows."""
    if untold and newest.kinematics:
        return NotConnectedError(
            "arm",
            f"its port 30001 was not read now: {untold}; the calibration of {newest.date} was made with the "
            f"table that it told then ({newest.kinematics}), and whether it fits is not known. See that the arm "
            "is on and that port open, then connect anew",
        )
    return CalibrationStale(
        f"the calibration of {newest.date} was made with another kinematics of the arm "
        f"({newest.kinematics or 'it does not say which'}; the arm now has "
        f"{kinematics or 'none that is known'}): the arm or its controller was exchanged, or the arm was "
        "calibrated anew, or its port 30001 could be read then and not now; run `cell calibrate`"
    )


def _stored(
    folder: Path, identities: dict[str, str]
) -> tuple[list[CellCalibration], list[tuple[str, str]], list[CalibrationEdited]]:
    """The calibrations in `folder`; name and trouble of each file that cannot be read; edited copies of these devices'.
    The file that the cell writes comes first: a copy is of the same age, and lacks what was added since."""
    own = name_of(identities)
    found: list[CellCalibration] = []
    unreadable: list[tuple[str, str]] = []
    edited: list[CalibrationEdited] = []
    for path in sorted(folder.glob("*.json"), key=lambda path: (path.stem != own, path)):
        try:
            found.append(read_calibration(path))
        except CalibrationStale as error:
            # Another file of these devices may be older.
            if path.stem == own:
                raise
            if isinstance(error, CalibrationEdited) and error.identities == identities:
                edited.append(error)
            unreadable.append((path.name, str(error)))
    if edited and not any(entry.identities == identities for entry in found):
        raise edited[0]
    return found, unreadable, edited


def _exchanged(found: list[CellCalibration], identities: dict[str, str]) -> str:
    """Which devices the calibration that is nearest to these was made with instead, in words."""

    def others(entry: CellCalibration) -> list[str]:
        names = sorted(entry.identities.keys() | identities.keys())
        return [name for name in names if entry.identities.get(name) != identities.get(name)]

    if not found:
        return ""
    nearest = min(found, key=lambda entry: (len(others(entry)), -entry.made))
    instead = ", ".join(f"{name} {nearest.identities.get(name, 'none')}" for name in others(nearest))
    return f". That of {nearest.date} was made with another one: {instead}"
