"""What each kind of device promises, whatever its make: one file per kind, all of them imported from here.

Units are SI, times are seconds of the injected `Clock`. Every method raises a `drivers.errors.CellError`: limits are
checked before anything is sent (`LimitError`), a peer that is silent is a `DeadlineError` or `NotConnectedError`, a
fault of the device is a `DeviceFault` that names it. Nothing returns a stale reading as if it were fresh.

Commands that move return at once with a `Motion`; `wait()` on it blocks. `stop()` may be called from any thread at any
time, overtakes every queued or running command, returns when the device has taken it, and is idempotent. `close()`
leaves the device safe and is idempotent.
"""

from drivers.clock import Latch
from drivers.interfaces.arm import Arm, ArmMotion, ArmSafety, ArmState, SaysWhyUntold, TriesOutputs, why_untold
from drivers.interfaces.camera import Camera, Frame, FrameStream, Image
from drivers.interfaces.device import (
    ATTENDED_S,
    Attended,
    Claw,
    Device,
    Examined,
    Identity,
    Laser,
    LinkStatistics,
    Motion,
    Reading,
    SaysHowKnown,
    Vector,
)
from drivers.interfaces.rail import LONGEST_NUDGE_M, ChecksZero, Nudged, Rail, RailState, Sweep
from drivers.interfaces.vehicle import Vehicle, VehicleState
from drivers.link_table import LinkTable

__all__ = [
    "ATTENDED_S",
    "LONGEST_NUDGE_M",
    "Arm",
    "ArmMotion",
    "ArmSafety",
    "ArmState",
    "Attended",
    "Camera",
    "ChecksZero",
    "Claw",
    "Device",
    "Examined",
    "Frame",
    "FrameStream",
    "Identity",
    "Image",
    "Laser",
    "Latch",
    "LinkStatistics",
    "LinkTable",
    "Motion",
    "Nudged",
    "Rail",
    "RailState",
    "Reading",
    "SaysHowKnown",
    "SaysWhyUntold",
    "Sweep",
    "TriesOutputs",
    "Vector",
    "Vehicle",
    "VehicleState",
    "why_untold",
]
