"""Every step of a job works behind the gate, with the token that ends it."""

import math

import pytest

from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.inversion import NominalSurface
from cell.procedures.drive.way import Whereabouts
from cell.procedures.steps.kinds import PLACE
from cell.procedures.steps.workplace import Workplace
from drivers.errors import Aborted
from lab.bench.job.whole_job import NoFrames
from statemachine.control import CancelToken, RunControl
from statemachine.step import StepContext


class AtTheGate(StepContext):
    """The context of a step that asks the gate whether it is to end, as the devices do."""

    def __init__(self, cell: VirtualCell, name: str, control: RunControl) -> None:
        super().__init__(PLACE.policy().of(name), 1, math.inf, {}, cell.clock, lambda event: None, control)
        self._gate = cell.devices.gate

    def check(self) -> None:
        self._gate.require()


def test_every_step_enters_the_gate_with_the_token_that_ends_it(tmp_path):
    config = load_config(None)
    job, mesh = load_job("pot")
    cell = VirtualCell(config, 1)
    nominal = NominalSurface.load(mesh, unit=job.surface.mesh_unit)
    whereabouts = Whereabouts(cell.devices.vehicle)
    workplace = Workplace(config, job, nominal, None, cell.devices, NoFrames(), tmp_path, whereabouts)  # type: ignore[arg-type]
    for name, step in PLACE.work(workplace).items():
        control = RunControl()
        control.abort("enough")
        with cell.devices.gate.entered(CancelToken()):
            with pytest.raises(Aborted, match="enough"):
                step(AtTheGate(cell, name, control))
            # This thread goes on with what it did before.
            cell.devices.gate.require()
