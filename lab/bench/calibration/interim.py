"""`cell bench interim`: what the look at the fine board before each job finds, and how seldom it is wrong.

Each seed's cell is calibrated and looked at again as it is, then with one thing moved at a time: pictures, arm and
devices are the simulator's, the check is the product's.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cell.config.calibrations.store import CellCalibration
from cell.config.cell_config import load_config
from cell.config.job import load_job
from cell.devices.simulated.direct import VirtualCell
from cell.measure.inversion import NominalSurface
from cell.motion.kinematics import HOME
from cell.procedures.arm.moves import Mover
from cell.procedures.calibrate.interim import InterimCheck, interim_check
from cell.run.recorded_work import WorkContext
from drivers.errors import RefusedError
from lab.bench.job.whole_job import NoFrames, on_calibrated
from lab.bench.over_cores import Done, over_cores
from sim_backends.world.scene import Scene, rotation

Row = dict[str, Any]
UNTOUCHED = "untouched"
CREEP_M = 0.02e-3
CREEPS = 12
"""Jobs that a creeping mount is watched for."""


@dataclass(frozen=True)
class PlantedShift:
    """Something that has moved since the calibration: `put_in` moves it in the true cell."""

    name: str
    put_in: Callable[[VirtualCell], None]


def _scene(change: Callable[[Scene], Scene], cell: VirtualCell) -> None:
    world = cell.world
    world.remake(change(world.scene), world.station)


def _moved(name: str, shift: ArrayLike, turn: ArrayLike, scene: Scene) -> Scene:
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation(np.asarray(turn, dtype=np.float64)), shift
    return replace(scene, **{name: getattr(scene, name) @ motion})


def _lens(focal: float, middle: float, scene: Scene) -> Scene:
    """Focal length by a share of it, and the principal point by so many px."""
    lens = scene.scan_lens
    grown = replace(lens, fx=lens.fx * (1.0 + focal), fy=lens.fy * (1.0 + focal), cx=lens.cx + middle)
    return replace(scene, scan_lens=grown)


def _zero(joint: int, angle: float, cell: VirtualCell) -> None:
    cell.world.arm.shift_zero(joint, angle)


def planted() -> list[PlantedShift]:
    """Twelve: a shift or a turn of the head by axis, joints' zeros, the lens, the board."""
    head = partial(_moved, "flange_from_scan_camera")
    axes = [(name, 1e-4 * np.eye(3)[k], 5e-4 * np.eye(3)[k]) for k, name in enumerate("xyz")]
    made = [
        PlantedShift(f"scan head, .1 mm along {name}", partial(_scene, partial(head, shift, np.zeros(3))))
        for name, shift, _ in axes
    ]
    made += [
        PlantedShift(f"scan head, .5 mrad about {name}", partial(_scene, partial(head, np.zeros(3), turn)))
        for name, _, turn in axes
    ]
    board = partial(_moved, "base_from_fine_board", (2e-4, 0.0, 0.0), np.zeros(3))
    return [
        *made,
        PlantedShift(
            "scan head, 1 mrad about the camera's axis", partial(_scene, partial(head, np.zeros(3), (0, 0, 1e-3)))
        ),
        PlantedShift("last joint's zero, 4 mrad", partial(_zero, 5, 4e-3)),
        PlantedShift("first joint's zero, .3 mrad", partial(_zero, 0, 3e-4)),
        PlantedShift("scan camera's middle, 1.5 px", partial(_scene, partial(_lens, 0.0, 1.5))),
        PlantedShift("scan camera's focal length, 1.5 per mille", partial(_scene, partial(_lens, 1.5e-3, 0.0))),
        PlantedShift("fine board, .2 mm", partial(_scene, board)),
    ]


def campaign(seeds: Sequence[int], level: str, untouched: int, done: Done, workers: int = 0) -> Row:
    """`untouched` checks of each seed's cell as it is, and one under each planted shift; figures in mm."""
    worlds = over_cores([(one_world, level, untouched, seed) for seed in seeds], workers, lambda rows: done("cells"))
    rows, calibrated = [row for world in worlds for row in world], sum(map(bool, worlds))
    names = [UNTOUCHED, *(each.name for each in planted())]
    creeping = [row for row in rows if row["shift"] == CREEPING]
    shifts = {name: _tally([row for row in rows if row["shift"] == name]) for name in names}
    shares = [shifts[each.name]["found"] / max(calibrated, 1) for each in planted()]
    return {
        "level": level, "seeds": len(seeds), "calibrated": calibrated, "shifts": shifts,
        "found": float(np.mean(shares)), "least_found": min(shares),
        "creeping_found_at_mm": _found_at(creeping), "runs": rows,
    }  # fmt: skip


CREEPING = f"scan head, creeps {1e3 * CREEP_M:.2f} mm a job"


def one_world(level: str, untouched: int, seed: int) -> list[Row]:
    """All checks of one cell; none where its calibration is refused."""
    config, (job, mesh) = load_config(None), load_job("pot")
    nominal = NominalSurface.load(mesh, unit=job.surface.mesh_unit)

    def work(cell: VirtualCell, calibration: CellCalibration, context: WorkContext) -> list[Row]:
        mover = Mover(cell.devices.arm, cell.clock, config, job, context.safe_point)

        def look(name: str) -> Row:
            mover.to_joints(HOME)
            begun = cell.clock.now()
            try:
                found = interim_check(
                    config, cell.devices, mover, calibration, job, check=context.check, progress=lambda text: None,
                    keep=NoFrames().keep,
                )  # fmt: skip
            except RefusedError as error:
                return {"seed": seed, "shift": name, "changed": True, "refused": True, "reason": str(error)}
            return {
                "seed": seed, "shift": name, "s": cell.clock.now() - begun, "refused": _refused(found),
                **found.summary(),
            }  # fmt: skip

        rows = [look(UNTOUCHED) for _ in range(untouched)]
        world = cell.world
        as_it_was = world.scene, world.arm.params.dh_error
        for each in planted():
            each.put_in(cell)
            rows.append(look(each.name))
            for joint, angle in enumerate(as_it_was[1][:, 3] - world.arm.params.dh_error[:, 3]):
                world.arm.shift_zero(joint, float(angle))
            world.remake(as_it_was[0], world.station)
        for k in range(1, CREEPS + 1):
            _scene(partial(_moved, "flange_from_scan_camera", (CREEP_M, 0.0, 0.0), np.zeros(3)), cell)
            rows.append({**look(CREEPING), "by_mm": 1e3 * k * CREEP_M})
        return rows

    try:
        return on_calibrated(config, job, nominal, seed, level, work)
    except RefusedError:
        return []


def _refused(found: InterimCheck) -> bool:
    try:
        found.require()
    except RefusedError:
        return True
    return False


def _tally(rows: Sequence[Row]) -> Row:
    timed = [row for row in rows if "looks" in row]
    found, refused = (sum(row[name] for row in rows) for name in ("changed", "refused"))
    return {
        "checks": len(rows), "found": found, "refused": refused,
        "looks": float(np.mean([row["looks"] for row in timed])) if timed else None,
        "place_mm": float(np.mean([row["place_mm"] for row in timed])) if timed else None,
        "s": float(np.mean([row["s"] for row in timed])) if timed else None,
    }  # fmt: skip


def _found_at(rows: Sequence[Row]) -> list[float]:
    """For each seed, how far its mount had crept, mm, when that was found first."""
    first: dict[int, float] = {}
    for row in rows:
        if row["changed"]:
            first.setdefault(row["seed"], row["by_mm"])
    return [round(by, 3) for _, by in sorted(first.items())]
