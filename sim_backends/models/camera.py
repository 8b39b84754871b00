"""A network camera without its pictures: settings, exposure count, device clock and faults; no bytes, no threads."""

import threading
from dataclasses import dataclass

from sim_backends.faults import CAMERA_FAULTS as FAULTS


@dataclass(frozen=True)
class CameraSpec:
    """What the camera is. The device clock reads `epoch` s at world time 0 and runs `drift_ppm` fast. `latency` (s) is
    by how much the time stamps are later than the exposures really began."""

    model: str
    serial: str
    width: int
    height: int
    frame_rate_max: float
    firmware: str = "1.0"
    exposure_min: float = 20e-6
    exposure_max: float = 1.0
    epoch: float = 1000.0
    drift_ppm: float = 0.0
    latency: float = 0.0

    @property
    def rate(self) -> float:
        """Seconds of the device clock per second of world time."""
        return 1.0 + 1e-6 * self.drift_ppm

    def device_ns(self, t: float) -> int:
        """Reading of the device clock in ns at world time `t`."""
        return round((self.epoch + t * self.rate) * 1e9)


class CameraState:
    """The state of one camera; safe between threads. `exposure` in s and `frame_rate` in Hz are those in force."""

    def __init__(self, spec: CameraSpec) -> None:
        self.spec = spec
        self.exposure = min(max(0.002, spec.exposure_min), spec.exposure_max)
        self.frame_rate = min(10.0, spec.frame_rate_max)
        self._lock = threading.Lock()
        self._exposures = 0
        self._lose = 0
        self._silent = False

    @property
    def next_frame_id(self) -> int:
        """Frame id of the next exposure; ids count all exposures since power-on from 1, lost ones too."""
        with self._lock:
            return self._exposures + 1

    @property
    def silent(self) -> bool:
        """True while the camera says nothing."""
        with self._lock:
            return self._silent

    def expose(self) -> tuple[int, bool]:
        """Count an exposure: its frame id, and whether its picture is lost."""
        with self._lock:
            self._exposures += 1
            lost = self._lose > 0
            self._lose -= int(lost)
            return self._exposures, lost

    def fault(self, name: str, count: int) -> None:
        """`camera.frame_loss`: the next `count` exposures are lost; `camera.silent`: says nothing until `clear()`.
        Raises ValueError for a name that is not in `FAULTS`."""
        if name not in FAULTS:
            raise ValueError(f"unknown camera fault {name!r}; known: {', '.join(FAULTS)}")
        with self._lock:
            if name == "camera.frame_loss":
                self._lose += count
            else:
                self._silent = True

    def clear(self) -> None:
        """Take away all faults."""
        with self._lock:
            self._lose, self._silent = 0, False
