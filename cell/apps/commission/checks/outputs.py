"""The arm's outputs: which one lights the laser and which one moves the claw, seen by camera and input.

Each output is switched by itself; what the picture and the inputs do then tells what hangs on it.
"""

from dataclasses import dataclass

import numpy as np

from cell.apps.commission.check import CommissionCheck, Result
from cell.apps.commission.measuring import camera_of, centred_view, eye_of
from cell.apps.commission.workplace import CommissionWorkplace
from cell.measure.vision.stripe.extract import extract
from drivers.errors import RefusedError
from drivers.interfaces import Frame, Image
from drivers.make import OnArm

LEAST_ROWS_SHARE = 0.25
"""Of the picture's rows that a stripe has to cross to be one."""
SETTLE_S = 0.3
PHOTO_RATE = 10.0
MOST_SATURATED, WIDEST_STRIPE = 20.0, 30.0
OUTPUTS = 18


@dataclass(frozen=True, eq=False)
class Switched:
    """The pictures before an output went on, and while it was on."""

    off: Frame
    on: Frame

    @property
    def stripe_rows(self) -> int:
        """Rows of the picture in which something bright and narrow has come."""
        return bright_rows(self.off.image, self.on.image)


def bright_rows(off: Image, on: Image) -> int:
    """Rows in which a narrow bright thing is in `on` that was not in `off`."""
    change = on.astype(float) - off.astype(float)
    noise = max(2.0, 1.4826 * float(np.median(np.abs(change - np.median(change)))))
    peak = change.max(axis=1)
    narrow = (change > 0.5 * peak[:, None]).mean(axis=1) < 0.1
    return int(((peak > 10.0 * noise) & narrow).sum())


def _outputs(workplace: CommissionWorkplace, result: Result) -> None:
    config = workplace.config
    if not isinstance(config.laser, OnArm) or not isinstance(config.claw, OnArm):
        result.notes.append("laser or claw does not hang on the arm's outputs: each is tried as it is configured")
        _laser_alone(workplace, result)
        workplace.confirm("claw", "the claw opens and closes, hands out of it", "its whole stroke", "its own")
        _claw(workplace, result)
        return
    laser, claw = config.laser.output, config.claw.output
    centred_view(workplace, result, eye_of(workplace, "scan_camera"))
    goggles = f"output {laser}: laser goggles on, nobody looks into the beam"
    workplace.confirm("laser", goggles, "half a second each time", "on and off")
    workplace.confirm(
        "claw", f"output {claw}: the claw opens and closes, hands out of it", "its whole stroke", "its own"
    )
    if not workplace.person.does("Take whatever is in the claw out of it: it will open."):
        raise RefusedError("the claw was not emptied, so its output was not switched. Take out what is in it")
    # Both off first: an output that is on already shows nothing when it is switched on.
    with workplace.cell.maintenance("commissioning: what hangs on which output", ["own_switch"]):
        for output in (claw, laser):
            workplace.devices.arm.set_digital_output(output, False)
        workplace.devices.clock.sleep(SETTLE_S)
        by_laser = _switch(workplace, laser)
        by_claw = _switch(workplace, claw)
    workplace.keep(result, "output-laser-on", by_laser.on)
    workplace.keep(result, "output-claw-on", by_claw.on)
    rows = by_laser.on.image.shape[0]
    enough = LEAST_ROWS_SHARE * rows
    result.measure(f"rows with a stripe while laser.output ({laser}) is on", by_laser.stripe_rows, f"of {rows}")
    result.measure(f"rows with a stripe while claw.output ({claw}) is on", by_claw.stripe_rows, f"of {rows}")
    if by_laser.stripe_rows >= enough and by_claw.stripe_rows < enough:
        _stripe(workplace, result, by_laser.on)
        _claw(workplace, result)
    elif by_claw.stripe_rows >= enough and by_laser.stripe_rows < enough:
        result.find(
            "laser.output, claw.output",
            "the outputs of laser and claw are swapped: the claw's output lights the laser",
            f"laser {laser}, claw {claw}", found=f"laser {claw}, claw {laser}",
            remedy="Swap the two numbers, or the two wires.",
            write={"laser.output": str(claw), "claw.output": str(laser)},
        )  # fmt: skip
    else:
        _no_light(workplace, result, laser, claw, enough)


def _no_light(workplace: CommissionWorkplace, result: Result, laser: int, claw: int, enough: float) -> None:
    others = [output for output in range(OUTPUTS) if output not in (laser, claw)]
    lit: list[int] = []
    if workplace.person.go_ahead(
        f"No stripe with outputs {laser} and {claw}. The others are switched on one after the other."
    ):
        with workplace.cell.maintenance("commissioning: which output lights the laser", ["own_switch"]):
            for output in others:
                workplace.look_around()
                if _switch(workplace, output).stripe_rows >= enough:
                    lit.append(output)
    result.find(
        "laser.output", "no stripe comes when the laser's output is switched on",
        str(laser), f"the laser is lit by output {lit[0]}" if lit else "no output lights it",
        "See that laser.output is the connector that the laser hangs on, that the laser has power and its shutter "
        "is open, and that calibration.stripe_exposure is long enough.",
        write={"laser.output": str(lit[0])} if lit else {},
    )  # fmt: skip


def _switch(workplace: CommissionWorkplace, output: int) -> Switched:
    """Switch an output on and off again, with a picture before and while it is on."""
    arm, clock = workplace.devices.arm, workplace.devices.clock
    camera = camera_of(workplace, eye_of(workplace, "scan_camera"))
    camera.configure(workplace.config.calibration.stripe_exposure, PHOTO_RATE)
    off = camera.grab()
    # What lights up may be the laser, whatever the configuration says: a stop must not leave it on.
    with workplace.devices.interlocks.tried(output):
        try:
            arm.set_digital_output(output, True)
            clock.sleep(SETTLE_S)
            on = camera.grab()
        finally:
            arm.set_digital_output(output, False)
    clock.sleep(SETTLE_S)
    return Switched(off, on)


def _laser_alone(workplace: CommissionWorkplace, result: Result) -> None:
    eye = eye_of(workplace, "scan_camera")
    centred_view(workplace, result, eye)
    workplace.confirm("laser", "laser goggles on, nobody looks into the beam", "half a second", "on and off")
    camera = camera_of(workplace, eye)
    camera.configure(workplace.config.calibration.stripe_exposure, PHOTO_RATE)
    off = camera.grab()
    with workplace.devices.interlocks.purpose("test"), workplace.devices.laser.lit():
        workplace.devices.clock.sleep(SETTLE_S)
        on = camera.grab()
    workplace.keep(result, "laser-on", on)
    rows = bright_rows(off.image, on.image)
    result.measure(
        "rows with a stripe while the laser is lit", rows, f"of {on.image.shape[0]}",
        least=LEAST_ROWS_SHARE * on.image.shape[0], remedy="See what switches the laser, its power and its shutter.",
    )  # fmt: skip
    _stripe(workplace, result, on)


def _stripe(workplace: CommissionWorkplace, result: Result, lit: Frame) -> None:
    """How good the stripe is: how many rows, how wide, how bright."""
    profile = extract(lit.image)
    rows = profile.rows
    workplace.keep(result, "stripe", lit, profile.pixels()[:: max(1, len(rows) // 60)])
    exposure = "calibration.stripe_exposure"
    result.measure(
        "rows with a stripe centre", len(rows), "", least=LEAST_ROWS_SHARE * lit.image.shape[0],
        remedy=f"Raise {exposure}, or see that the line lies across the board.",
    )  # fmt: skip
    if len(rows):
        width, remedy = float(np.median(profile.width[rows])), "Focus the laser on the board."
        result.measure("width of the stripe, one sigma", width, "px", most=WIDEST_STRIPE, remedy=remedy)
        across = np.clip(np.round(profile.pixels()[:, 0]).astype(int), 0, lit.image.shape[1] - 1)
        peak = lit.image[rows, across]
        bright, saturated = float(np.median(peak)), 100.0 * float((peak >= 255).mean())
        result.measure("brightness of the stripe, median", bright, "DN", least=40.0, remedy=f"Raise {exposure}.")
        remedy = f"Lower {exposure}."
        result.measure("stripe rows that are saturated", saturated, "%", most=MOST_SATURATED, remedy=remedy)


def _claw(workplace: CommissionWorkplace, result: Result) -> None:
    """With a part in it the claw's input shows it, and shows it no more when it has opened."""
    claw = workplace.devices.claw
    if not workplace.person.does("Hold a part between the fingers: the claw closes on it.", workplace.fill_claw):
        raise RefusedError("no part was put into the claw, so its feedback was not tried")
    before = workplace.devices.arm.state().digital_inputs
    if not claw.holding:
        claw.grip(5.0)
    held = workplace.devices.arm.state().digital_inputs
    result.require("claw.feedback shows the part when closed", claw.holding)
    if not workplace.person.does("Keep a hand below the part: the claw opens."):
        raise RefusedError("the claw was not opened, so what it shows when open was not tried")
    with workplace.cell.maintenance("commissioning: the claw opens in the open", ["claw_at_contact"]):
        claw.release(5.0)
    result.measure("claw.feedback shows the part when open", float(claw.holding), "", most=0.0)
    changed = (held ^ workplace.devices.arm.state().digital_inputs) | (before ^ held)
    shown = ", ".join(str(k) for k in range(OUTPUTS) if changed >> k & 1) or "none"
    result.notes.append(f"inputs that changed with the claw: {shown}")


CHECKS = [
    CommissionCheck(
        "outputs", "Outputs: laser and claw, each by what the camera and the inputs show",
        "laser and claw, each by its own output; the arm to its view of the board", far="half a second each",
        fast="on and off", limit="a stripe with laser.output alone; claw.feedback follows claw.output",
        keys=("laser", "claw", "scan_camera", "calibration.fine", "calibration.stripe_exposure"),
        needs=("rail_direction",), work=_outputs,
    ),
]  # fmt: skip
