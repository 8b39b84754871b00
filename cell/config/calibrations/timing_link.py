"""Whether a timing still holds for the camera and the rail as they are configured now."""

from __future__ import annotations

from cell.config.cell_config import CellConfig
from cell.makes.records import CameraConfig, DeviceConfig, RailConfig
from cell.measure.calibration.timing import StampTiming

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
