"""The observations of a calibration, in one file, so that it can be solved again later without any device.

A NumPy archive of plain arrays (nothing in it is executed when it is read) and one JSON text with everything else that
the solution depends on. What is read is checked as if a stranger had written it.
"""

import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from cell.base.storage import DIGEST, replacing, require_date, require_unchanged, sealed_arrays
from cell.measure.calibration.drift.reference_plate import PlateLine, read_edge
from cell.measure.calibration.solve.adjustment import Priors
from cell.measure.geometry.camera import Array, CameraModel
from cell.measure.vision.board.view import BoardView, parse_board
from cell.measure.vision.stripe.profile import StripeProfile
from drivers.errors import ConfigError


@dataclass(frozen=True, eq=False)
class ScanObservation:
    """One arm pose of a scan camera's calibration.

    `view` is the board in a picture, `profile` the laser stripe on the same board at the same pose, in the same picture
    or another; either may be None, not both. `base_from_flange` as the arm reports it, `rail_position` in m.
    `same_rest` says that only the rail has moved since the observation before: the arm's repeatability is the same.
    """

    view: BoardView | None
    profile: StripeProfile | None
    base_from_flange: pin.SE3
    rail_position: float = 0.0
    name: str = ""
    same_rest: bool = False


@dataclass(frozen=True, eq=False)
class TargetObservation:
    """One arm pose of a camera that sees a board at rest; `base_from_flange` as the arm reports it."""

    view: BoardView
    base_from_flange: pin.SE3
    name: str = ""


FORMAT = 2
SUFFIX = ".observations.npz"
PRIORS = ("arm_translation", "arm_rotation", "rail")
PROFILE = ("centres", "sigma", "amplitude", "width", "saturated", "double")


@dataclass(frozen=True, eq=False)
class Observations:
    """All that a cell's calibration is solved from.

    The cameras as drawn, the noise assumed beforehand, the rail's lead as configured in m per turn, and whose they are:
    serial numbers by device name, the hash of the configuration, the time in seconds since the epoch, and the name of
    the arm's table.
    """

    scan: list[ScanObservation]
    target: list[TargetObservation]
    scan_camera: CameraModel
    target_camera: CameraModel
    priors: Priors
    rail_lead: float
    identities: dict[str, str]
    configuration: str
    made: float
    kinematics: str = ""
    witness: PlateLine | None = None


def write_archive(path: Path, observations: Observations) -> None:
    """Write it; a reader finds the old file or the new one, never half of one."""
    o = observations
    about = {
        "format": FORMAT, "made": o.made, "identities": o.identities, "configuration": o.configuration,
        "kinematics": o.kinematics, "rail_lead": o.rail_lead,
        "priors": {name: getattr(o.priors, name) for name in PRIORS}, "scan_camera": o.scan_camera.as_dict(),
        "target_camera": o.target_camera.as_dict(),
    }  # fmt: skip
    arrays = _views("scan", [(s.view, s.base_from_flange, s.name) for s in o.scan])
    arrays |= _views("target", [(t.view, t.base_from_flange, t.name) for t in o.target])
    arrays["scan_rail"] = np.array([s.rail_position for s in o.scan])
    arrays["scan_same_rest"] = np.array([s.same_rest for s in o.scan], dtype=np.bool_)
    arrays |= _profiles([s.profile for s in o.scan])
    if o.witness is not None:
        arrays["witness_columns"] = o.witness.columns
        about["witness_rail"] = o.witness.rail
        about["witness_edge"] = None if o.witness.edge is None else vars(o.witness.edge)
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays["about"] = np.array(json.dumps(about))
    arrays[DIGEST] = np.array(sealed_arrays(arrays))
    with replacing(path) as file:
        np.savez_compressed(file, **arrays)


def read_archive(path: Path) -> Observations:
    """Read and check it; raises `ConfigError` that says what is missing, of another version or no number."""
    advice = f"give a {SUFFIX} file that `cell calibrate` wrote beside a calibration"
    data = _arrays(path, advice)
    try:
        about = json.loads(str(data["about"]))
        if about["format"] != FORMAT:
            raise ValueError(f"it has format {about['format']}, this program reads {FORMAT}")
        scan = _read_views(data, "scan")
        profiles = _read_profiles(data, len(scan))
        rails = _finite(data, "scan_rail", (len(scan),))
        same_rest = np.asarray(data["scan_same_rest"])
        if same_rest.shape != (len(scan),) or same_rest.dtype != np.bool_:
            raise ValueError(f"scan_same_rest must say yes or no for each of {len(scan)} views")
        shift, turn, along = (_positive(about["priors"], name) for name in PRIORS)
        priors = Priors(shift, turn, along)
        require_date("made", float(about["made"]))
        found = Observations(
            [
                ScanObservation(view, profile, flange, rail_position=float(rail), name=name, same_rest=bool(same))
                for (view, flange, name), profile, rail, same in zip(scan, profiles, rails, same_rest, strict=True)
            ],
            [
                TargetObservation(view, flange, name)
                for view, flange, name in _read_views(data, "target")
                if view is not None
            ],
            _camera(about["scan_camera"]), target_camera=_camera(about["target_camera"]), priors=priors,
            rail_lead=_positive(about, "rail_lead"),
            identities={str(name): str(serial) for name, serial in about["identities"].items()},
            configuration=str(about["configuration"]), made=float(about["made"]),
            kinematics=str(about["kinematics"]), witness=_read_witness(data, about),
        )  # fmt: skip
        # Last: what is wrong with a figure says more than that something was changed.
        require_unchanged(data)
        return found
    except KeyError as error:
        raise ConfigError(f"{path} lacks {error}; {advice}") from error
    except (ValueError, TypeError, AttributeError, IndexError, ConfigError) as error:
        raise ConfigError(f"{path} cannot be solved: {error}; {advice}") from error


def _arrays(path: Path, advice: str) -> dict[str, Any]:
    """The arrays of the archive by their names; raises `ConfigError` where it is not there or not whole."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except FileNotFoundError as error:
        raise ConfigError(f"{path} does not exist; {advice}") from error
    except (OSError, ValueError, EOFError, KeyError, AttributeError, zlib.error, zipfile.BadZipFile) as error:
        raise ConfigError(f"{path} is no whole archive of observations ({error}); {advice}") from error


def _read_witness(data: Mapping[str, Any], about: Mapping[str, Any]) -> PlateLine | None:
    if "witness_rail" not in about:
        return None
    columns = np.asarray(data["witness_columns"], dtype=np.float64)
    if columns.ndim != 1:
        raise ValueError(f"the witness needs one column for each row, not an array of shape {columns.shape}")
    return PlateLine(float(about["witness_rail"]), columns, read_edge(about.get("witness_edge")))


def _views(camera: str, views: Sequence[tuple[BoardView | None, pin.SE3, str]]) -> dict[str, Any]:
    """Views one after the other in long arrays; `…_points` says how many belong to each, −1 where no board was seen."""
    seen = [view for view, _, _ in views if view is not None]
    made = {
        "flange": np.array([flange.homogeneous for _, flange, _ in views]).reshape(-1, 4, 4),
        "name": np.array([name for _, _, name in views], dtype=np.str_),
        "points": np.array([-1 if view is None else len(view.ids) for view, _, _ in views], dtype=np.int64),
        "board": np.array([view.spec.name for view in seen], dtype=np.str_),
        "size": np.array([view.size for view in seen], dtype=np.int64).reshape(-1, 2),
        "order_assumed": np.array([view.order_assumed for view in seen], dtype=np.bool_),
        "dot_radius": np.array([view.dot_radius for view in seen]),
        "ids": np.concatenate([np.zeros(0, dtype=np.int64), *(view.ids for view in seen)]),
        "pixels": np.concatenate([np.zeros((0, 2)), *(view.pixels for view in seen)]),
        "sigma": np.concatenate([np.zeros(0), *(view.sigma for view in seen)]),
    }
    return {f"{camera}_{name}": array for name, array in made.items()}


def _read_views(data: Mapping[str, Any], camera: str) -> list[tuple[BoardView | None, pin.SE3, str]]:
    counts = np.asarray(data[f"{camera}_points"])
    if counts.ndim != 1 or not np.issubdtype(counts.dtype, np.integer) or len(counts) == 0:
        raise ValueError(f"{camera}_points must count the points of at least one view")
    total, seen = int(counts[counts > 0].sum()), int((counts >= 0).sum())
    flanges = _finite(data, f"{camera}_flange", (len(counts), 4, 4))
    pixels = _finite(data, f"{camera}_pixels", (total, 2))
    sigma = _finite(data, f"{camera}_sigma", (total,))
    if not (sigma > 0).all():
        raise ValueError(f"{camera}_sigma must be positive; its least is {sigma.min():g} px")
    ids, radii = data[f"{camera}_ids"], _finite(data, f"{camera}_dot_radius", (seen,))
    sizes, boards, assumed = (data[f"{camera}_{name}"] for name in ("size", "board", "order_assumed"))
    if ids.shape != (total,) or not np.issubdtype(ids.dtype, np.integer):
        raise ValueError(f"{camera}_ids must hold {total} whole numbers, not {ids.dtype} of shape {ids.shape}")
    made: list[tuple[BoardView | None, pin.SE3, str]] = []
    start, k = 0, 0
    for count, flange, name in zip(counts.tolist(), flanges, data[f"{camera}_name"], strict=True):
        view = None
        if count >= 0:
            part = slice(start, start + count)
            spec = parse_board(str(boards[k]))
            if count and not 0 <= int(ids[part].min()) <= int(ids[part].max()) < len(spec.points()):
                raise ValueError(f"{camera}_ids of {name} lie outside 0 to {len(spec.points()) - 1} of {spec.name}")
            size = (int(sizes[k, 0]), int(sizes[k, 1]))
            view = BoardView(
                spec, size, ids[part], pixels=pixels[part], sigma=sigma[part], order_assumed=bool(assumed[k]),
                dot_radius=float(radii[k]),
            )  # fmt: skip
            start, k = start + count, k + 1
        made.append((view, _pose(flange, str(name)), str(name)))
    return made


def _profiles(profiles: Sequence[StripeProfile | None]) -> dict[str, Any]:
    """The stripes of all lit views as arrays (lit, rows); `stripe_axis` is empty where a view has none."""
    lit = [profile for profile in profiles if profile is not None]
    made: dict[str, Any] = {
        "stripe_axis": np.array(["" if profile is None else profile.axis for profile in profiles], dtype=np.str_)
    }
    for name in PROFILE:
        made[f"stripe_{name}"] = np.array([getattr(profile, name) for profile in lit])
    return made


def _read_profiles(data: Mapping[str, Any], views: int) -> list[StripeProfile | None]:
    axes = [str(axis) for axis in data["stripe_axis"]]
    if len(axes) != views or not set(axes) <= {"", "rows", "columns"}:
        raise ValueError(f"stripe_axis must say rows, columns or nothing for each of {views} views")
    lit = sum(axis != "" for axis in axes)
    arrays = [data[f"stripe_{name}"] for name in PROFILE]
    if any(array.shape[:1] != (lit,) or array.shape != arrays[0].shape for array in arrays):
        raise ValueError(f"the stripes' arrays must all hold {lit} profiles of one length")
    centres, sigma = arrays[0], arrays[1]
    if not (sigma[np.isfinite(centres)] > 0).all():
        raise ValueError("stripe_sigma must be positive wherever stripe_centres has a number")
    rest = iter(zip(*arrays, strict=True))
    return [StripeProfile("columns" if axis == "columns" else "rows", *next(rest)) if axis else None for axis in axes]


def _finite(data: Mapping[str, object], name: str, shape: tuple[int, ...]) -> Array:
    array = np.asarray(data[name], dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds {int((~np.isfinite(array)).sum())} values that are no numbers")
    return array


def _positive(about: Mapping[str, Any], name: str) -> float:
    value = float(about[name])
    if not 0 < value < 1:
        raise ValueError(f"the deviation {name} is {value:g}, allowed is more than 0 and less than 1 (m, rad)")
    return value


def _pose(matrix: Array, name: str) -> pin.SE3:
    """Kept bit by bit, where `from_matrix` would bring it to the nearest rotation."""
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0:
        raise ValueError(f"the flange pose of {name} is no rotation and translation")
    return pin.SE3(rotation, matrix[:3, 3].copy())


def _camera(data: Mapping[str, Any]) -> CameraModel:
    made = CameraModel.read(data)
    if not np.isfinite(made.parameters).all() or made.fx <= 0 or made.fy <= 0:
        raise ValueError("a nominal camera needs finite parameters and focal lengths above 0 px")
    return made
