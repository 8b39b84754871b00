"""How fast stripes are extracted, on pictures that stream by."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.measure.vision.stripe.extract import StripeStream, extract
from lab.bench.stripe.truth import Cell, draw

SHAPE = (1024, 1280)
FRAMES = 32
CONDITION = Cell(2.0, 150.0)
SPECKLED = Cell(2.0, 120.0, 0.2)

Image = NDArray[np.uint8]
Run = Callable[[list[Image]], Any]


def compare(progress: Callable[[float, str], None], repeats: int = 5) -> dict[str, Any]:
    """Milliseconds per frame and points per second of each way, best of `repeats` rounds.

    Each round runs through `FRAMES` different pictures, together larger than the processor's second-level cache. A
    point is one centre in one image row.
    """
    plain = [draw(CONDITION, SHAPE, seed)[0] for seed in range(FRAMES)]
    speckled = [draw(SPECKLED, SHAPE, seed)[0] for seed in range(FRAMES)]
    candidates: list[tuple[str, Run, list[Image]]] = [
        ("reading each pixel once", _each(np.max), plain),
        ("a stream", _stream, plain),
        ("a stream with speckle contrast 0.2", _stream, speckled),
        ("single pictures", _each(extract), plain),
    ]
    rows: list[dict[str, Any]] = []
    cv2_threads = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        for k, (name, run, images) in enumerate(candidates):
            progress(k / len(candidates), name)
            seconds = _best(run, images, repeats)
            rows.append({"name": name, "ms_per_frame": 1e3 * seconds, "points_per_s": SHAPE[0] / seconds})
    finally:
        cv2.setNumThreads(cv2_threads)
    for row in rows:
        row["times_reading"] = row["ms_per_frame"] / rows[0]["ms_per_frame"]
    progress(1.0, "speed done")
    return {"shape": list(SHAPE), "frames": FRAMES, "rows": rows}


def _each(run: Callable[[Image], Any]) -> Run:
    """One picture after the other, each by itself."""

    def through(images: list[Image]) -> None:
        for image in images:
            run(image)

    return through


def _stream(images: list[Image]) -> None:
    stream = StripeStream()
    for image in images:
        stream.extract(image)


def _best(run: Run, images: list[Image], repeats: int) -> float:
    """Seconds a frame, best of some rounds after one picture to warm up."""
    run(images[:1])
    best = np.inf
    for _ in range(repeats):
        begin = time.perf_counter()
        run(images)
        best = min(best, (time.perf_counter() - begin) / len(images))
    return float(best)
