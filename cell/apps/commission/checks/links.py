"""Every device answers, is who it should be, and is well: nothing moves."""

from __future__ import annotations

from cell.apps.commission.check import CommissionCheck, Result
from cell.apps.commission.workplace import CommissionWorkplace
from cell.config.cell_config import DEVICES
from cell.devices.diagnosis.diagnosis import STATES, ask

WHERE = tuple(
    f"{name}.{key}" for name in DEVICES for key in ("driver", "address", "url", "channel", "interface", "model", "baud")
)
"""What tells who is connected, and where, whatever the make."""


def _links(desk: CommissionWorkplace, result: Result) -> None:
    devices, config = desk.devices, desk.cell.config
    for name in STATES:
        device = getattr(devices, name)
        row = ask(name, config.device(name).place, getattr(device, "bare", device), devices.clock)
        who = " ".join(part for part in (row.model, row.serial, row.firmware) if part)
        result.notes.append(f"{name} ({DEVICES[name]}): {who or 'no identity'}, {row.state}")
        result.measure(
            f"{name} answers and is well", float(row.ok), "", least=1.0, remedy=f"See `cell diag --device {name}`."
        )
        for reading in row.readings:
            if not reading.ok:
                result.measure(
                    f"{name}: {reading.what}", reading.value, reading.unit, least=reading.least, most=reading.most,
                    remedy=reading.remedy,
                )  # fmt: skip
    stopped = desk.person.sees(
        "Is the emergency stop within reach, the cell's surroundings clear, and nothing in the claw's way?"
    )
    result.measure("a person has looked round", float(stopped), "", least=1.0)


CHECKS = [
    CommissionCheck(
        "links", "Links and identities: every device answers and is well",
        "nothing", far="", fast="", limit="identity, round trips and figures as in `cell diag`",
        keys=WHERE, needs=(), work=_links,
    ),
]  # fmt: skip
