"""`cell bench stripe`: the stripe's centres beside their bound, and how fast they are had."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from cell.apps.cli.options import JsonOption, wide_console
from lab.cli.shown import bar, formed, show

ACCURACY = {
    "width px": "{width_px:.1f}",
    "peak DN": "{peak_dn:.0f}",
    "speckle": "{contrast:.1f}",
    "slope DN/px": "{slope_dn_per_px:.2f}",
    "bound px": "{bound_px:.4f}",
    "RMS px": "{rms_px:.4f}",
    "efficiency": "{efficiency:.3f}",
    "bias px": "{bias_px:+.4f}",
    "stated σ / true": "{stated_over_true:.2f}",
    "found": "{found:.3f}",
}
PROFILES = {
    "scene": "{scene}",
    "width px": "{width_px:.1f}",
    "bound px": "{bound_px:.4f}",
    "RMS px": "{rms_px:.4f}",
    "efficiency": "{efficiency:.2f}",
    "stated σ / true": "{stated_over_true:.2f}",
    "found": "{found:.3f}",
    "false": "{false:.3f}",
    "within limits": "{within_limits}",
}
SPEED = {
    "what": "{name}",
    "ms/frame": "{ms_per_frame:.3f}",
    "points/s": "{points_per_s:,.0f}",
    "times reading": "{times_reading:.1f}",
}


def stripe(
    pictures: Annotated[int, typer.Option(min=1, max=100, help="Pictures of 1024 rows for each condition.")] = 3,
    accuracy: Annotated[bool, typer.Option(help="Errors beside the Cramér–Rao bound.")] = True,
    profiles: Annotated[bool, typer.Option(help="Other profiles, widths, texture, colour and depth.")] = True,
    speed: Annotated[bool, typer.Option(help="Time per frame.")] = True,
    json: JsonOption = False,
) -> None:
    """Stripe centres: RMS error, bias and stated deviation beside the bound, and speed."""
    from lab.bench.stripe import accuracy as stripe_accuracy
    from lab.bench.stripe import profiles as stripe_profiles
    from lab.bench.stripe import speed as stripe_speed

    result: dict[str, Any] = {}
    with bar() as told:
        if speed:
            result["speed"] = stripe_speed.compare(told)
        if accuracy:
            result["accuracy"] = stripe_accuracy.campaign(told, pictures)
        if profiles:
            result["profiles"] = stripe_profiles.campaign(told, pictures)
    show(result, json, _print)


def _print(result: dict[str, Any]) -> None:
    console = wide_console()
    if found := result.get("accuracy"):
        noise = found["assumed_noise"]
        title = (
            f"stripe centres, simulated: {noise['electrons_per_dn']:.0f} electrons per DN, read noise "
            f"{noise['read_noise_dn']} DN, 8 bits; {found['points_each']} rows each"
        )
        console.print(formed(title, ACCURACY, found["rows"]))
    if found := result.get("profiles"):
        limits = found["limits"]
        low, high = limits["stated_over_true"]
        title = (
            "stripes of a workshop, simulated: RMS about the mean beside the profile's own bound; limits: efficiency "
            f"≥ {limits['least_efficiency']}, stated σ / true {low}–{high}, found ≥ {limits['least_found']:.0%}, "
            f"false ≤ {limits['most_false']:.0%}"
        )
        console.print(formed(title, PROFILES, found["rows"]))
    if found := result.get("speed"):
        height, width = found["shape"]
        title = f"speed at {width}×{height} px, {found['frames']} pictures streaming by"
        console.print(formed(title, SPEED, found["rows"]))
