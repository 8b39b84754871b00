"""Files that must survive: whole or not at all, on the disk when the call returns, and with a digest of their content.

The digest is a SHA-256. It shows accidents and edits by hand; it protects from no attacker. Names and dates of runs
(`UNDATED`) do not count: the same seed gives the same digest.
"""

from __future__ import annotations

import ctypes
import errno
import hashlib
import json
import math
import os
import secrets
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NoReturn

from drivers.errors import CellError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

DIGEST, PARTS = "sha256", "sha256_of"
"""Keys of a file: the digest of all the rest, and short ones of its parts, by which an edit can be located."""
UNDATED = ("run", "started", "ended", "at", "calibration_date")
CLOCK_SLACK_S = 3600.0
"""How far a date may lie in the future: clocks of two machines differ."""
FIRST_S = 978_307_200.0
"""2001-01-01: nothing was calibrated before."""


class EditedError(ValueError):
    """A file's content is not what its writer put there."""


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Write a file in the place of `path`: a reader finds the old one or the new one, after a power cut as well.
    Whatever fails, `OSError` of a full disk for one, leaves the old file and no other."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}-{secrets.token_hex(3)}.tmp")
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        sync_folder(path.parent)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def sync_folder(folder: Path) -> None:
    """Have the names in a folder on the disk; a file system that cannot do that is left alone."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(handle)


def sync_files(folder: Path) -> None:
    """Have all files below `folder` on the disk by one call: an fsync for each of a sweep's frames takes 20 times as
    long. Raises `OSError`."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        syncfs = getattr(ctypes.CDLL(None, use_errno=True), "syncfs", None)
        if syncfs is None:
            os.sync()
        elif syncfs(handle) != 0:
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code), str(folder))
    finally:
        os.close(handle)


def write_json(path: Path, data: object) -> None:
    """Write strict JSON by `replacing`. A digest that `data` has is made anew, so that it fits. Raises `CellError` for
    a number that is none, such as NaN, for which JSON has no word: nothing is written then."""
    if isinstance(data, dict) and DIGEST in data:
        data = sealed(data, parts=PARTS in data)
    try:
        text = json.dumps(data, indent=2, allow_nan=False)
    except ValueError as error:
        raise CellError(f"{path} is not written: {error}; one of its figures is no number") from error
    with replacing(path) as file:
        file.write(f"{text}\n".encode())


def strict(data: object) -> Any:
    """The same data as strict JSON has it: a number that is none becomes None, what JSON does not know becomes text."""
    if isinstance(data, Mapping):
        return {str(key): strict(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [strict(value) for value in data]
    # An array or a number of numpy, which is slow to load.
    if hasattr(data, "tolist"):
        return strict(data.tolist())
    if isinstance(data, float) and not math.isfinite(data):
        return None
    return data if data is None or isinstance(data, str | int | float) else str(data)


def sealed(data: Mapping[str, object], *, parts: bool = False) -> dict[str, object]:
    """The data with their digest; with `parts` also the digests of what lies one and two levels deep."""
    content = unsealed(data)
    # As a reader gets it: JSON knows neither tuples nor keys that are numbers.
    kept = json.loads(json.dumps(content))
    return {**content, DIGEST: digest(kept), **({PARTS: _parts(kept)} if parts else {})}


def unsealed(data: Mapping[str, object]) -> dict[str, object]:
    """The content of a sealed file."""
    return {key: value for key, value in data.items() if key not in (DIGEST, PARTS)}


def is_intact(data: Mapping[str, object]) -> bool:
    """Whether data have the digest that they were sealed with, or none."""
    return DIGEST not in data or data[DIGEST] == digest(unsealed(data))


def digest(data: object) -> str:
    """SHA-256 of JSON data, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(_undated(data), sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _undated(data: object) -> object:
    if isinstance(data, dict):
        return {key: _undated(value) for key, value in data.items() if key not in UNDATED}
    return [_undated(value) for value in data] if isinstance(data, list) else data


def _parts(data: dict[str, object]) -> dict[str, str]:
    made: dict[str, str] = {}
    for key, value in data.items():
        below = {f"{key}.{name}": part for name, part in value.items()} if isinstance(value, dict) else {key: value}
        made |= {name: digest(part)[:16] for name, part in below.items()}
    return made


@dataclass(frozen=True)
class Stored:
    """What a JSON file holds without its digest; whether it had one, and which parts were `changed` since."""

    content: dict[str, Any]
    sealed: bool
    changed: tuple[str, ...]

    def require(self) -> dict[str, object]:
        """The content; `EditedError` where it is not as it was written."""
        if self.changed:
            raise EditedError(f"it was changed after it was written: {', '.join(self.changed)}")
        return self.content


def read_json(path: Path) -> Stored:
    """Read a file of `write_json`. Raises `OSError`, and `ValueError` for what is no JSON object, or has NaN in it."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"), parse_constant=_no_number)
        intact = isinstance(data, dict) and is_intact(data)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if not isinstance(data, dict):
        raise ValueError(f"it holds no table, but {str(data)[:40]}")
    parts, has_digest, content = data.get(PARTS), DIGEST in data, unsealed(data)
    if intact:
        return Stored(content, has_digest, ())
    before, now = parts if isinstance(parts, dict) else {}, _parts(content)
    changed = sorted(name for name in before.keys() | now.keys() if before.get(name) != now.get(name))
    return Stored(content, True, tuple(changed) if before and changed else ("its content or its digest",))


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"it holds {text}, which is no number")


def sealed_arrays(arrays: Mapping[str, NDArray[np.generic]]) -> str:
    """What a NumPy archive keeps under `DIGEST`: SHA-256 of each array's type, shape and numbers by its name."""
    return json.dumps(
        {
            name: hashlib.sha256(f"{array.dtype.str} {array.shape} ".encode() + array.tobytes()).hexdigest()
            for name, array in arrays.items()
        }
    )


def require_unchanged(arrays: dict[str, NDArray[np.generic]]) -> None:
    """Take the digests out of an archive's arrays; `EditedError` names what does not fit, or that there is none."""
    if DIGEST not in arrays:
        raise EditedError("its digest is missing")
    told, now = json.loads(str(arrays.pop(DIGEST))), json.loads(sealed_arrays(arrays))
    if changed := sorted(name for name in told.keys() | now.keys() if told.get(name) != now.get(name)):
        raise EditedError(f"it was changed after it was written: {', '.join(changed)}")


def require_date(name: str, seconds: float) -> None:
    """Raise `ValueError` where a date, seconds since the epoch, is none or lies in the future."""
    if not FIRST_S <= seconds < float("inf"):
        raise ValueError(f"{name} is {seconds}, no date in seconds since 1970 (from {FIRST_S:.0f}, 2001-01-01)")
    if (ahead := seconds - time.time()) > CLOCK_SLACK_S:
        raise ValueError(
            f"{name} lies {ahead / 3600:.1f} hours in the future, so its age is not known (allowed: "
            f"{CLOCK_SLACK_S / 3600:g} h); set this machine's clock"
        )
