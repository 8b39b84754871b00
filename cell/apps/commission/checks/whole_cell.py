"""The cell as a whole. First, before anything moves: every device answers, is who it should be, and is well.

The last four: calibration, its verification, the first job without a part up to the place, and the first part."""

import math
from functools import partial

from cell.apps.commission.check import CommissionCheck, Result
from cell.apps.commission.workplace import CommissionWorkplace
from cell.config.cell_config import DEVICES
from cell.devices.diagnosis.diagnosis import STATES, ask
from drivers.errors import CalibrationStale, RefusedError

WHERE = tuple(
    f"{name}.{key}" for name in DEVICES for key in ("driver", "address", "url", "channel", "interface", "model", "baud")
)
"""What tells who is connected, and where, whatever the make."""


def _links(workplace: CommissionWorkplace, result: Result) -> None:
    devices, config = workplace.devices, workplace.cell.config
    for name in STATES:
        device = getattr(devices, name)
        row = ask(name, config.device(name).place, getattr(device, "bare", device), devices.clock)
        who = " ".join(part for part in (row.model, row.serial, row.firmware) if part)
        result.notes.append(f"{name} ({DEVICES[name]}): {who or 'no identity'}, {row.state}")
        result.require(f"{name} answers and is well", row.ok, f"See `cell diag --device {name}`.")
        for reading in row.readings:
            if not reading.ok:
                result.measure(
                    f"{name}: {reading.what}", reading.value, reading.unit, least=reading.least, most=reading.most,
                    remedy=reading.remedy,
                )  # fmt: skip
    question = "Is the emergency stop within reach, the cell's surroundings clear, and nothing in the claw's way?"
    result.require("a person has looked round", workplace.person.sees(question))


BEFORE_PLACING = "invert_pose"
ALL = ("rail", "arm", "vehicle", "scan_camera", "target_camera", "laser", "claw", "calibration")


def _as_configured(workplace: CommissionWorkplace) -> None:
    """A person's word before arm and rail move as in a job, and the vehicle braked."""
    arm = workplace.config.arm
    fast = f"at most {math.degrees(arm.max_joint_speed):.0f} deg/s and {1e3 * arm.max_tool_speed:.0f} mm/s"
    workplace.confirm("the arm as a whole", "planned ways above the deck", "up to its whole reach", fast)
    workplace.confirm("rail", "the carriage", "its whole travel", "its configured speed")
    workplace.confirm("laser", "laser goggles on", "at each view", "on and off")
    workplace.brake()


def _calibrate(workplace: CommissionWorkplace, result: Result) -> None:
    _as_configured(workplace)
    try:
        calibration = workplace.cell.calibration()
        result.notes.append("a calibration of this cell as it is configured was stored already")
    except CalibrationStale:
        calibration = workplace.cell.calibrate(workplace.heard, workplace.job_file)
    summary = calibration.summary()
    result.notes.append(f"stored as {calibration.name} in {workplace.cell.calibrations_folder.name}/")
    scan, target = (
        workplace.config.scan_camera.flange_from_camera.se3(),
        workplace.config.target_camera.flange_from_camera.se3(),
    )
    for name, found, drawn in (
        ("scan_camera", calibration.scan.flange_from_camera_at(0.0), scan),
        ("target_camera", calibration.target.flange_from_camera, target),
    ):
        off = drawn.inverse() * found
        result.measure(f"{name}, mounting off its drawing", 1e3 * math.hypot(*off.translation), "mm", most=30.0)
    result.notes.append(
        "; ".join(f"{key} {value}" for key, value in summary.items() if isinstance(value, int | float | str))[:600]
    )


def _verify(workplace: CommissionWorkplace, result: Result) -> None:
    _as_configured(workplace)
    verification = workplace.cell.verify(workplace.heard, workplace.job_file)
    summary = verification.summary()
    for row in summary["figures"]:
        result.measure(f"{row['name']} (1 sigma {row['sigma']:.4f})", row["value"], row["unit"])
    result.notes.append(summary["reason"])
    result.require("calibration is good today", verification.good, str(summary["reason"]))


def _job(part: bool, workplace: CommissionWorkplace, result: Result) -> None:
    cell, name = workplace.cell, workplace.job.job.name
    workplace.confirm("vehicle", "its wheels, to the station", "the job's whole way", "its configured speed")
    if not part:
        where = "The vehicle stands at the job's start pose, and the way to the station is clear; the claw is empty."
        if not workplace.person.does(where):
            raise RefusedError("the vehicle was not brought to the job's start")
    elif not workplace.person.does(f"The part of job {name} is in the claw; the place is free.", workplace.fill_claw):
        raise RefusedError("no part was put into the claw")
    if not workplace.person.go_ahead(
        f"The first job: {name}, {'whole' if part else 'up to the place pose, without placing'}."
    ):
        raise RefusedError("the job was not begun")
    known = cell.whereabouts.anchored
    outcome = cell.run(workplace.job_file, workplace.heard, at_start=not known, until=None if part else BEFORE_PLACING)
    result.notes.append(f"run {outcome.folder.name}: {outcome.outcome}, {outcome.reason}")
    for row in outcome.report.get("measured") or ():
        if isinstance(row.get("value"), int | float):
            result.measure(str(row["name"]), row["value"], str(row.get("unit", "")))
    good = outcome.outcome == ("placed" if part else "done")
    result.require("placed" if part else "done up to the place pose", good, outcome.reason)


CLOSING_CHECKS = [
    CommissionCheck(
        "calibration", "Calibration", "arm, rail and laser, over the two boards on the deck", "their whole reach there",
        fast="as configured", limit="solved, and its own checks good",
        keys=ALL, needs=("station",), work=_calibrate, recorded=False,
    ),
    CommissionCheck(
        "verification", "Verification of the calibration", "arm, rail and laser, one view of each board",
        far="their whole reach there", fast="as configured", limit="no part suspected at the job's tolerance",
        keys=ALL, needs=("calibration",), work=_verify, recorded=False,
    ),
    CommissionCheck(
        "job_empty", "First job, empty claw, up to the place pose", "everything: vehicle, arm, rail, laser",
        far="the whole job but placing", fast="as configured", limit="done",
        keys=(*ALL, "job"), needs=("verification",), work=partial(_job, False), recorded=False,
    ),
    CommissionCheck(
        "job_part", "First job with the part", "everything: vehicle, arm, rail, laser, claw", far="the whole job",
        fast="as configured", limit="placed",
        keys=(*ALL, "job"), needs=("job_empty",), work=partial(_job, True), recorded=False,
    ),
]  # fmt: skip
LINK_CHECKS = [
    CommissionCheck(
        "links", "Links and identities: every device answers and is well",
        "nothing", far="", fast="", limit="identity, round trips and figures as in `cell diag`",
        keys=WHERE, needs=(), work=_links,
    ),
]  # fmt: skip
