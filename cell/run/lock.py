"""The lock by which one process at a time holds the devices of a cell."""

from __future__ import annotations

import errno
import hashlib
import socket
import struct
from collections.abc import Collection
from pathlib import Path
from types import TracebackType

from cell.config import DEVICES, CellConfig
from drivers.errors import InterlockError


class CellLock:
    """Held by the process that has devices of the cell open; the kernel drops it when that process ends.

    Each device's address is held by itself, whoever the users are, so that neither two cells nor two configurations
    share a device. A name in the kernel's abstract socket space has no owner, no rights and nothing to clean up.
    """

    def __init__(self, config: CellConfig, only: Collection[str] = tuple(DEVICES)) -> None:
        """`only` these devices are held."""
        self._name = config.cell.name
        # What hangs on the arm is held with the arm.
        own = [name for name in DEVICES if name in only and not config.make(name).on_arm]
        self._addresses = {name: config.device(name).held for name in own}
        self._held: list[socket.socket] = []

    def __enter__(self) -> CellLock:
        for device, address in self._addresses.items():
            name = _name(device, address)
            held = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                held.bind(name)
                held.listen(8)
            except OSError as error:
                held.close()
                self.__exit__(None, None, None)
                if error.errno != errno.EADDRINUSE:
                    raise
                raise InterlockError(
                    self._name,
                    f"the {device} at {address} is held by {_holder(name)}; wait for its end. `cell abort` ends a run, "
                    "a calibration, a verification, a homing or a jog; anything else is ended in its own shell",
                ) from None
            self._held.append(held)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        while self._held:
            self._held.pop().close()


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


def _holder(name: str) -> str:
    """The process that listens at an abstract socket name, in words."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
        link.settimeout(1.0)
        try:
            link.connect(name)
            pid = struct.unpack("3i", link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[0]
            words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        except (BlockingIOError, TimeoutError):
            return "another process"
        except OSError:
            return "a process that has just ended"
    command = " ".join(word.decode(errors="replace") for word in words if word)
    return f"process {pid} ({command[-80:].strip()})" if command else f"process {pid}"
