"""The cell's calibration as a whole: solved, tied to its devices and configuration, written and read."""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cell.base.notebook import table
from cell.base.storage import read_json, sealed, write_json
from cell.config.calibrations.validation import require_valid
from cell.config.cell_config import CameraConfig, CellConfig
from cell.measure.calibration import Priors, ScanCalibration, ScanObservation, TargetCalibration, TargetObservation
from cell.measure.calibration.archive import SUFFIX, Observations, write_archive
from cell.measure.calibration.drift.reference_plate import PlateLine
from cell.measure.calibration.judge.faults import refuse_wrong_lead
from cell.measure.calibration.solve.cameras import adjust_scan, adjust_target
from cell.measure.calibration.solve.joint import Joint
from cell.measure.calibration.solve.results import Quality, sigmas
from cell.measure.geometry.camera import CameraModel
from drivers.errors import CalibrationStale, ConfigError

FORMAT, UNSEALED = 2, 1
"""Of the files written now, and of those that had no digest, which are read with a note."""


class CalibrationEdited(CalibrationStale):
    """A stored calibration is not as it was written; `identities` are the serial numbers that the file tells."""

    def __init__(self, text: str, identities: dict[str, str]) -> None:
        super().__init__(text)
        self.identities = identities


@dataclass(frozen=True, eq=False)
class CellCalibration:
    """Scan head and target camera, with the serial numbers and the configuration that they belong to.

    `made` is in seconds since the epoch; `identities` are serial numbers by device name. `kinematics` names the arm's
    table with which the flange's poses were reckoned, as of `kinematics_name`; "" in files that do not say so.
    `edits` tell of each edit of its file that a person has accepted: `who`, `when`, `why` and `changed` (the parts).
    One that is not `sealed` was read from a file without a digest: it is stored again without one.
    """

    scan: ScanCalibration
    target: TargetCalibration
    identities: dict[str, str]
    configuration: str
    made: float
    kinematics: str = ""
    edits: tuple[dict[str, Any], ...] = ()
    sealed: bool = True

    @classmethod
    def solve(
        cls,
        scan: list[ScanObservation],
        target: list[TargetObservation],
        identities: dict[str, str],
        config: CellConfig,
        kinematics: str = "",
        witness: PlateLine | None = None,
    ) -> CellCalibration:
        """From the observations; raises `RefusedError` when they do not determine it."""
        return solve_observations(gathered(scan, target, identities, config, kinematics, witness=witness)).calibration

    def __str__(self) -> str:
        return f"calibration of {self.date}, hash {self.hash()}"

    def __repr__(self) -> str:
        return f"<CellCalibration of {self.date}, hash {self.hash()}>"

    def _repr_html_(self) -> str:
        rows = [(device, serial) for device, serial in sorted(self.identities.items())]
        for name, quality in (("scan head", self.scan.quality), ("target camera", self.target.quality)):
            fit = f"χ²/dof {quality.chi2_per_dof:.3f}, {quality.views} views, dots {quality.dots_rms_px:.4f} px RMS"
            rows.append((name, fit))
        return table(f"calibration of {self.date}", [*rows, ("hash", self.hash())])

    @property
    def date(self) -> str:
        """When it was made, for people."""
        return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(self.made))

    @property
    def name(self) -> str:
        """What its file is called: the serial numbers that it belongs to."""
        return name_of(self.identities)

    def as_dict(self) -> dict[str, Any]:
        """For storage."""
        return {
            "format": FORMAT if self.sealed else UNSEALED,
            "made": self.made,
            "date": self.date,
            "identities": self.identities,
            "configuration": self.configuration,
            "kinematics": self.kinematics,
            "scan": self.scan.as_dict(),
            "target": self.target.as_dict(),
            **({"edits": list(self.edits)} if self.edits else {}),
        }

    def hash(self) -> str:
        """Hash of its content, for reports: of what it says, not of when it was made."""
        content = {key: value for key, value in self.as_dict().items() if key not in ("made", "date", "edits")}
        # The first format's, so that a file has the hash that earlier runs tell of it.
        content["format"] = UNSEALED
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]

    def summary(self) -> dict[str, Any]:
        """Values, standard deviations and residuals by name, units in the names."""
        scan, target = self.scan, self.target
        sigma = sigmas(scan.covariance)
        return {
            "date": self.date,
            "identities": self.identities,
            "scan_camera": {
                **_lens(scan.camera),
                **{f"sigma_{name}": round(sigma[name], 5) for name in ("fx", "fy", "cx", "cy", "k1")},
            },
            "light_plane": {
                "normal": [round(v, 7) for v in scan.light_plane.normal],
                "distance_mm": round(1e3 * scan.light_plane.distance, 4),
                "sigma_distance_mm": round(1e3 * sigma["plane distance"], 5),
            },
            "rail": {
                "direction": [round(float(v), 6) for v in scan.rail_direction / np.linalg.norm(scan.rail_direction)],
                "scale": round(float(np.linalg.norm(scan.rail_direction)), 6),
                "sigma_scale": round(sigma["rail x"], 6),
            },
            "hand_eye": {
                "translation_mm": [round(1e3 * float(v), 4) for v in scan.flange_from_camera.translation],
                "sigma_mm": [round(1e3 * sigma[f"hand-eye {axis}"], 4) for axis in "xyz"],
                "sigma_mrad": [round(1e3 * sigma[f"hand-eye r{axis}"], 4) for axis in "xyz"],
            },
            "laser_since": None if scan.confirmed is None else scan.confirmed.summary(),
            "timing": None if scan.timing is None else scan.timing.summary(),
            "scan_quality": _quality(scan.quality),
            "target_camera": _lens(target.camera),
            "target_hand_eye": {
                "translation_mm": [round(1e3 * float(v), 4) for v in target.flange_from_camera.translation],
            },
            "target_quality": _quality(target.quality),
            "shutter": None if scan.shutter is None else scan.shutter.summary(),
            "notes": [
                *scan.notes,
                *scan.unread,
                *((scan.refused,) if scan.refused else ()),
                *(f"edited by {e['who']} on {e['when']} ({', '.join(e['changed'])}): {e['why']}" for e in self.edits),
            ],
        }


@dataclass(frozen=True, eq=False)
class Solved:
    """A calibration and the two adjustments that it came from, with their residuals."""

    calibration: CellCalibration
    scan: Joint
    target: Joint


def gathered(
    scan: list[ScanObservation],
    target: list[TargetObservation],
    identities: dict[str, str],
    config: CellConfig,
    kinematics: str = "",
    witness: PlateLine | None = None,
) -> Observations:
    """The observations with all else that their solution depends on, as of now."""
    priors = Priors(
        arm_translation=config.arm.repeatability,
        arm_rotation=config.arm.repeatability_angle,
        rail=config.calibration.rail_sigma,
    )
    cameras = nominal_camera(config.scan_camera), nominal_camera(config.target_camera)
    return Observations(
        scan,
        target,
        *cameras,
        priors,
        config.rail.lead,
        identities,
        config.calibration_hash(),
        time.time(),
        kinematics,
        witness,
    )


def solve_observations(observations: Observations) -> Solved:
    """Both cameras' adjustments; nothing but the observations counts. `RefusedError` when they say too little."""
    o = observations
    scan = adjust_scan(o.scan, o.scan_camera, np.array([1.0, 0.0, 0.0]), o.priors)
    head = replace(ScanCalibration.of(scan), witness=o.witness)
    refuse_wrong_lead(head.rail_direction, o.rail_lead)
    target = adjust_target(o.target, o.target_camera, o.priors)
    if target.size is not None:
        head = replace(head, notes=(*head.notes, *target.size.notes))
    made = CellCalibration(
        head, TargetCalibration.of(target), o.identities, o.configuration, made=o.made, kinematics=o.kinematics
    )
    return Solved(made, scan, target)


def nominal_camera(config: CameraConfig) -> CameraModel:
    """The camera as the configuration draws it: no distortion, principal point in the middle."""
    focal = config.focal_length / config.pixel
    return CameraModel(
        config.width, config.height, focal, focal, (config.width - 1) / 2, cy=(config.height - 1) / 2, dist=(0.0,) * 5
    )


def name_of(identities: dict[str, str]) -> str:
    """What the file of these devices' calibration is called, without its ending."""
    return "-".join(identities[device] for device in sorted(identities))


def save_calibration(calibration: CellCalibration, path: Path) -> None:
    """Write it; a reader finds the old file or the new one, never half of one.

    A fresh digest would vouch for what nobody could check: one that was read without a digest gets none.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    content = calibration.as_dict()
    write_json(path, sealed(content, parts=True) if calibration.sealed else content)


def archive_of(folder: Path, calibration: CellCalibration) -> Path:
    """Where the observations of a stored calibration are kept."""
    return folder / f"{calibration.name}{SUFFIX}"


def save_with_observations(calibration: CellCalibration, observations: Observations, folder: Path) -> None:
    """Write the calibration and, beside it, what it can be solved from again."""
    write_archive(archive_of(folder, calibration), observations)
    save_calibration(calibration, folder / f"{calibration.name}.json")


def read_calibration(path: Path) -> CellCalibration:
    """Read a stored calibration; raises `CalibrationStale` when the file is none, `CalibrationEdited` when it was
    changed since it was written."""
    made, changed, _ = _read(path)
    if changed:
        raise CalibrationEdited(
            f"{path} was changed after it was written: {', '.join(changed)}. Put the old file back or run `cell "
            f'calibrate`; if the edit is meant, `cell calibrate accept {path.stem} --why "…"` records it',
            made.identities,
        )
    return made


def accept_calibration(path: Path, who: str, why: str) -> CellCalibration:
    """Take an edited file, or one without a digest, as it is now, and keep in it who did so, when and why.

    `CalibrationStale` when what it says cannot be, `ConfigError` when nothing was changed.
    """
    made, changed, intact = _read(path)
    if intact:
        raise ConfigError(f"{path} is as it was written; there is no edit to accept")
    edit = {
        "who": who,
        "when": time.strftime("%Y-%m-%d %H:%M:%S"),
        "why": why,
        "changed": list(changed) or ["it had no digest"],
    }
    accepted = replace(made, edits=(*made.edits, edit), sealed=True)
    save_calibration(accepted, path)
    return accepted


def _read(path: Path) -> tuple[CellCalibration, tuple[str, ...], bool]:
    """A file's calibration, which of its parts were changed since it was written, and whether its digest fits."""
    try:
        stored = read_json(path)
        data = stored.content
        if data["format"] not in (FORMAT, UNSEALED):
            raise ValueError(f"format {data['format']}, this program reads {UNSEALED} and {FORMAT}")
        scan = ScanCalibration.from_dict(data["scan"])
        changed = stored.changed
        if data["format"] == FORMAT and not stored.sealed:
            changed = ("its digest, which is missing",)
        elif not stored.sealed:
            note = (
                "the stored calibration was made before its file had a digest: an edit of it would not show. Run `cell "
                f'calibrate`, or `cell calibrate accept {path.stem} --why "…"`'
            )
            scan = replace(scan, unread=(*scan.unread, note))
        made = CellCalibration(
            scan,
            TargetCalibration.from_dict(data["target"]),
            {str(name): str(serial) for name, serial in data["identities"].items()},
            configuration=str(data["configuration"]),
            made=float(data["made"]),
            kinematics=str(data.get("kinematics", "")),
            edits=tuple(
                {
                    **{key: str(edit[key]) for key in ("who", "when", "why")},
                    "changed": [str(c) for c in edit["changed"]],
                }
                for edit in data.get("edits", ())
            ),
            sealed=stored.sealed,
        )
        require_valid(made)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError) as error:
        raise CalibrationStale(f"{path} cannot be read as a calibration ({error}); run `cell calibrate`") from error
    return made, changed, stored.sealed and not changed


def _lens(camera: CameraModel) -> dict[str, float]:
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    return {name: round(float(value), 6) for name, value in zip(names, camera.parameters[:8], strict=True)}


def _quality(quality: Quality) -> dict[str, float]:
    figures = {
        "views": quality.views,
        "chi2_per_dof": round(quality.chi2_per_dof, 3),
        "dots_rms_px": round(quality.dots_rms_px, 5),
        "held_out_dots_rms_px": round(quality.held_out_px, 4),
    }
    if quality.stripe_rms is not None and quality.held_out_stripe is not None:
        figures["stripe_rms_mm"] = round(1e3 * quality.stripe_rms, 5)
        figures["held_out_stripe_rms_mm"] = round(1e3 * quality.held_out_stripe, 5)
    return figures
