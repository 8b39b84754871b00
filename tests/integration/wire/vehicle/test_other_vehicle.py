"""The vehicle's driver against a vehicle that nobody of this project's simulator has written."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Literal

import pytest

from drivers.clock import Clock
from drivers.errors import DeadlineError, DeviceFault, NotConnectedError
from drivers.vehicle.agilex import AgilexVehicle
from tests.support import until
from tests.support.wire.other_vehicle import OtherVehicle

pytestmark = pytest.mark.wire


def connect(peer: OtherVehicle) -> AgilexVehicle:
    return AgilexVehicle(
        "vehicle", peer.interface, peer.channel, track=0.58, max_speed=0.5, max_yaw_rate=0.8, clock=Clock()
    )


def faulted(driver: AgilexVehicle, seconds: float = 3.0) -> DeviceFault:
    """The fault that a driving program meets."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            driver.drive(0.1, 0.0)
        except DeviceFault as fault:
            return fault
        time.sleep(0.02)
    raise AssertionError("no fault")


@pytest.fixture
def peer() -> Iterator[OtherVehicle]:
    peer = OtherVehicle()
    yield peer
    peer.close()


@pytest.fixture
def driver(peer: OtherVehicle) -> Iterator[AgilexVehicle]:
    driver = connect(peer)
    yield driver
    driver.close()


@pytest.mark.parametrize(
    ("versions", "firmware"),
    [("sdk", "HW V1.2 SW V3.4 20240105"), ("manual", "hardware 2/1, controller 260, drivers 9"), ("none", "unknown")],
)
def test_its_version_is_told_however_it_answers_and_not_answering_is_no_fault(
    versions: Literal["sdk", "manual", "none"], firmware: str
) -> None:
    peer = OtherVehicle(versions)
    driver = connect(peer)
    try:
        identity = driver.identity()
        assert (identity.model, identity.firmware) == ("AgileX v2", firmware)
        assert 0.0 < driver.ping() < 0.5
        assert driver.statistics.errors == {}
        driver.enable()
        driver.check()
    finally:
        driver.close()
        peer.close()


def test_a_speed_that_wavers_by_three_millimetres_a_second_is_standstill(
    peer: OtherVehicle, driver: AgilexVehicle
) -> None:
    driver.enable()
    driver.drive(0.3, 0.0)
    assert until(lambda: driver.state().speed > 0.29, 3.0)
    driver.stop()
    assert abs(driver.state().speed) <= 0.003
    for _ in range(8):
        driver.stop()
    driver.brake()
    assert until(lambda: peer.braked, 3.0)
    driver.check()


def test_a_vehicle_that_really_creeps_does_not_stand(peer: OtherVehicle, driver: AgilexVehicle) -> None:
    driver.enable()
    peer.noisy = False
    assert until(lambda: driver.state().speed == 0.0, 3.0)
    peer.lost = {0x221}
    with pytest.raises(DeadlineError, match="standstill"):
        driver.stop()
    peer.lost = set()


@pytest.mark.parametrize(("lost", "name"), [(0x221, "MotionState"), (0x311, "Odometry"), (0x211, "SystemState")])
def test_one_message_that_stays_away_is_silence_and_is_named(
    peer: OtherVehicle, driver: AgilexVehicle, lost: int, name: str
) -> None:
    driver.enable()
    peer.lost = {lost}
    fault = faulted(driver)
    assert fault.code == "vehicle.silent"
    assert name in str(fault)
    with pytest.raises(DeadlineError):
        driver.state()
    peer.lost = set()


def test_frames_of_another_length_are_not_read_and_are_told(peer: OtherVehicle) -> None:
    peer.short = {0x311}
    with pytest.raises(NotConnectedError, match=r"Odometry did not come; \d+ frames had another length"):
        connect(peer)


def test_what_other_nodes_send_is_not_the_vehicles(peer: OtherVehicle, driver: AgilexVehicle) -> None:
    peer.crowded = True
    driver.enable()
    for _ in range(40):
        driver.drive(0.2, 0.0)
        time.sleep(0.02)
    state = driver.state()
    assert state.speed == pytest.approx(0.2, abs=0.004)
    assert 0.02 < state.x < 0.3 and abs(state.y) < 0.01
    assert state.interruptions == 0 and not state.emergency_stop
    readings = {row.what: row for row in driver.examine(0.5)}
    assert readings["charge"].value == 12 and readings["battery's temperature"].value == pytest.approx(25.3)
    assert "hottest motor or its driver" not in readings
    assert not readings["error frames"].ok
    driver.stop()
    driver.brake()
    driver.check()


@pytest.mark.parametrize("mode", [0, pytest.param(2, marks=pytest.mark.campaign), 3])
def test_a_person_at_the_remote_control_is_in_charge_whatever_mode_the_model_reports(
    peer: OtherVehicle, driver: AgilexVehicle, mode: int
) -> None:
    driver.enable()
    peer.under_remote_control, peer.mode = True, mode
    assert faulted(driver).code == "vehicle.command_lost"
    with pytest.raises(DeadlineError, match="remote control"):
        driver.enable()


def test_an_emergency_stop_and_an_error_bit_are_faults_and_a_low_battery_is_a_warning(
    peer: OtherVehicle, driver: AgilexVehicle
) -> None:
    driver.enable()
    peer.errors = 0x0002 | 0x0004
    assert until(lambda: driver.state().warnings, 3.0)
    assert driver.state().warnings == ("the battery is low", "no signal of the remote control")
    driver.drive(0.1, 0.0)
    peer.errors = 0x0001
    assert "battery's voltage is too low" in str(faulted(driver))
    peer.errors, peer.state = 0, 1
    assert until(lambda: driver.state().emergency_stop, 3.0)
    with pytest.raises(DeviceFault, match="emergency stop") as met:
        driver.check()
    assert not met.value.recoverable
