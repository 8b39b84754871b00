"""The cell's calibration as a whole: solved, tied to its devices and configuration, written, read and checked.

The digest of its file shows an edit. Its figures are checked besides, by themselves and beside the configuration: that
shows what no calibration says, whoever wrote it.
"""

import hashlib
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cell.base.storage import read_json, require_date, sealed, write_json
from cell.config.cell_config import CellConfig
from cell.measure.calibration import Priors, ScanCalibration, ScanObservation, TargetCalibration, TargetObservation
from cell.measure.calibration.archive import SUFFIX, Observations
from cell.measure.calibration.drift.reference_plate import PlateLine
from cell.measure.calibration.drift.timing import StampTiming
from cell.measure.calibration.judge.faults import SCALE_RANGE, refuse_wrong_lead
from cell.measure.calibration.solve.joint import Joint
from cell.measure.calibration.solve.results import Quality, adjust_scan, adjust_target, sigmas
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.geometry.light_plane import LightPlane
from drivers.errors import CalibrationStale, ConfigError
from drivers.make import CameraConfig, DeviceConfig, RailConfig

LENS = range(4, 9)
"""Parameters of a lens that a calibration may leave as they are; all others it must have estimated."""
LEAST_EIGENVALUE, SYMMETRIC = 1e-10, 1e-5
"""Of the correlations: solved ones have eigenvalues above 1e-5, and differ across the diagonal by less than 1e-6."""
FOCAL_RANGE, OUTSIDE = (0.8, 1.25), 0.25
"""A focal length over the drawn one; how far from the middle the principal point may lie, in widths and heights."""
MOUNT_M, MOUNT_RAD = 0.05, float(np.deg2rad(15.0))
"""How far mounts, the rail's way and the light plane may be from their drawing: ten times what mounting leaves."""


def require_valid(calibration: "CellCalibration") -> None:
    """Raise `ValueError` with the value and its allowed range where the figures by themselves cannot be."""
    scan, target = calibration.scan, calibration.target
    for name, found in (("made", calibration), ("timing.made", scan.timing), ("confirmed.made", scan.confirmed)):
        if found is not None:
            require_date(name, found.made)
    for name, head in (("scan", scan), ("target", target)):
        camera, quality = head.camera, vars(head.quality)
        _require(f"{name}.camera, width and height in px", (camera.width, camera.height), 2, 1e5)
        _require(f"{name}.camera, parameters", camera.parameters, -1e6, 1e6)
        _require(f"{name}.camera, fx and fy over the width", camera.parameters[:2] / camera.width, 0.1, 100.0)
        off = camera.cx / camera.width - 0.5, camera.cy / camera.height - 0.5
        _require(f"{name}.camera, cx and cy from the middle, in widths and heights", off, -OUTSIDE, OUTSIDE)
        _require(f"{name}.flange_from_camera, m", head.flange_from_camera.translation, -2.0, 2.0)
        _require(f"{name}.quality", [figure for figure in quality.values() if figure is not None], 0.0, 1e9)
        if (kept := head.reference) is not None:
            require_covariance(f"{name}.reference.covariance", kept.covariance, range(len(kept.covariance)))
            _require(f"{name}.reference.base_from_board, m", kept.base_from_board.translation, -10.0, 10.0)
            sigma = kept.arm_translation, kept.arm_rotation, kept.rail, kept.dots_scale, kept.stripe_scale
            _require(f"{name}.reference, sigma and scale", sigma, 0.0, 1e3)
            for view, seen in kept.pictures.items():
                there = *seen.base_from_flange.translation, *seen.camera_from_board.translation, seen.rail
                _require(f"{name}.reference.pictures, {view}, m", there, -10.0, 10.0)
    require_covariance("scan.covariance", scan.covariance, LENS)
    require_covariance("target.hand_eye_covariance", target.hand_eye_covariance, range(0))
    _require("scan.light_plane, distance in m and bow", (scan.light_plane.distance, scan.light_plane.bow), -10.0, 10.0)
    _require("scan.light_plane.bow_sigma", scan.bow_sigma, 0.0, 10.0)
    _require("scan.light_plane.bow_gain", scan.bow_gain, -1e9, 1e9)
    _require("scan.rail_direction, its length", np.linalg.norm(scan.rail_direction), *SCALE_RANGE)
    if (witness := scan.witness) is not None:
        _require("scan.witness.rail, m", witness.rail, -10.0, 10.0)


def require_covariance(name: str, covariance: Array, fixed: range) -> None:
    """Raise `ValueError` unless it is symmetric and positive definite; parameters of `fixed` may be zero throughout."""
    _require(name, covariance, -1e9, 1e9)
    variance = np.diag(covariance)
    zero = np.flatnonzero(variance == 0.0)
    if (variance < 0).any() or not set(zero.tolist()) <= set(fixed) or covariance[zero].any():
        raise ValueError(f"{name} has a variance of {variance.min():.3g}; all must be above 0")
    free = np.flatnonzero(variance)
    root = np.sqrt(variance[free])
    correlation = covariance[np.ix_(free, free)] / np.outer(root, root)
    if (off := np.abs(correlation - correlation.T).max(initial=0.0)) > SYMMETRIC or covariance[:, zero].any():
        raise ValueError(f"{name} is not symmetric: its correlations differ by {off:.2g}, allowed {SYMMETRIC:g}")
    least = np.linalg.eigvalsh(0.5 * (correlation + correlation.T)).min(initial=1.0)
    if not least > LEAST_EIGENVALUE:
        raise ValueError(f"{name} is not positive definite: an eigenvalue of its correlations is {least:.2g}")


def require_as_configured(calibration: "CellCalibration", config: CellConfig) -> None:
    """Raise `CalibrationStale` where it is no calibration of the cell as drawn: a unit or a sign is wrong."""
    scan, laser = calibration.scan, config.laser
    try:
        for name, head, drawn in (
            ("scan", scan, config.scan_camera),
            ("target", calibration.target, config.target_camera),
        ):
            camera, focal = head.camera, drawn.focal_length / drawn.pixel
            _require(f"{name}.camera, width over the drawn one", camera.width / drawn.width, 1.0, 1.0)
            _require(f"{name}.camera, height over the drawn one", camera.height / drawn.height, 1.0, 1.0)
            _require(f"{name}.camera, fx and fy over the drawn ones", camera.parameters[:2] / focal, *FOCAL_RANGE)
            off = drawn.flange_from_camera.se3().actInv(head.flange_from_camera)
            _require(f"{name}.flange_from_camera against its drawing, m", off.translation, -MOUNT_M, MOUNT_M)
            _require(f"{name}.flange_from_camera against its drawing, rad", _angle(np.trace(off.rotation) / 2 - 0.5))
        plane = LightPlane.from_baseline(laser.baseline, float(np.arctan(laser.tan_theta)))
        # One plane has two normals.
        _require("scan.light_plane against its drawing, rad", _angle(abs(float(plane.n @ scan.light_plane.n))))
        off_plane = float(scan.light_plane.n @ laser.exit_point) - scan.light_plane.distance
        _require("scan.light_plane, the laser's exit off it, m", off_plane, -MOUNT_M, MOUNT_M)
        way = scan.rail_direction / np.linalg.norm(scan.rail_direction)
        _require("scan.rail_direction against the camera's x axis, rad", _angle(way[0]))
    except ValueError as error:
        raise CalibrationStale(
            f"the calibration of {calibration.date} does not fit the cell as configured: {error}; correct cell.toml, "
            "or run `cell calibrate`"
        ) from error


def _angle(cosine: float) -> float:
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _require(name: str, values: object, least: float = 0.0, most: float = MOUNT_RAD) -> None:
    """Written so that NaN is refused as well."""
    for value in np.ravel(np.asarray(values, dtype=np.float64)).tolist():
        if not least <= value <= most:
            raise ValueError(f"{name}: {value:.6g}, allowed {least:g} to {most:g}")


FORMAT = 2


class CalibrationEdited(CalibrationStale):
    """A stored calibration is not as it was written; `identities` are the serial numbers that the file tells."""

    def __init__(self, text: str, identities: dict[str, str]) -> None:
        super().__init__(text)
        self.identities = identities


@dataclass(frozen=True, eq=False)
class CellCalibration:
    """Scan head and target camera, with the serial numbers and the configuration that they belong to.

    `made` is in seconds since the epoch; `identities` are serial numbers by device name. `kinematics` names the arm's
    table with which the flange's poses were reckoned, as of `kinematics_name`.
    `edits` tell of each edit of its file that a person has accepted: `who`, `when`, `why` and `changed` (the parts).
    """

    scan: ScanCalibration
    target: TargetCalibration
    identities: dict[str, str]
    configuration: str
    made: float
    kinematics: str = ""
    edits: tuple[dict[str, Any], ...] = ()

    def __repr__(self) -> str:
        return f"calibration of {self.date}, hash {self.hash()}"

    @property
    def date(self) -> str:
        """When it was made, for people."""
        return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(self.made))

    @property
    def name(self) -> str:
        """What its file is called: the serial numbers that it belongs to."""
        return name_of(self.identities)

    def as_dict(self) -> dict[str, object]:
        """For storage."""
        return {
            "format": FORMAT, "made": self.made, "date": self.date,
            "identities": self.identities, "configuration": self.configuration, "kinematics": self.kinematics,
            "scan": self.scan.as_dict(), "target": self.target.as_dict(),
            **({"edits": list(self.edits)} if self.edits else {}),
        }  # fmt: skip

    def hash(self) -> str:
        """Hash of its content, for reports: of what it says, not of when it was made."""
        content = {key: value for key, value in self.as_dict().items() if key not in ("made", "date", "edits")}
        # The first format's: runs that were made with it tell this hash.
        content["format"] = 1
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
                "translation_mm": [round(1e3 * float(v), 4) for v in target.flange_from_camera.translation]
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
    scan: list[ScanObservation], target: list[TargetObservation], identities: dict[str, str], config: CellConfig,
    kinematics: str = "", witness: PlateLine | None = None,
) -> Observations:  # fmt: skip
    """The observations with all else that their solution depends on, as of now."""
    priors = Priors(
        arm_translation=config.arm.repeatability, arm_rotation=config.arm.repeatability_angle,
        rail=config.calibration.rail_sigma,
    )  # fmt: skip
    cameras = nominal_camera(config.scan_camera), nominal_camera(config.target_camera)
    return Observations(
        scan, target, *cameras, priors, config.rail.lead, identities, config.calibration_hash(), time.time(),
        kinematics, witness,
    )  # fmt: skip


def solve_observations(observations: Observations) -> Solved:
    """Both cameras' adjustments; nothing but the observations counts. `RefusedError` when they say too little."""
    o = observations
    scan = adjust_scan(o.scan, o.scan_camera, np.array([1.0, 0.0, 0.0]), o.priors)
    head = replace(ScanCalibration.of(scan), witness=o.witness)
    assert head.reference is not None
    head = replace(head, reference=head.reference.with_pictures(o.scan, head.camera))
    refuse_wrong_lead(head.rail_direction, o.rail_lead)
    target = adjust_target(o.target, o.target_camera, o.priors)
    if target.size is not None:
        head = replace(head, notes=(*head.notes, *target.size.notes))
    eye = TargetCalibration.of(target)
    assert eye.reference is not None
    alike = [ScanObservation(one.view, None, one.base_from_flange, 0.0, one.name) for one in o.target]
    eye = replace(eye, reference=eye.reference.with_pictures(alike, eye.camera))
    made = CellCalibration(head, eye, o.identities, o.configuration, made=o.made, kinematics=o.kinematics)
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
    """Write it; a reader finds the old file or the new one, never half of one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, sealed(calibration.as_dict(), parts=True))


def archive_of(folder: Path, calibration: CellCalibration) -> Path:
    """Where the observations of a stored calibration are kept."""
    return folder / f"{calibration.name}{SUFFIX}"


def read_calibration(path: Path) -> CellCalibration:
    """Read a stored calibration; raises `CalibrationStale` when the file is none, `CalibrationEdited` when it was
    changed since it was written."""
    made, changed = _read(path)
    if changed:
        raise CalibrationEdited(
            f"{path} was changed after it was written: {', '.join(changed)}. Put the old file back or run `cell "
            f'calibrate`; if the edit is meant, `cell calibrate accept {path.stem} --why "…"` records it',
            made.identities,
        )
    return made


def accept_calibration(path: Path, who: str, why: str) -> CellCalibration:
    """Take an edited file as it is now, and keep in it who did so, when and why. `CalibrationStale` when what it says
    cannot be, `ConfigError` when nothing was changed."""
    made, changed = _read(path)
    if not changed:
        raise ConfigError(f"{path} is as it was written; there is no edit to accept")
    edit = {"who": who, "when": time.strftime("%Y-%m-%d %H:%M:%S"), "why": why, "changed": list(changed)}
    accepted = replace(made, edits=(*made.edits, edit))
    save_calibration(accepted, path)
    return accepted


def _read(path: Path) -> tuple[CellCalibration, tuple[str, ...]]:
    """A file's calibration, and which of its parts were changed since it was written."""
    try:
        stored = read_json(path)
        data = stored.content
        if data["format"] != FORMAT:
            raise ValueError(f"format {data['format']}, this program reads {FORMAT}")
        made = CellCalibration(
            ScanCalibration.from_dict(data["scan"]),
            TargetCalibration.from_dict(data["target"]),
            {str(name): str(serial) for name, serial in data["identities"].items()},
            configuration=str(data["configuration"]),
            made=float(data["made"]),
            kinematics=str(data["kinematics"]),
            edits=tuple(
                {
                    **{key: str(edit[key]) for key in ("who", "when", "why")},
                    "changed": [str(c) for c in edit["changed"]],
                }
                for edit in data.get("edits", ())
            ),
        )
        require_valid(made)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError) as error:
        raise CalibrationStale(f"{path} cannot be read as a calibration ({error}); run `cell calibrate`") from error
    return made, stored.changed if stored.sealed else ("its digest, which is missing",)


def _lens(camera: CameraModel) -> dict[str, float]:
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    return {name: round(float(value), 6) for name, value in zip(names, camera.parameters[:8], strict=True)}


def _quality(quality: Quality) -> dict[str, float]:
    figures = {
        "views": quality.views, "chi2_per_dof": round(quality.chi2_per_dof, 3),
        "dots_rms_px": round(quality.dots_rms_px, 5), "held_out_dots_rms_px": round(quality.held_out_px, 4),
    }  # fmt: skip
    if quality.stripe_rms is not None and quality.held_out_stripe is not None:
        figures["stripe_rms_mm"] = round(1e3 * quality.stripe_rms, 5)
        figures["held_out_stripe_rms_mm"] = round(1e3 * quality.held_out_stripe, 5)
    return figures


LINKED: dict[str, type[DeviceConfig]] = {"scan_camera": CameraConfig, "rail": RailConfig}
"""The devices whose times are compared. What their makes ask for beyond this is how they are linked and set up."""


def link_of(config: CellConfig) -> dict[str, str]:
    """Every setting of the scan camera's and the rail's make, by "device.key", but not where the device is."""
    made: dict[str, str] = {}
    for name, kind in LINKED.items():
        record = config.device(name)
        own = type(record).model_fields.keys() - kind.model_fields.keys() - {type(record).ADDRESS} | {"driver"}
        made |= {f"{name}.{key}": str(getattr(record, key)) for key in sorted(own)}
    return made


def most_late(config: CellConfig) -> float:
    """The most, s, that stamps may be late against the rail's readings, as the configuration has it."""
    return config.scan_camera.late + config.rail.late


def changed(was: dict[str, str], now: dict[str, str]) -> str:
    """What is set otherwise, for people; "" where nothing is."""
    names = sorted(name for name in was.keys() | now.keys() if was.get(name) != now.get(name))
    return "; ".join(f"{name} was {was.get(name, 'not there')}, is {now.get(name, 'not there')}" for name in names)


def doubt_of(timing: StampTiming, config: CellConfig) -> str:
    """Why it does not hold for the cell as it is configured now, for people; "" where it does."""
    if told := changed(timing.link, link_of(config)):
        return f"it was measured with other settings ({told})"
    most = most_late(config)
    if abs(timing.late) > most + 3 * timing.sigma:
        return f"it is {1e3 * timing.late:g} ms, scan_camera.late and rail.late allow {1e3 * most:g} ms"
    return ""
