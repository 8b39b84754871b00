"""The lock by which one process at a time holds the devices of a cell."""

import errno
import fcntl
import hashlib
import os
import pwd
import socket
import struct
import tempfile
from collections.abc import Collection
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Self

from cell.config.cell_config import DEVICES, CellConfig
from drivers.errors import InterlockError

OWN = "CELL_LOCKS"
"""Environment variable: with the value "own" a device is held against this user's programs only."""


class CellLock:
    """Held by the process that has devices of the cell open; the kernel drops it when that process ends.

    Each device's address is held by itself, so neither two cells nor two configurations share one: by a lock on a file
    in a folder of the user, and for other users by a name in the kernel's abstract socket space. Anybody can take such
    a name. The refusal tells who has it, and how to go on without it.
    """

    def __init__(self, config: CellConfig, only: Collection[str] = tuple(DEVICES)) -> None:
        """`only` these devices are held."""
        self._name = config.cell.name
        # What hangs on the arm is held with the arm.
        own = [name for name in DEVICES if name in only and not config.make(name).on_arm]
        self._addresses = {name: config.device(name).held for name in own}
        self._held = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as held:
            for device, address in self._addresses.items():
                self._hold(held, device, address)
            self._held = held.pop_all()
        return self

    def _hold(self, held: ExitStack, device: str, address: str) -> None:
        name = _name(device, address)
        file = os.open(_folder(self._name) / name[1:], os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        held.callback(os.close, file)
        notice = held.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
        own = False
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            own = os.environ.get(OWN) == "own"
            notice.bind(name)
            notice.listen(8)
        except OSError as error:
            if error.errno == errno.EADDRINUSE and own:
                return
            if error.errno not in (errno.EADDRINUSE, errno.EWOULDBLOCK):
                raise
            raise InterlockError(
                self._name, f"the {device} at {address} is held by {_holder(name)}; {_remedy(name)}"
            ) from None

    def __exit__(self, *_: object) -> None:
        self._held.close()


def _folder(cell: str) -> Path:
    """Where this user's locks are: a folder that nobody else may enter, made if it is not there."""
    folder = Path(tempfile.gettempdir()) / f"assembly-cell-{os.getuid()}"
    with suppress(FileExistsError):
        folder.mkdir(0o700)
    found = folder.lstat()
    if not folder.is_dir() or folder.is_symlink() or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise InterlockError(
            cell,
            f"locks lie in {folder}, which has to be a folder of yours with mode 0700; it is {_user(found.st_uid)}'s, "
            f"mode {found.st_mode & 0o777:04o}. Have it removed, or set TMPDIR to a folder of yours",
        )
    return folder


def _user(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"user {uid}"


def who_holds(device: str, address: str) -> str:
    """The process that holds this device (its name in the configuration, its address), in words; "" when none does."""
    name = _name(device, address)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
        link.settimeout(1.0)
        try:
            link.connect(name)
        except (ConnectionRefusedError, FileNotFoundError):
            return ""
        except OSError:
            return "another process"
    return _holder(name)


def _name(device: str, address: str) -> str:
    return "\0assembly-cell." + hashlib.sha256(f"{device} {address}".encode()).hexdigest()


def _peer(name: str) -> tuple[int, int] | None:
    """Process and user that listen at an abstract socket name; None when nobody does."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link, suppress(OSError):
        link.settimeout(1.0)
        link.connect(name)
        pid, uid, _ = struct.unpack("3i", link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
        return pid, uid
    return None


def _holder(name: str) -> str:
    """Who has an abstract socket name, in words."""
    if (peer := _peer(name)) is None:
        return "another process, which does not answer"
    pid, uid = peer
    command = ""
    with suppress(OSError):
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        command = " ".join(word.decode(errors="replace") for word in words if word)[-80:].strip()
    told = f"process {pid} ({command})" if command else f"process {pid}"
    return told if uid == os.getuid() else f"{told} of {_user(uid)}"


def _remedy(name: str) -> str:
    peer = _peer(name)
    if peer is not None and peer[1] == os.getuid():
        return (
            "wait for its end. `cell abort` ends a run, a calibration, a verification, a homing or a jog; anything "
            "else is ended in its own shell"
        )
    find = "`sudo ss -xlp | grep assembly-cell` names it" if peer is None else f"`sudo kill {peer[0]}` ends it"
    return f"wait for its end or ask who has it; {find}. If it is no cell, {OWN}=own goes on without that name"
