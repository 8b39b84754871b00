"""What the rows of a campaign are of: the hashes of job, configuration and code, and the key of one world."""

import hashlib
import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Self

from cell.config.cell_config import NO_FILES, CellConfig
from cell.config.job import job_and_item, load_job
from cell.run.resumption import job_hash
from drivers.errors import ConfigError

PACKAGES = ("cell", "drivers", "statemachine", "sim_backends")
SOURCES = (".py", ".toml", ".dbc", ".ply", ".urdf")
DIGITS = 16
HIGHEST_SEED = 999_999
WITHOUT = {"cell": {"runs", "calibrations", *NO_FILES, "meshes", "sim", "confirm"}}
"""What of a configuration changes nothing in a simulated world: where files go, and who answers."""


@dataclass(frozen=True)
class QualifiedCode:
    """A job, by its name and hash, under one configuration and one version of the code."""

    job: str
    job_hash: str
    configuration_hash: str
    code_hash: str

    @classmethod
    def of(cls, job: str | Path, config: CellConfig) -> Self:
        """Of the job of this file or name. Raises `ConfigError` where there is none."""
        whole, number = job_and_item(job)
        name = load_job(whole)[0].job.name.partition("#")[0]
        return cls(
            name if number is None else f"{name}#{number}", job_hash(job), configuration_hash(config), code_hash()
        )

    @property
    def short(self) -> str:
        """Twelve digits that stand for all of it, for names of folders."""
        told = "/".join((self.job, self.job_hash, self.configuration_hash, self.code_hash))
        return hashlib.sha256(told.encode()).hexdigest()[:12]

    def key(self, level: str, seed: int, schedule: str = "") -> str:
        """The key of one world's row."""
        told = "/".join((self.short, level, str(seed), schedule))
        return hashlib.sha256(told.encode()).hexdigest()[:DIGITS]


def configuration_hash(config: CellConfig) -> str:
    """Hash of all that a configuration says of the cell, whatever its comments and the order of its lines."""
    told = config.model_dump(mode="json", exclude=WITHOUT)
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:DIGITS]


@cache
def code_hash() -> str:
    """Hash of the product's source files: a wheel has no version control."""
    made = hashlib.sha256()
    for package in PACKAGES:
        root = Path(str(files(package)))
        for path in sorted(path for path in root.rglob("*") if path.suffix in SOURCES):
            made.update(f"{package}/{path.relative_to(root).as_posix()}\n".encode())
            made.update(hashlib.sha256(path.read_bytes()).digest())
    return made.hexdigest()[:DIGITS]


def require_seeds(first: int, count: int) -> None:
    """`ConfigError` unless these are seeds of simulated worlds."""
    if count < 1:
        raise ConfigError(f"a campaign of {count} worlds is none (allowed: 1 or more); give another count")
    if first < 0 or first + count - 1 > HIGHEST_SEED:
        raise ConfigError(
            f"seeds {first} to {first + count - 1} are not all simulated worlds (allowed: 0 to {HIGHEST_SEED}); give "
            "another --first-seed, or fewer worlds"
        )
