"""A job that was read and fits the cell; nothing of it has begun."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cell.check.fit import require_fit
from cell.config.cell_config import CellConfig
from cell.config.job import Job, load_job
from cell.measure.inversion import NominalSurface
from cell.procedures.steps.kinds import Kind, find_kind
from cell.run.resumption import job_source
from statemachine.script import Script


@dataclass(frozen=True, eq=False)
class ReadyJob:
    """A job with its kind, up to the step after which it is to end, its surface, and the script that looks at it.

    `info` is for the journal: what a resumed run has to know.
    """

    job: Job
    kind: Kind
    nominal: NominalSurface
    script: Script
    info: dict[str, Any]

    @classmethod
    def read(
        cls, file: str | Path, config: CellConfig, until: str | None, script: Script, *, calibrates: bool = False
    ) -> ReadyJob:
        """From its file or by its name; `ConfigError` when it does not fit the cell or has no such step.

        With `calibrates` the cell may be calibrated first, with this job's part in the claw.
        """
        job, mesh = load_job(file)
        require_fit(job, config, mesh, calibrates=calibrates)
        kind = find_kind(job.job.kind).until(until)
        kind.require_steps(script.after)
        nominal = NominalSurface.load(mesh, unit=job.surface.mesh_unit)
        info: dict[str, Any] = dict(job_source(file))
        # A resumed run must end where this one was to end, and be looked at as this one was.
        if until is not None:
            info["until"] = until
        if not script.idle:
            info["scripted"] = True
        return cls(job, kind, nominal, script, info)
