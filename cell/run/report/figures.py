"""How a measured figure of the report is written for people, on the screen and in the picture."""

from collections.abc import Mapping
from typing import Any

from cell.run.folder import Report
from drivers.errors import MeasuredRow


def shown_value(row: MeasuredRow) -> str:
    """The value with its unit: three digits that say something."""
    return f"{_digits(row['value'])} {row['unit']}".strip()


def shown_limit(row: MeasuredRow) -> str:
    """What the value is held against, or nothing."""
    if row["limit"] is None:
        return ""
    return f"{row['bound']} {_digits(row['limit'])} {row['unit']}".strip()


def _digits(value: float | None) -> str:
    if value is None:
        return "no number"
    if value == int(value) and abs(value) < 1e6:
        return f"{value:.0f}"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def texture_words(report: Report) -> str:
    """The waviness of the scanned surface and of its areas, as `scan` of a report has it, for people; "" without it."""
    scan = report.get("scan") or {}
    if not (texture := scan.get("texture")):
        return ""
    areas = (f"{area['name']}: {_waviness(area)}" for area in scan.get("areas", ()))
    return "; ".join([_waviness(texture), *areas])


def _waviness(texture: Report) -> str:
    if texture["sq_mm"] is None:
        return f"no waviness told: {texture['reason']}"
    sizes = ", ".join(f"{name.capitalize()} {texture[f'{name}_mm']:.4f} mm" for name in ("sa", "sq", "sz"))
    return f"waviness over {texture['nesting_mm']:g} mm: {sizes} (limit of Sq {texture['limit_mm']:.4f} mm)"


SHOWN_UNITS = {"m": (1e3, "mm"), "rad": (1e3, "mrad"), "rad/m": (1e3, "mrad/m"), "s": (1e6, "us")}
"""How a standard deviation in SI is shown to people, by its unit."""


def noise_rows(noise: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """`assumed_noise` of a report for people: of what, one standard deviation, its unit."""
    rows = []
    for entry in (noise.get("sigmas") or {}).values():
        factor, unit = SHOWN_UNITS.get(entry["unit"], (1.0, entry["unit"]))
        rows.append((str(entry["of"]), f"{factor * entry['sigma']:.4g}", str(unit)))
    return rows


def following_words(following: Mapping[str, Any]) -> str:
    """How late real devices' readings reached a simulated world, as `following` in a report has it, for people."""
    if "devices" not in following:
        return f"not told: {following.get('missing')}"
    late = [(name, row["latency_ms"]) for name, row in following["devices"].items() if row["latency_ms"] is not None]
    told = ", ".join(f"{name} {row['p50']:.0f} ms (99 %: {row['p99']:.0f})" for name, row in late)
    lost = following["not_made"]
    return f"{told}; {lost} picture{'s' * (lost != 1)} not made" if lost else told


def simulated_words(simulated: object) -> str:
    """What a report says of simulated devices, for people: "" where all are real."""
    if not simulated:
        return ""
    return f"{', '.join(map(str, simulated))} simulated, all else real" if isinstance(simulated, list) else "simulated"
