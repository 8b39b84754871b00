"""How fast stripes are extracted, on pictures that stream by, beside what others take in the same run."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cell.lab.bench.stripe_truth import Cell, draw
from cell.vision.stripe.extract import Method, StripeProfile, StripeSettings, extract
from cell.vision.stripe.methods import gaussian_derivatives
from cell.vision.stripe.stream import StripeStream, extract_all

SHAPE = (1024, 1280)
FRAMES = 32
CONDITION = Cell(2.0, 150.0)
SPECKLED = Cell(2.0, 120.0, 0.2)

Image = NDArray[np.uint8]
Run = Callable[[list[Image]], Any]


def compare(progress: Callable[[float, str], None], repeats: int = 5) -> dict[str, Any]:
    """Milliseconds per frame and points per second of ours and of the others, best of `repeats` rounds.

    Each round runs through `FRAMES` different pictures, together larger than the processor's second-level cache; the
    others, which take longer, through fewer. A point is one centre in one image row or column.
    """
    plain = [draw(CONDITION, SHAPE, seed)[0] for seed in range(FRAMES)]
    speckled = [draw(SPECKLED, SHAPE, seed)[0] for seed in range(FRAMES)]
    turned = [np.ascontiguousarray(image.T) for image in plain]
    known = StripeSettings(speckle_contrast=0.0)
    candidates: list[tuple[str, Run, list[Image]]] = [
        ("reading each pixel once", _each(np.max), plain),
        ("ours, a stream, one core", _stream, plain),
        ("ours, a stream with speckle contrast 0.2, one core", _stream, speckled),
        ("ours, a stream, two cores", _two_cores, plain),
        ("ours, a stream with speckle contrast 0.2, two cores", _two_cores, speckled),
        ("ours, single pictures", _each(extract), plain),
        ("ours, single pictures with speckle contrast 0.2", _each(extract), speckled),
        ("ours, single pictures, speckle declared absent", _each(lambda i: extract(i, settings=known)), plain),
        ("ours, single pictures, along columns", _each(lambda i: extract(i, axis="columns")), turned),
        ("numpy centre of gravity", _each(centre_of_gravity), plain[:8]),
        ("OpenCV separable Steger", _each(opencv_steger), plain[:3]),
        ("our Steger, with peaks and sigmas", _each(lambda i: extract(i, method=Method.STEGER)), plain[:3]),
    ]
    ridge = ridge_detector()
    if ridge is not None:
        candidates.append(("ridge-detector", _each(ridge), plain[:1]))
    rows = []
    cv2_threads = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        for k, (name, run, images) in enumerate(candidates):
            progress(k / len(candidates), name)
            seconds = _best(run, images, 1 if len(images) < 4 else repeats)
            lines = images[0].shape[1] if "columns" in name else images[0].shape[0]
            rows.append({"name": name, "ms_per_frame": 1e3 * seconds, "points_per_s": lines / seconds})
    finally:
        cv2.setNumThreads(cv2_threads)
    if ridge is None:
        rows.append({"name": "ridge-detector", "ms_per_frame": None, "points_per_s": None})
    reading, own = rows[0]["ms_per_frame"], rows[1]["ms_per_frame"]
    for row in rows:
        row["times_ours"] = None if row["ms_per_frame"] is None else row["ms_per_frame"] / own
        row["times_reading"] = None if row["ms_per_frame"] is None else row["ms_per_frame"] / reading
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


def _two_cores(images: list[Image]) -> list[StripeProfile]:
    return list(extract_all(images, threads=2))


def _best(run: Run, images: list[Image], repeats: int) -> float:
    """Seconds a frame, best of some rounds after one picture to warm up."""
    run(images[:1])
    best = np.inf
    for _ in range(repeats):
        begin = time.perf_counter()
        run(images)
        best = min(best, (time.perf_counter() - begin) / len(images))
    return float(best)


def centre_of_gravity(image: Image) -> Any:
    """Centres (h,) as most write it: brightest pixel of each row, first moment over ±8 px above the window's least."""
    place = image.argmax(axis=1)
    column = np.clip(place[:, None] + np.arange(-8, 9), 0, image.shape[1] - 1)
    value = np.take_along_axis(image, column, axis=1).astype(np.float32)
    value -= value.min(axis=1, keepdims=True)
    return (value * column).sum(axis=1) / np.maximum(value.sum(axis=1), 1e-6)


def opencv_steger(image: Image) -> Any:
    """Ridge points (m, 2) after Steger with OpenCV's separable filters over the whole picture."""
    gx, gy, gxx, gxy, gyy = gaussian_derivatives(image.astype(np.float32), CONDITION.width)
    half_trace, half_difference = 0.5 * (gxx + gyy), 0.5 * (gxx - gyy)
    eigenvalue = half_trace - np.sqrt(half_difference**2 + gxy**2)
    rows, columns = np.nonzero(eigenvalue < -2.0)
    a, b, e = gxx[rows, columns], gxy[rows, columns], eigenvalue[rows, columns]
    nx, ny = b, e - a
    swap = np.abs(nx) + np.abs(ny) < 1e-6
    nx, ny = np.where(swap, 1.0, nx), np.where(swap, 0.0, ny)
    length = np.hypot(nx, ny)
    nx, ny = nx / length, ny / length
    shift = -(nx * gx[rows, columns] + ny * gy[rows, columns]) / e
    inside = (np.abs(shift * nx) <= 0.5) & (np.abs(shift * ny) <= 0.5)
    return np.column_stack([columns + shift * nx, rows + shift * ny])[inside]


def ridge_detector() -> Callable[[Image], Any] | None:
    """The peer from PyPI, set to this stripe's width; None when it is not installed."""
    try:
        peer = importlib.import_module("ridge_detector")
    except ImportError:
        return None
    detector = peer.RidgeDetector(line_widths=[4], low_contrast=20, high_contrast=80, min_len=20, max_len=0)
    return lambda image: detector.detect_lines(image)
