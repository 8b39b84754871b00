"""Figures of `cell diag` against closed forms: what is outside of its limit is told, and nothing else."""

import math
import struct

import can
import numpy as np
import pytest

from cell.devices.diagnosis.diagnosis import Diagnosis, stream_figures
from drivers.arm.health import Watched
from drivers.arm.health import readings as arm_readings
from drivers.interfaces import Reading
from drivers.rail.tmcl.module import readings as rail_readings
from drivers.vehicle.agilex_link import load_database
from drivers.vehicle.health import CanInterface
from drivers.vehicle.health import readings as vehicle_readings


def outside(found: list[Reading]) -> list[str]:
    return [reading.what for reading in found if not reading.ok]


def named(found: list[Reading], what: str) -> float:
    return next(reading.value for reading in found if reading.what == what)


def watched(ppm: float = 0.0, late: float = 0.0, lost: int = 0, volts: float = 48.0, hot: float = 40.0) -> Watched:
    """A second of an arm's states 2 ms apart, `late` s at most on their way; its clock is `ppm` fast."""
    ways = np.random.default_rng(5).uniform(0.0, late, 500) if late else np.zeros(500)
    host = 0.002 * np.arange(500)
    kept = np.r_[0:100, 100 + lost : 500]
    return Watched((host + ways)[kept], (7000.0 + host * (1.0 + 1e-6 * ppm))[kept], volts, (30.0, hot, 30.0))


def test_an_arm_that_is_well_has_nothing_outside():
    found = arm_readings(watched(ppm=50.0), judge_times=True)
    assert outside(found) == []
    assert named(found, "state period by its clock, median") == pytest.approx(2.0, rel=1e-4)
    assert named(found, "clock against this computer's") == pytest.approx(50.0, abs=1.0)


@pytest.mark.parametrize(
    ("states", "what"),
    [
        (watched(ppm=3000.0), "clock against this computer's"),
        (watched(ppm=-3000.0), "clock against this computer's"),
        (watched(late=0.030), "state period on arrival, p99"),
        (watched(lost=20), "states missing"),
        (watched(volts=40.0), "supply"),
        (watched(volts=math.nan), "supply"),
        (watched(hot=90.0), "hottest joint"),
    ],
)
def test_each_trouble_of_an_arm_is_told_with_a_remedy(states: Watched, what: str):
    found = arm_readings(states, judge_times=True)
    assert what in outside(found)
    assert all(reading.remedy for reading in found if not reading.ok)


def test_times_of_a_cell_in_a_hurry_are_shown_but_have_no_limit():
    found = arm_readings(watched(ppm=3000.0, late=0.030, lost=20), judge_times=False)
    assert outside(found) == []
    assert named(found, "states missing") == pytest.approx(100 * 20 / 499, rel=1e-6)


def heard(period: float = 0.020, charge: int = 80, motor: int = 40) -> list[tuple[float, can.Message]]:
    """A second of a vehicle's frames, packed by the protocol's layout and not by its table."""
    frames = [(k * period, can.Message(arbitration_id=0x221, data=bytes(8), is_extended_id=False)) for k in range(50)]
    battery = struct.pack(">BBhhh", charge, 100, 264, 0, 251)
    driver = struct.pack(">HhbBxx", 264, 35, motor, 0x40)
    slow = [(0x361, battery), (0x262, driver), (0x211, struct.pack(">BBHHxB", 0, 1, 258, 0, 3))]
    return frames + [(0.5, can.Message(arbitration_id=i, data=data, is_extended_id=False)) for i, data in slow]


def vehicle(frames: list[tuple[float, can.Message]], interface: CanInterface | None = None) -> list[Reading]:
    return vehicle_readings(frames, 1.0, 500_000, load_database(), interface, judge_times=True)


def test_a_vehicles_voltages_temperatures_and_bus_load_are_read():
    found = vehicle(heard())
    assert outside(found) == []
    assert (named(found, "battery"), named(found, "charge")) == (pytest.approx(25.8), 80)
    assert named(found, "battery's temperature") == pytest.approx(25.1)
    assert named(found, "hottest motor or its driver") == 40
    # A standard frame of 8 bytes has 108 bits, at most 24 stuffed ones, and 3 of pause.
    assert named(found, "bus load, at most") == pytest.approx(100 * 53 * (108 + 24 + 3) / 500_000)


def test_each_trouble_of_a_vehicle_and_its_bus_is_told():
    error = [(0.1, can.Message(is_error_frame=True))]
    crowd = [(0.1, can.Message(arbitration_id=0x7, data=bytes(8), is_extended_id=False))] * 3000
    assert outside(vehicle(heard(period=0.1))) == ["feedback period, p99"]
    assert outside(vehicle(heard(charge=10))) == ["charge"]
    assert outside(vehicle(heard(motor=95))) == ["hottest motor or its driver"]
    assert outside(vehicle(heard() + error)) == ["error frames"]
    assert outside(vehicle(heard() + crowd)) == ["bus load, at most"]
    assert outside(vehicle([])) == ["feedback period, p99"]
    passive = CanInterface("can0", True, 500_000, "ERROR-PASSIVE", 128, 3)
    assert outside(vehicle(heard(), passive)) == ["error counter, sending"]


def test_alarms_of_a_rails_module_are_told_and_its_open_load_and_standstill_are_none():
    assert outside(rail_readings(0b1110_0001)) == []
    assert outside(rail_readings(0b0000_0010)) == ["driver too hot"]
    assert outside(rail_readings(0b0001_0000)) == ["short circuit of the motor"]


def test_frames_that_are_lost_late_or_badly_timed_are_told():
    even = [0.1 * k for k in range(20)]
    found = stream_figures(even, 0, 0.0001, judged=True)
    assert outside(found) == []
    assert named(found, "frame rate by its clock") == pytest.approx(10.0)
    assert outside(stream_figures(even, 1, 0.0001, judged=True)) == ["frames lost"]
    assert outside(stream_figures(even, 0, 0.004, judged=True)) == ["clock known to"]
    assert outside(stream_figures([*even, 2.4], 0, 0.0001, judged=True)) == [
        "longest frame period over the median, p99"
    ]


def test_a_figure_that_is_not_a_number_is_null_in_json():
    told = Diagnosis("arm", False, "", readings=[Reading("supply", math.nan, "V", 43.0, 53.0, "Measure it.")]).as_dict()
    assert (told["readings"][0]["value"], told["readings"][0]["ok"]) == (None, False)
