"""Which words of a reason name which cause: a run that was not done has to name one that was there."""

import re
from collections.abc import Iterable

PERSON_WORDS = r"a day's abort"
CAUSES = {
    "arm.protective_stop": r"protective[_ ]stop|nobody confirmed|not held|part is already down",
    "arm.safeguard_stop": r"safeguard",
    "arm.emergency_stop": r"emergency|not powered|power is",
    "arm.local_control": r"local[_ ]control|takes nothing but questions|remote",
    "rail.reset": r"lost its zero|rail.*(home|zero)",
    "rail.exchanged_switches": r"switch",
    "rail.lost_steps": r"lost .*step|steps|carriage|rail",
    "vehicle.emergency_stop": r"emergency",
    "vehicle.motor_fault": r"vehicle.*(motor|fault|error|driver)|motor",
    "camera.frame_loss": r"frame|picture",
    "camera.silent": r"scan_camera.*(no answer|no frame|answer)|no frame came|no answer",
    "target_camera.frame_loss": r"frame|picture",
    "target_camera.silent": r"target_camera.*(no answer|no frame)|no frame came|no answer",
    "abort": PERSON_WORDS,
    "vehicle_bumped": r"moved|board|vehicle|stands|calibrat|swung|obliquity|surface|touch|contact|collision|reach",
    "surface_moved": r"moved|surface|touch|contact|where it|observable|edge|found|points|lies|standing|claw lost",
    "part_taken": r"claw|part|nest|hold|grip|nothing|placed",
    "full_disk": r"disk|written|recorded|too large|I/O",
    "resume": r"where the vehicle stands is not known",
    "clock_step": r"clock|calibration.*(old|age|date)|future",
}
"""By act, and by a resume, which finds the vehicle anywhere: what a reason may say that this has caused."""
NATURAL = {
    "nominal": r"$^",
    "workshop": r"observable|calibrat|agree|explain|fits|rock|sway|creep|known|sigma|tolerance|apart|points|edge",
}
"""By level: what a reason may say in a cell to which nothing was done."""


def named(reason: str, acts: Iterable[str], level: str) -> bool:
    """Whether the reason names one of the causes that were there."""
    words = [NATURAL.get(level, NATURAL["workshop"]), *(CAUSES[act] for act in acts if act in CAUSES)]
    return any(re.search(each, reason, re.IGNORECASE | re.DOTALL) for each in words)
