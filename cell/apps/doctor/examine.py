"""All checks of this computer for one configuration, in the order in which a person reads them."""

from __future__ import annotations

from pathlib import Path

from cell.apps.doctor.check import DoctorCheck
from cell.apps.doctor.computer import (
    browser_check,
    clock_check,
    clock_synchronised,
    date_check,
    disk_check,
    python_check,
    scheduling_check,
)
from cell.apps.doctor.links import link_checks
from cell.apps.doctor.packages import package_checks, shadow_check
from cell.config.cell_config import DEVICES, beside, find_config, load_config, runs_folder
from cell.devices.diagnosis.local_devices import ROOT
from drivers.errors import ConfigError

EXTRA_OF_DRIVER = {"canopen": "canopen"}
"""Extras of this program that a device's driver needs."""
OTHER_EXTRAS = ("e57", "step", "canopen", "modbus")


def examine_computer(path: Path | None, root: Path = ROOT) -> list[DoctorCheck]:
    """How this computer is, for the cell that is configured, or for simulated ones where none is."""
    source = find_config(path, simulated=True)
    rows: list[DoctorCheck] = []
    config = None
    if source is not None:
        try:
            config = load_config(source)
            rows.append(DoctorCheck("configuration", "ok", str(source)))
        except ConfigError as error:
            rows.append(DoctorCheck("configuration", "wrong", " ".join(str(error).split()), f"cell check -c {source}"))
    whole = config is None or bool(config.cell.truth)
    simulated = tuple(DEVICES) if whole or config is None else config.cell.sim
    real = [name for name in DEVICES if name not in simulated]
    needed = set() if config is None else {EXTRA_OF_DRIVER.get(config.device(name).driver, "") for name in real} - {""}
    rows += [python_check(), *package_checks(sorted(needed), [name for name in OTHER_EXTRAS if name not in needed])]
    rows.append(shadow_check())
    rows.append(disk_check(runs_folder(source) if source is not None else beside(source) / "runs"))
    rows += [
        date_check(clock_synchronised(), bool(real)),
        clock_check(root, bool(real)),
        scheduling_check(root, bool(real)),
    ]
    if config is None:
        rows.append(DoctorCheck("devices", "not needed", "no cell.toml here: simulated cells need no port"))
    elif whole:
        rows.append(DoctorCheck("devices", "not needed", "all are simulated"))
    else:
        rows += link_checks(config, simulated, root)
    return [*rows, browser_check()]
