"""The installed packages against what this program's distribution asks for, with its pins."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import PackageNotFoundError, packages_distributions, requires, version
from importlib.util import find_spec
from pathlib import Path

from packaging.requirements import Requirement

from cell.apps.doctor.check import DoctorCheck, judged
from cell.base.version import DISTRIBUTION

ALWAYS = ""
"""The name of what is asked for without an extra."""

OWN = ("cell", "drivers", "statemachine", "sim_backends")
"""The top-level packages of this program. Python knows one package by a name, whoever installed it."""


def shadow_check(
    installed: Callable[[], Mapping[str, list[str]]] = packages_distributions, root: Path = Path(__file__).parents[3]
) -> DoctorCheck:
    """Whether another distribution or another folder has a package of the same name as one of ours.

    `installed` gives the distributions by package; `root` is the folder that holds our packages.
    """
    by_name = installed()
    others = {name: sorted(set(by_name.get(name, ())) - {DISTRIBUTION}) for name in OWN}
    for name, distributions in others.items():
        if distributions:
            problem = f"{' and '.join(distributions)} installs a package {name} as well, and one hides the other"
            return judged("package names", problem, "", f"pip uninstall {' '.join(distributions)}; pip install -e .")
    for name in OWN:
        spec = find_spec(name)
        if spec is not None and spec.origin and Path(spec.origin).parents[1] != root:
            problem = f"{name} is imported from {spec.origin}, not from {root}"
            return judged("package names", problem, "", "start Python in another folder, or unset PYTHONPATH")
    return DoctorCheck("package names", "ok", f"{', '.join(OWN)} are this program's")


def asked_for(extras: Iterable[str]) -> dict[str, list[Requirement]]:
    """What is asked for always and with each of these extras: by the checkout's pyproject.toml, which is newer than
    what was noted when it was installed, else by the installed distribution. `PackageNotFoundError` without either."""
    project = Path(__file__).parents[3] / "pyproject.toml"
    if project.is_file():
        table = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
        groups = table.get("optional-dependencies", {})
        lines = {ALWAYS: table["dependencies"], **{extra: groups.get(extra, []) for extra in extras}}
        asked = {extra: map(Requirement, wanted) for extra, wanted in lines.items()}
        return {
            extra: [one for one in wanted if not one.marker or one.marker.evaluate()] for extra, wanted in asked.items()
        }
    found: dict[str, list[Requirement]] = {extra: [] for extra in (ALWAYS, *extras)}
    for requirement in map(Requirement, requires(DISTRIBUTION) or ()):
        marker = requirement.marker
        fitting = [extra for extra in found if marker is None or marker.evaluate({"extra": extra})]
        # What is always asked for fits every extra as well, and stands first.
        for extra in fitting[:1]:
            found[extra].append(requirement)
    return found


def package_checks(
    needed: Iterable[str], others: Iterable[str], installed: Callable[[str], str] = version
) -> list[DoctorCheck]:
    """A row for all that is always asked for, and one for each extra: those that the cell needs, and others."""
    needed, others = list(needed), list(others)
    try:
        asked = asked_for([*needed, *others])
    except PackageNotFoundError:
        return [DoctorCheck("packages", "wrong", f"{DISTRIBUTION} is not installed", "pip install -e .")]
    rows = []
    for extra, requirements in asked.items():
        if not requirements:
            continue
        problems, wanted = [], []
        for requirement in requirements:
            if why := _wrong(requirement, installed):
                problems.append(why)
                wanted.append(f"'{requirement.name}{requirement.specifier}'")
        name = f"packages of the extra {extra}" if extra else "packages"
        mend = f"pip install {' '.join(wanted)}"
        fine = f"{len(requirements)} as {DISTRIBUTION} asks for them"
        rows.append(judged(name, "; ".join(problems), fine, mend, needed=extra in needed or extra == ALWAYS))
    return rows


def _wrong(requirement: Requirement, installed: Callable[[str], str]) -> str:
    try:
        here = installed(requirement.name)
    except PackageNotFoundError:
        return f"{requirement.name} is not installed"
    if requirement.specifier.contains(here, prereleases=True):
        return ""
    return f"{requirement.name} is {here}, asked for is {requirement.specifier}"
