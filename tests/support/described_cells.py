"""Cells and jobs that are described otherwise than those that ship: files of their own, changed in a few values."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from cell.config.cell_config import NO_FILES, default_toml
from cell.config.job import job_path

Changes = Mapping[str, Mapping[str, str]]
"""Table, key: the value as TOML text. A key that the table lacks is added."""
UNDRAWN: Changes = {"cell": {"picture": "false"}}
LEAN: Changes = {"cell": dict.fromkeys(NO_FILES, "false")}
"""For runs of whose files a test reads the report and the journal alone."""
Numbers = tuple[float, float, float]


def pose(translation: Numbers, rotation: Numbers) -> str:
    """A pose as TOML, mm and degrees."""
    mm, deg = (
        ", ".join(f'"{v:g} {unit}"' for v in values) for values, unit in ((translation, "mm"), (rotation, "deg"))
    )
    return f"{{ translation = [{mm}], rotation = [{deg}] }}"


def changed(text: str, changes: Changes) -> str:
    """A TOML text with other values."""
    tables = re.split(r"(?m)^(?=\[)", text)
    left = {table: dict(keys) for table, keys in changes.items()}
    for k, table in enumerate(tables):
        name = table[1 : table.index("]")] if table.startswith("[") else ""
        for key, value in left.pop(name, {}).items():
            pattern = rf"(?m)^{key} = .*$"
            line = f"{key} = {value}"
            if not re.search(pattern, tables[k]):
                tables[k] = tables[k].rstrip() + f"\n{line}\n\n"
            tables[k] = re.sub(pattern, line, tables[k])
    assert not left, left
    return "".join(tables)


def described(folder: Path, config: Changes | None = None, job: Changes | None = None) -> tuple[Path, Path]:
    """`cell.toml` and `own.toml` in `folder`, of the shipped ones but for these values."""
    folder.mkdir(parents=True, exist_ok=True)
    cell, own = folder / "cell.toml", folder / "own.toml"
    cell.write_text(changed(default_toml(), config or {}), encoding="utf-8")
    text = changed(job_path("pot").read_text(encoding="utf-8"), job or {})
    own.write_text(text, encoding="utf-8")
    if 'mesh = "pot.ply"' in text:
        (folder / "pot.ply").write_bytes((job_path("pot").parent / "pot.ply").read_bytes())
    return cell, own


def quick(text: str, rate: float = 30.0) -> str:
    """A job's text swept twice as fast as shipped, with `rate` pictures a second. With fewer than 20, lines lie farther
    apart than `scan.largest_hole`: a drawn part then hardly meets what was seen."""
    return changed(text, {"scan": {"speed": '"30 mm/s"', "frame_rate": f'"{rate:g} Hz"'}})


def quick_job(name: str, folder: Path, rate: float = 30.0) -> Path:
    """A file in `folder` of the shipped job, which is `quick`."""
    shipped, file = job_path(name), folder / f"{name}.toml"
    text = re.sub(r'(?m)^mesh = "', f'mesh = "{shipped.parent}/', shipped.read_text(encoding="utf-8"))
    file.write_text(quick(text, rate), encoding="utf-8")
    return file


def saddle(x: Any, y: Any) -> Any:
    """Height, m, of a part's seat that nothing here ships: a saddle with a bump and a dent, x and y in m."""
    bump = 0.0030 * np.exp(-((x - 0.012) ** 2 + (y - 0.004) ** 2) / (2 * 0.0050**2))
    dent = -0.0022 * np.exp(-((x + 0.014) ** 2 + (y + 0.003) ** 2) / (2 * 0.0060**2))
    return 0.006 + 4.0 * x * x - 6.0 * y * y + 3.0 * x * y + bump + dent


def write_saddle(path: Path, half: tuple[float, float] = (0.030, 0.015), step: float = 0.0005) -> None:
    """A mesh of it, in mm, open at its border, as a CAD program writes one."""
    nx, ny = (round(2 * side / step) + 1 for side in half)
    x, y = np.meshgrid(np.linspace(-half[0], half[0], nx), np.linspace(-half[1], half[1], ny), indexing="ij")
    index = np.arange(nx * ny).reshape(nx, ny)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    vertices = 1e3 * np.stack([x.ravel(), y.ravel(), saddle(x, y).ravel()], axis=-1)
    trimesh.Trimesh(vertices, faces, process=False).export(path)
