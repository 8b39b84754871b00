"""How every device is: connected, who it is, figures with their limits, errors, state. One's failure hides no other."""

import math
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from cell.config.cell_config import DEVICES, CellConfig, config_to_open, require_real_addresses
from cell.devices import assembly
from cell.devices.lock import CellLock
from cell.devices.simulated.mixed import Sim, simulated_of
from cell.devices.simulated.process import SimulatedCell, on_gige, with_endpoints
from drivers import interfaces
from drivers.clock import Clock
from drivers.errors import CellError, ConfigError, InterlockError

WATCHED_S = 1.0
LONGEST_TRIP_MS = {"arm": 100.0, "rail": 50.0, "vehicle": 100.0, "camera": 20.0, "laser": 100.0, "claw": 100.0}
"""By kind: what the cell has time for. A rail is asked for its position all along a sweep, a camera for its clock."""
LARGEST_TIME_BOUND_S = 0.001
"""0.02 mm of a sweep at 20 mm/s."""
MOST_UNEVEN = 1.5
"""Times the median: a frame that comes later than this is as good as lost."""
_LEAST_FRAMES = 3
_FRAMES_MISSED = (
    "Use a cable of its own, for GigE with packets of 9000 bytes; lower the frame rate or the region; end programs "
    "that keep this computer busy."
)


def examine(kind: str, device: interfaces.Device, trips_s: Sequence[float], clock: Clock) -> list[interfaces.Reading]:
    """Figures of a device of this kind whose round trips took `trips_s`, wall seconds. It is only looked at. On a clock
    that is not the wall's, times have no limits: a simulated cell in a hurry is no measure."""
    median, p99 = (1e3 * float(value) for value in np.percentile(trips_s, [50, 99]))
    judged = clock.rate <= 1.0
    found = [
        interfaces.Reading("round trip, median", median, "ms"),
        interfaces.Reading(
            "round trip, p99", p99, "ms", most=LONGEST_TRIP_MS[kind] if judged else None,
            remedy="Look at cable and adapter, and end programs that keep this computer busy.",
        ),
    ]  # fmt: skip
    if isinstance(device, interfaces.Examined):
        found += device.examine(WATCHED_S)
    if kind == "camera":
        found += _camera_figures(cast(interfaces.Camera, device), clock, judged)
    return found


def _camera_figures(camera: interfaces.Camera, clock: Clock, judged: bool) -> list[interfaces.Reading]:
    """Of a short stream at the rate that the camera has; none of one that has to be set before it gives pictures."""
    frames: list[interfaces.Frame] = []
    try:
        with camera.stream() as stream:
            begun = clock.now()
            while len(frames) < _LEAST_FRAMES or clock.now() - begun < WATCHED_S:
                frames.append(stream.next(2.0))
            lost = stream.lost
    except InterlockError:
        return []
    return stream_figures([frame.device_time for frame in frames], lost, camera.time_bound, judged)


def stream_figures(
    device_times: Sequence[float], lost: int, time_bound: float, judged: bool
) -> list[interfaces.Reading]:
    """Figures of frames with these device times, s, of which `lost` more were missed."""
    gaps = np.diff(device_times)
    median = float(np.median(gaps))
    uneven = float(np.percentile(gaps, 99)) / median if median > 0 else np.nan
    return [
        interfaces.Reading("frame rate by its clock", 1.0 / median if median > 0 else np.nan, "Hz"),
        interfaces.Reading(
            "longest frame period over the median, p99", uneven, "", most=MOST_UNEVEN if judged else None,
            remedy=_FRAMES_MISSED,
        ),
        interfaces.Reading("frames lost", float(lost), "", most=0.0 if judged else None, remedy=_FRAMES_MISSED),
        interfaces.Reading(
            "clock known to", 1e3 * time_bound, "ms", most=1e3 * LARGEST_TIME_BOUND_S if judged else None,
            remedy="Use a cable of its own, and end programs that keep this computer busy.",
        ),
    ]  # fmt: skip


PINGS = 100


@dataclass
class Diagnosis:
    """One device's row. Round trips in ms on the wall. `ok`: it answers, and no figure is outside its limits."""

    device: str
    ok: bool
    address: str
    model: str = ""
    serial: str = ""
    firmware: str = ""
    p50_ms: float | None = None
    p99_ms: float | None = None
    errors: dict[str, int] = field(default_factory=dict)
    state: str = ""
    simulated: bool = False
    readings: list[interfaces.Reading] = field(default_factory=list)

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        told = asdict(self)
        for row, reading in zip(told["readings"], self.readings, strict=True):
            row["value"] = reading.value if math.isfinite(reading.value) else None
            row["ok"] = reading.ok
        return told


def diagnose(
    path: Path | None, only: Collection[str] = (), *, sim: Sim, seed: int, level: str, speed: float
) -> list[Diagnosis]:
    """Look at each device in turn, or at `only` those: nothing on them is set, started or ended. Raises only for a
    wrong configuration, an unknown device, or devices that another process holds."""
    _require_known(only)
    names = simulated_of(sim, path)
    whole = set(names) == set(DEVICES)
    _, config = config_to_open(path, simulated=whole)
    if not whole:
        require_real_addresses(config, names)
    wanted = [name for name in DEVICES if not only or name in only]
    # What hangs on the arm is looked at where the arm is.
    on_arm = [name for name in names if config.make(name).on_arm and "arm" not in names]
    needed = assembly.connected_for(config, [name for name in wanted if name not in on_arm])
    if not (served := [name for name in names if name in needed]):
        return _diagnose(config, only)
    from cell.devices.simulated.described import Described

    # Looked at only, so it follows nothing: its pictures are of where its own devices stand.
    world = SimulatedCell(
        config, Described.of("pot"), seed=seed, level=level, speed=speed if whole else config.cell.time_scale,
        gige=[name for name in on_gige(config) if name in names], simulated=names,
    )  # fmt: skip
    with closing(world):
        rows = _diagnose(with_endpoints(config, world.endpoints, names if whole else served), only)
    for row in rows:
        row.simulated = row.device in names
        if row.device in on_arm:
            row.state = f"{row.state}; what is shown is the real arm's output, the {row.device} is to be simulated"
    return rows


def _require_known(only: Collection[str]) -> None:
    if unknown := [name for name in only if name not in DEVICES]:
        raise ConfigError(f"there is no device {', '.join(unknown)}; the devices are {', '.join(DEVICES)}")


def _diagnose(config: CellConfig, only: Collection[str]) -> list[Diagnosis]:
    clock = Clock(config.cell.time_scale)
    wanted = [name for name in STATES if not only or name in only]
    needed = assembly.connected_for(config, wanted)
    rows: list[Diagnosis] = []
    with CellLock(config, needed), ExitStack() as opened:
        arm: interfaces.Arm | None = None
        for name in (name for name in STATES if name in needed):
            record = config.device(name)
            if config.make(name).on_arm and arm is None:
                rows.append(Diagnosis(name, False, record.place, state="the arm that it hangs on is not connected"))
                continue
            try:
                device = assembly.connect_one(config, name, clock, arm=arm, look=True)
            except CellError as error:
                row = Diagnosis(name, False, record.place, state=str(error))
            else:
                if not config.make(name).on_arm:
                    opened.callback(device.close)
                arm = device if name == "arm" else arm
                row = ask(name, record.place, device, clock)
            if name in wanted:
                rows.append(row)
    return rows


def ask(name: str, address: str, device: interfaces.Device, clock: Clock) -> Diagnosis:
    """The row of a device that is connected; not behind a gate."""
    row = Diagnosis(name, False, address)
    try:
        identity = device.identity()
        row.model, row.serial, row.firmware = identity.model, identity.serial, identity.firmware
        trips = [device.ping() for _ in range(PINGS)]
        row.p50_ms, row.p99_ms = (1e3 * float(v) for v in np.percentile(trips, [50, 99]))
        row.state = STATES[name](device)
        row.readings = examine(DEVICES[name], device, trips, clock)
        row.ok = all(reading.ok for reading in row.readings)
    except CellError as error:
        row.state = str(error)
    row.errors = dict(device.statistics.errors)
    return row


def _arm_state(arm: interfaces.Arm) -> str:
    state, table = arm.state(), arm.link_table()
    why = f" ({reason})" if (reason := interfaces.why_untold(arm)) else ""
    own = f"own kinematics not told{why}" if table is None else f"own kinematics {table.hash()}"
    return f"{state.safety.value}, joints {', '.join(f'{math.degrees(q):.1f}' for q in state.joints)} deg, {own}"


def _rail_state(rail: interfaces.Rail) -> str:
    state = rail.state()
    return f"{'homed' if state.homed else 'not homed'}, at {1e3 * state.position:.2f} mm"


def _vehicle_state(vehicle: interfaces.Vehicle) -> str:
    state = vehicle.state()
    if state.emergency_stop:
        return "emergency stop"
    # The brake's feedback is not on the bus.
    brake = {None: "brake unknown", True: "braked", False: "brake open"}[state.braked]
    errors = "; ".join(state.trouble) or f"errors {state.error_bits:#06x}"
    volts = "" if state.battery_volts is None else f"{state.battery_volts:.1f} V, "
    return f"{brake}, {volts}{errors}"


def _camera_state(camera: interfaces.Camera) -> str:
    try:
        frame = camera.grab()
    except InterlockError:
        # To take a picture, some have to be held and set.
        return f"{camera.shape[1]}×{camera.shape[0]} configured; no picture, because it is only looked at"
    return f"frame {frame.frame_id}, {camera.shape[1]}×{camera.shape[0]}, mean {frame.image.mean():.0f} DN"


def _laser_state(laser: interfaces.Laser) -> str:
    how = laser.how_known if isinstance(laser, interfaces.SaysHowKnown) else ""
    # What nobody can ask, a look that sends nothing cannot know.
    return f"not known now; {how}" if how else "ON" if laser.is_on else "off"


STATES: dict[str, Callable[[Any], str]] = {
    "arm": _arm_state, "rail": _rail_state, "vehicle": _vehicle_state, "scan_camera": _camera_state,
    "target_camera": _camera_state, "laser": _laser_state,
    "claw": lambda claw: "holds a part" if claw.holding else "empty",
}  # fmt: skip
"""The devices in the order in which they are asked, and how each tells its state in words."""
