"""The vehicle's message table against the protocol's byte layout, and odometry against geometry."""

import math
import struct

import pytest
from cantools.database.can import Database

from drivers.vehicle.agilex_link import load_database
from drivers.vehicle.feedback import PlanarOdometry

TRACK = 0.583


@pytest.fixture(scope="module")
def database() -> Database:
    return load_database()


def test_every_identifier_of_the_protocol_is_there(database: Database):
    identifiers = {message.frame_id for message in database.messages}
    motors = {0x250 + i for i in range(1, 9)} | {0x260 + i for i in range(1, 9)}
    commands = {0x421, 0x111, 0x131, 0x141, 0x441, 0x411}
    assert identifiers == motors | commands | {0x41A, 0x4A1, 0x211, 0x221, 0x311, 0x361}
    assert not any(message.is_extended_frame for message in database.messages)


@pytest.mark.parametrize(
    ("speed", "yaw_rate", "data"),
    [
        (0.15, 0.0, "00 96 00 00 00 00 00 00"),
        (-0.15, 0.2, "ff 6a 00 c8 00 00 00 00"),
        (1.5, -1.0, "05 dc fc 18 00 00 00 00"),
    ],
)
def test_velocity_commands_are_big_endian_milli_units(database: Database, speed: float, yaw_rate: float, data: str):
    signals = {"Speed": speed, "YawRate": yaw_rate, "LateralSpeed": 0.0, "Steering": 0.0}
    assert database.encode_message("MotionCommand", signals) == bytes.fromhex(data)


def test_feedback_is_read_at_its_places(database: Database):
    def decoded(identifier: int, data: bytes) -> dict[str, float]:
        return dict(database.decode_message(identifier, data, decode_choices=False))  # type: ignore[arg-type]

    system = decoded(0x211, struct.pack(">BBHHxB", 2, 1, 264, 0x8001, 77))
    assert system == pytest.approx({"State": 2, "Mode": 1, "BatteryVoltage": 26.4, "ErrorBits": 0x8001, "Count": 77})
    motion = decoded(0x221, struct.pack(">hhhh", -1234, 567, -8, 9))
    assert motion == pytest.approx({"Speed": -1.234, "YawRate": 0.567, "LateralSpeed": -0.008, "Steering": 0.009})
    assert decoded(0x311, struct.pack(">ii", -2_000_000, 2_000_001)) == {"Left": -2_000_000, "Right": 2_000_001}
    assert decoded(0x251, struct.pack(">hhi", -60, 25, -4096)) == pytest.approx(
        {"Speed": -60, "Current": 2.5, "Pulses": -4096}
    )
    assert decoded(0x268, struct.pack(">HhbBxx", 264, -5, -6, 7)) == pytest.approx(
        {"Voltage": 26.4, "DriverTemperature": -5, "MotorTemperature": -6, "DriverStatus": 7}
    )
    assert decoded(0x361, struct.pack(">BBhhh", 87, 99, 264, -15, 253)) == pytest.approx(
        {"StateOfCharge": 87, "StateOfHealth": 99, "Voltage": 26.4, "Current": -1.5, "Temperature": 25.3}
    )
    for answer in (0x41A, 0x4A1):
        assert decoded(answer, struct.pack(">4H", 2, 1, 204, 110)) == {
            "ControllerHardware": 2,
            "DriverHardware": 1,
            "ControllerSoftware": 204,
            "DriverSoftware": 110,
        }


def test_odometry_follows_a_circle_back_to_its_start():
    odometry = PlanarOdometry(TRACK)
    radius, steps = 1.0, 2000
    for step in range(steps + 1):
        angle = 2.0 * math.pi * step / steps
        left, right = (round(1000.0 * angle * (radius + side * TRACK / 2.0)) for side in (-1, 1))
        assert odometry.update(left, right, farthest=0.1)
        if step == steps // 2:
            assert (odometry.x, odometry.y) == pytest.approx((0.0, 2.0 * radius), abs=0.002)
            assert odometry.yaw == pytest.approx(math.pi, abs=0.002)
    assert (odometry.x, odometry.y) == pytest.approx((0.0, 0.0), abs=0.004)
    assert odometry.yaw == pytest.approx(2.0 * math.pi, abs=0.004)


def test_odometers_may_wrap():
    odometry = PlanarOdometry(TRACK)
    odometry.update(2**31 - 10, 2**31 - 10, farthest=0.1)
    assert odometry.update(-(2**31) + 10, -(2**31) + 10, farthest=0.1)
    assert (odometry.x, odometry.y, odometry.yaw) == pytest.approx((0.020, 0.0, 0.0))


def test_a_restarted_vehicle_does_not_throw_the_odometry_about():
    odometry = PlanarOdometry(TRACK)
    odometry.update(50_000, 50_000, farthest=0.1)
    assert odometry.update(50_050, 50_050, farthest=0.1) and not odometry.update(0, 0, farthest=0.1)
    assert odometry.update(10, 10, farthest=0.1)
    assert odometry.x == pytest.approx(0.060)
