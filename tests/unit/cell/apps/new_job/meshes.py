"""Meshes for `cell new-job`, and a job made of one by its options."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from cell.apps.new_job.make import Made, make_job
from cell.apps.new_job.questions import Asker
from cell.config.cell_config import load_config


def from_options(folder: Path, overwrite: bool = False, **given: str) -> Made:
    """As with --yes: the options given, the rest by its defaults."""
    options = {name.replace("_", "-"): text for name, text in given.items()}
    return make_job(Asker(options, None, lambda _: None), load_config(None), folder, overwrite)


def write(path: Path, corners: np.ndarray) -> Path:
    """A mesh through a grid (n, m, 3) of corners."""
    k = np.arange(corners[..., 0].size).reshape(corners.shape[:2])
    a, b, c, d = (corner.ravel() for corner in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    trimesh.Trimesh(corners.reshape(-1, 3), faces).export(path)
    return path


def relief(path: Path, height: Callable[..., np.ndarray], half: float = 25.0) -> Path:
    """A mesh of z = height(x, y), mm, over a square."""
    side = np.linspace(-half, half, 61)
    x, y = np.meshgrid(side, side, indexing="ij")
    return write(path, np.stack([x, y, height(x, y)], -1))


def dish(path: Path, facets: int) -> Path:
    """A surface of revolution about z, its circles drawn with so many facets."""
    r, turn = np.meshgrid(np.linspace(1.0, 14.0, 25), np.linspace(0.0, 2 * np.pi, facets + 1), indexing="ij")
    return write(path, np.stack([r * np.cos(turn), r * np.sin(turn), 6.0 + 3.0 * np.cos(r / 4.0)], -1))
