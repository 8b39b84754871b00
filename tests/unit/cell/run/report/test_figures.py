"""Figures for journals, reports and people are what was measured, in the unit that their names say.

All lengths here are round in m and all angles in rad, so that every figure is written down rather than computed.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from cell.measure.calibration.drift.decision import Figure, Suspect
from cell.measure.calibration.drift.reference_plate import ConfirmedTurn, Pointing
from cell.measure.calibration.drift.slip import Slip, WitnessCheck
from cell.measure.calibration.drift.timing import Shutter, StampTiming
from cell.measure.reconstruction.cloud import Seam
from cell.procedures.arm.touch import TouchCheck, TouchHeight
from cell.procedures.steps.drive_to_target import VehicleArrival
from lab.bench.job.whole_job import JobRecord

SPREAD = np.diag(np.square([0.1e-3, 0.2e-3, 0.3e-3, 0.4e-3, 0.5e-3, 0.6e-3]))
SIGMAS = {"sigma_mm": [0.1, 0.2, 0.3], "sigma_mrad": [0.4, 0.5, 0.6]}


def shown(made: dict[str, Any], expected: dict[str, Any]) -> None:
    assert {name: made[name] for name in expected} == expected


def test_a_photographs_figures(placed_pot: JobRecord):
    fix = replace(
        placed_pot.results["board_photo"], residual_px=0.12, obliquity=math.pi / 6, covariance=SPREAD, swung=0.02e-3
    )
    shown(fix.summary(), {"residual_px": 0.12, "obliquity_deg": 30.0, "swung_mm": 0.02, **SIGMAS})


def test_an_arrivals_figures(placed_pot: JobRecord):
    arrival = replace(
        placed_pot.results["drive_to_target"], error_along=3e-3, error_across=-2e-3, error_yaw=math.radians(0.5)
    )
    shown(arrival.summary(), {"error_along_mm": 3.0, "error_across_mm": -2.0, "error_yaw_deg": 0.5})
    assert "driven" not in arrival.summary()
    still = VehicleArrival(pin.SE3.Identity(), arrival.fix, 3e-3, -2e-3, math.radians(0.5), 1, driven=False)
    assert still.summary()["driven"] is False
    assert "3.0 mm along, -2.0 mm across and 0.50 deg" in still.words()


def test_a_sweeps_figures(placed_pot: JobRecord):
    sweep = placed_pot.results["laser_sweep"]
    (swath,) = sweep.swaths
    sweep = replace(
        sweep,
        swaths=(replace(swath, residual=1.5e-6, shift=2.5e-6, lost=3),) * 2,
        pointing=Pointing(0.2e-3, 0.01e-3, 0.15e-3),
        slip=Slip(0.04e-3, -0.03e-3, 2e-3),
    )
    shown(sweep.summary(), {
        "sweeps": 2, "profiles": 2 * len(swath.lines), "points": 2 * swath.points, "lost_frames": 6,
        "residual_um": [1.5, 1.5], "time_shift_um": [2.5, 2.5], "laser_turned_mrad": 0.2,
        "laser_confirmed_mrad": 0.15, "head_slipped_um": [40.0, -30.0], "pictures_later_ms": 2.0,
    })  # fmt: skip
    assert sweep.slip is not None and sweep.slip.size == pytest.approx(0.05e-3)
    hidden = replace(sweep, slip=replace(sweep.slip, hidden=True))
    assert any("across the rail is not seen" in note for note in hidden.notes)
    unseen = replace(sweep, pointing=None, slip=None, doubts=("nobody looked",))
    assert unseen.notes == ("nobody looked",)
    shown(unseen.summary(), dict.fromkeys(("laser_turned_mrad", "laser_confirmed_mrad", "head_slipped_um"), None))
    assert unseen.summary()["pictures_later_ms"] is None
    assert "+0.200 ± 0.010 mrad" in sweep.pointing.words and "+0.150 mrad were seen" in sweep.pointing.words


def test_a_clouds_and_a_places_figures(placed_pot: JobRecord):
    cloud = placed_pot.results["reconstruct"].cloud
    measured = int(np.isfinite(cloud.points[:, :, 0]).sum())
    shown(cloud.summary(), {
        "lines": len(cloud.points), "points": measured, "rejected": int(cloud.rejected.sum()),
        "interpolated": len(cloud.filled.lines),
    })  # fmt: skip
    place = replace(
        placed_pot.results["invert_pose"],
        rms=0.012e-3, chi2_per_dof=1.1, n_points=900, share=0.98, coverage=0.97, parts_differ=0.05, covariance=SPREAD,
        correction=np.array([1e-3, -2e-3, 3e-3, 4e-3, -5e-3, 6e-3]),
    )  # fmt: skip
    shown(place.summary(), {
        "points": 900, "rms_mm": 0.012, "chi2_per_dof": 1.1, "share": 0.98, "coverage": 0.97, "parts_differ": 0.05,
        "correction_mm": [1.0, -2.0, 3.0], "correction_mrad": [4.0, -5.0, 6.0], **SIGMAS,
    })  # fmt: skip
    seam = Seam(0, 1, 77, 0.01e-3, 0.02e-3, 0.03e-3, 0.04e-3, 0.05e-3)
    assert seam.as_dict() == {
        "sweeps": [0, 1], "points": 77, "mean_mm": 0.01, "rms_mm": 0.02, "p95_mm": 0.03, "expected_mean_mm": 0.04,
        "expected_rms_mm": 0.05,
    }  # fmt: skip


def test_what_the_part_felt(placed_pot: JobRecord):
    touch = TouchCheck(TouchHeight(0.05e-3, 0.03e-3), TouchHeight(-0.01e-3, 0.04e-3))
    assert touch.as_dict() == {"felt_mm": 0.05, "expected_mm": -0.01, "off_mm": 0.06, "sigma_mm": 0.05}
    result = replace(placed_pot.results["place"], depth_error=-0.02e-3, touch=touch)
    shown(result.summary(), {"contact": True, "depth_error_mm": -0.02, "touch": touch.as_dict()})
    told = np.array(result.summary()["base_from_flange"])
    assert told[:3] == pytest.approx(result.base_from_flange.translation, abs=1e-6)
    assert pin.exp3(told[3:]) == pytest.approx(result.base_from_flange.rotation, abs=1e-5)


def test_what_is_known_of_times_and_of_the_laser():
    link = {"scan_camera.driver": "stream"}
    assert Shutter(0.5e-3, 0.01e-3, link).summary() == {"readout_ms": 0.5, "sigma_ms": 0.01}
    shown(StampTiming(1.5e-3, 0.05e-3, 8e-6, 1e-6, 0.4e-3, 0.02e-3, 0.25, 0.0, link).summary(), {
        "late_ms": 1.5, "sigma_ms": 0.05, "play_um": 8.0, "play_sigma_um": 1.0, "readout_ms": 0.4,
        "readout_sigma_ms": 0.02, "late_per_exposure": 0.25,
    })  # fmt: skip
    shown(
        ConfirmedTurn(0.3e-3, 0.2e-3, 0.01e-3, 0.0).summary(),
        {"turned_mrad": 0.2, "sigma_mrad": 0.01, "plate_mrad": 0.3},
    )
    shown(
        WitnessCheck(Pointing(0.3e-3, 0.02e-3), Pointing(0.2e-3, 0.01e-3), np.zeros(27)).as_dict(),
        {"plate_mrad": 0.3, "board_mrad": 0.2, "plate_sigma_mrad": 0.02, "board_sigma_mrad": 0.01},
    )


def test_what_a_verification_suspects():
    change = np.zeros(27)
    change[:9] = 1.5, -1.0, 0.5, 0.25, 0.01, 0.02, 0.001, -0.002, 0.03
    change[9:21] = 1e-3 * np.arange(1, 13)
    suspect = Suspect("scan", "camera mount", 0.875, change, np.zeros((27, 0)))
    shown(suspect.as_dict(), {"part": "camera mount", "probability": 0.875})
    assert suspect.as_dict()["change"] == {
        "fx_px": 1.5, "fy_px": -1.0, "cx_px": 0.5, "cy_px": 0.25,
        "k1": 0.01, "k2": 0.02, "p1": 0.001, "p2": -0.002, "k3": 0.03,
        "plane_tilt_a_mrad": 1.0, "plane_tilt_b_mrad": 2.0, "plane_distance_mm": 3.0,
        "rail_x_per_mille": 4.0, "rail_y_per_mille": 5.0, "rail_z_per_mille": 6.0,
        "hand-eye_x_mm": 7.0, "hand-eye_y_mm": 8.0, "hand-eye_z_mm": 9.0,
        "hand-eye_rx_mrad": 10.0, "hand-eye_ry_mrad": 11.0, "hand-eye_rz_mrad": 12.0,
    }  # fmt: skip
    assert Figure("dots", 0.25, 0.125, "px").as_dict() == {"name": "dots", "value": 0.25, "sigma": 0.125, "unit": "px"}


def test_a_calibrations_figures(placed_pot: JobRecord):
    calibration = placed_pot.calibration
    told, scan = calibration.summary(), calibration.scan
    direction = scan.rail_direction
    assert told["light_plane"]["distance_mm"] == pytest.approx(1e3 * scan.light_plane.distance, abs=1e-4)
    assert told["light_plane"]["normal"] == pytest.approx(list(scan.light_plane.normal), abs=1e-7)
    assert told["rail"]["scale"] == pytest.approx(math.sqrt(float(direction @ direction)), abs=1e-6)
    assert told["rail"]["direction"] == pytest.approx(list(direction / told["rail"]["scale"]), abs=2e-6)
