"""`cell bench reconstruction`: outliers, holes and speed."""

from __future__ import annotations

from typing import Any

from cell.apps.cli.options import JsonOption, SeedOption, wide_console
from lab.cli.shown import bar, formed, show


def reconstruction(seed: SeedOption = 1, json: JsonOption = False) -> None:
    """Outliers found, holes filled and milliseconds after the last frame, on synthetic clouds of known truth."""
    from lab.bench.reconstruction.campaign import run

    with bar() as told:
        report = run(seed, told)
    show(report, json, _print)


def _print(report: dict[str, Any]) -> None:
    console = wide_console()
    console.print(
        formed(
            "outliers in 300 × 480 points",
            {
                "surface": "{surface}",
                "<kind": "{kind}",
                "share": "{share:.0%}",
                "recall": "{recall:.4f}",
                "precision": "{precision:.4f}",
                "ms": "{ms:.0f}",
            },
            report["outliers"],
        )
    )
    console.print(
        formed(
            "holes, interpolated; z is the error in units of the stated sigma",
            {
                "surface": "{surface}",
                "lines × rows": "{lines} × {rows}",
                "filled": "{filled:.1%}",
                "error rms in um": "{error_rms_um:.1f}",
                "z rms": "{z_rms:.2f}",
                "ms": "{ms:.0f}",
            },
            report["holes"],
        )
    )
    console.print(
        formed(
            "speed",
            {
                "camera": "{width}×{rows}",
                "lines": "{lines}",
                "points": "{points}",
                "ms per profile as it arrives": "{ms_per_profile:.2f}",
                "ms after the last frame": "{ms_after_last_frame:.0f}",
                "of the processor, all threads": "{processor_ms_after_last_frame:.0f}",
            },
            report["speed"],
        )
    )
