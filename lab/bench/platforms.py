"""Which platform and Python has wheels of what the cell needs, asked of the package index; writes
docs/reference/platforms.md.

    python -m lab.bench.platforms docs/reference/platforms.md

The questions are those of an installation, put by `uv pip compile`: nothing is downloaded but what wheels say of
themselves. What a platform has is what can be installed there; only where the docs say so was it run as well.
"""

from __future__ import annotations

import re
import subprocess
import sys
import time
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

PLATFORMS = {
    "Linux x86-64": "x86_64-manylinux_2_28",
    "Linux aarch64": "aarch64-manylinux_2_28",
    "macOS arm64": "aarch64-apple-darwin",
    "Windows x86-64": "x86_64-pc-windows-msvc",
}
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
OPTIONAL = ("ur-rtde", "ompl", "embreex")
"""Imported when they are needed; `pyproject.toml` asks for them where they have wheels."""
HEAD = """# Platforms

What `pip install -e .` finds on the package index: wheels of each package and of what it needs in turn. Asked on {date}
by `python -m lab.bench.platforms docs/reference/platforms.md`, which needs `uv` and writes this page.

- Tested is Linux x86-64: Python 3.11 by the whole test suite, and the newest other Python that `.ci/run` finds by a dry
  run. The other rows say what can be installed, and were not run. The devices' drivers are for Linux.
- **Wires**: real arms, simulated cells over the devices' protocols, `cell console`. Without ur-rtde, `cell dry-run`
  takes the virtual clock and says so.
- **Ways**: free moves of the arm. Without OMPL it takes a direct way or one over one corner; where neither is free,
  the move is refused.
- **Offline**: `cell dry-run --clock virtual`, `cell report`, `cell calibrate --from`.
- **New job**: `cell new-job`, which casts rays with embreex.
- **Built**: packages without a wheel, whose sources pip has to build first; whether it can was not tried.

| platform | Python | wires | ways | offline | new job | built |
|---|---|---|---|---|---|---|
"""


def refused(wanted: list[str], platform: str, python: str, *options: str) -> str:
    """Why the index has not all of `wanted`, and all that it needs, for this platform and Python; "" where it has."""
    command = ["uv", "pip", "compile", "--quiet", "--python-platform", platform, "--python-version", python, *options]
    done = subprocess.run([*command, "-"], input="\n".join(wanted), capture_output=True, text=True, timeout=300)
    if done.returncode and not any(word in done.stderr for word in ("No solution found", "Failed to build")):
        raise RuntimeError(f"the index was not asked: {done.stderr.strip()}")
    return done.stderr if done.returncode else ""


def lacking(wanted: dict[str, str], platform: str, python: str) -> tuple[set[str], set[str]]:
    """Names of `wanted` (their requirements by name) without a wheel, and those of them without sources either."""
    wheels = ("--only-binary", ":all:")
    # The arm's driver is for Linux, whatever ur-rtde is for.
    bare = {name for name in OPTIONAL if refused([wanted[name]], platform, python, *wheels)}
    bare |= set() if "manylinux" in platform else {"ur-rtde"}
    while why := refused([line for name, line in wanted.items() if name not in bare], platform, python, *wheels):
        named = [name for name in wanted if name not in bare and re.search(rf"\b{re.escape(name)}[=<>]", why)]
        bare.add(next(name for name in named or wanted if refused([wanted[name]], platform, python, *wheels)))
    # The sources of the optional ones need libraries that pip does not bring.
    return bare, {name for name in bare if name in OPTIONAL or refused([wanted[name]], platform, python)}


def works(no_wheel: set[str], nothing: set[str]) -> tuple[str, str, str, str, str]:
    """Wires, ways, offline, new job, built of a row of the table; `nothing` are those that cannot be built either."""
    built = ", ".join(sorted(no_wheel - nothing))
    if barred := ", ".join(sorted(nothing - set(OPTIONAL))):
        return (f"no: {barred}",) * 4 + (built,)
    yes = "if built" if built else "yes"
    wires, rays = (f"no: {name}" if name in nothing else yes for name in ("ur-rtde", "embreex"))
    return wires, "over one corner: no ompl" if "ompl" in nothing else yes, yes, rays, built


def main(path: Path) -> None:
    """Ask for every platform and write the page."""
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    asked = {one.name: f"{one.name}{one.specifier}" for one in map(Requirement, project["dependencies"])}
    rows = []
    for name, platform in PLATFORMS.items():
        for python in PYTHONS:
            rows.append((name, python, *works(*lacking(asked, platform, python))))
            print(*rows[-1], sep=" | ", flush=True)
    table = "".join(f"| {' | '.join(row)} |\n" for row in rows)
    path.write_text(HEAD.format(date=time.strftime("%Y-%m-%d")) + table, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
