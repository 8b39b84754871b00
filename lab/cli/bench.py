"""The commands of `cell bench`: campaigns and comparisons of accuracy and speed, beside their bounds and peers.

Each imports its bench only when it runs, so that `cell --help` stays quick.
"""

from typing import Annotated

import typer

from cell.apps.cli import options
from cell.apps.cli.options import JobOption, JsonOption, Level, LevelOption, SeedOption
from lab.cli.shown import bar, counted, show

bench = typer.Typer(
    help="Campaigns and comparisons: accuracy and speed, beside their bounds and peers.", no_args_is_help=True
)
WorldsOption = Annotated[int, typer.Option("--seeds", min=1, max=1000, help="How many worlds: seeds 1 to this.")]
WorkersOption = Annotated[int, typer.Option("--workers", min=0, max=64, help="Processes; 0 is one a core.")]


@bench.command()
def acceptance(seed: SeedOption = 1, level: LevelOption = Level.nominal, json: JsonOption = False) -> None:
    """Probing error, sphere spacing error and flatness after VDI/VDE 2634 part 2 and ISO 10360-13, simulated. A ball at
    ten places of the measuring volume, a ball bar at seven, a flat at six; the worst place counts."""
    from lab.bench.acceptance.campaign import PLACES
    from lab.bench.acceptance.campaign import acceptance as campaign

    with bar() as told:
        result = campaign(seed, level.value, counted(told, PLACES))
    show(result, json, without=("positions",))


@bench.command()
def accuracy(
    seeds: WorldsOption = 20,
    level: Annotated[
        list[Level] | None, typer.Option("--level", help="How far they deviate from the drawing; may be repeated.")
    ] = None,
    job: JobOption = "pot",
    workers: WorkersOption = 0,
    json: JsonOption = False,
) -> None:
    """Calibrate and run many simulated cells on the virtual clock and measure them against the truth.

    At each level the acceptance tests of `cell bench acceptance` are done too, on the first seed's scan head.

    Exit code 1 when a part was placed outside the job's tolerance, or a limit of level nominal is not kept.
    """
    from lab.bench.job.accuracy import campaign

    levels = list(dict.fromkeys(entry.value for entry in level or [Level.nominal]))
    with bar() as told:
        told(0, "the first runs are on their way")
        done = counted(told, (seeds + 1) * len(levels))
        result = campaign(range(1, seeds + 1), levels, job, done, workers)
    by_level = result["levels"]
    outside = sum(entry["outcomes"]["placed_outside_tolerance"] for entry in by_level.values())
    failed = outside or not all(entry.get("within_limits", True) for entry in by_level.values())
    show(result if json else by_level, json, without=("per_run", "positions"), failed=failed)


@bench.command()
def board(
    views: Annotated[int, typer.Option(min=1, max=10_000, help="Random views for each kind of board and line.")] = 4,
    seed: Annotated[int, typer.Option(min=0, help="Which random views.")] = 1,
    kind: Annotated[list[str] | None, typer.Option(help="Only this kind of board; may be given again.")] = None,
    condition: Annotated[
        list[str] | None, typer.Option(help="Only conditions with this in their name; may be given again.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """How surely boards are found, under which name their points, how exactly, and whether the covariance is true. Exit
    code 1 when a board, or the order of its points, was taken for another."""
    from cell.measure.vision.board.view import KINDS
    from drivers.errors import ConfigError
    from lab.bench.board.campaign import campaign
    from lab.bench.board.conditions import CONDITIONS

    kinds = [k for k in KINDS if not kind or k in kind]
    if kind and len(kinds) != len(set(kind)):
        raise ConfigError(f"--kind {', '.join(kind)}: allowed are {', '.join(KINDS)}")
    chosen = [c for c in CONDITIONS if not condition or any(text in c.name for text in condition)]
    if not chosen:
        raise ConfigError(f"no condition is named like that; there are: {', '.join(c.name for c in CONDITIONS)}")
    with bar() as told:
        report = campaign(views, seed, kinds, chosen, counted(told, views * len(kinds) * len(chosen)))
    shown = report if json else {**report, "rows": [row for row in report["rows"] if row["kind"] == "all"]}
    show(shown, json, without=("reasons",), failed=report["wrong"])


@bench.command()
def calibration(
    seeds: Annotated[int, typer.Option(min=2, max=1000, help="How many heads are drawn and calibrated.")] = 30,
    json: JsonOption = False,
) -> None:
    """Calibrate many drawn scan heads and compare errors, z-scores and chi² with what the noise allows. The
    observations are drawn by code that shares nothing with the estimator; all figures are of simulation."""
    from lab.bench.calibration.campaign import campaign
    from lab.bench.calibration.world import Noise

    with bar() as told:
        result = campaign(range(1, seeds + 1), Noise(), counted(told, seeds))
    show(result, json, without=("trials",))


@bench.command()
def cycle(
    job: JobOption = "shell", seed: SeedOption = 1, level: LevelOption = Level.nominal, json: JsonOption = False
) -> None:
    """Where the time of a job goes, first and in the middle of a batch: each motion beside its least time."""
    from lab.bench.job.cycle import cycle as campaign

    with bar() as told:
        told(0, "calibrating")
        result = campaign(str(job), seed, level.value, counted(told, 3))
    show(result, json)


@bench.command()
def endings(
    count: Annotated[int, typer.Option(min=1, max=1000, help="How many kills, and how many signals and aborts.")] = 40,
    seed: SeedOption = 3,
    speed: Annotated[float, typer.Option(min=0.5, max=5, help="How many times faster than the wall.")] = 3.0,
    json: JsonOption = False,
) -> None:
    """End a run at random instants, over all steps, calibration, verification and jogs; exit 1 if anything goes on."""
    import tempfile
    from pathlib import Path

    from lab.bench.wires.endings import campaign, summary

    with tempfile.TemporaryDirectory(prefix="cell-endings-") as folder, bar() as told:
        found = campaign(Path(folder), count, seed, speed, lambda done, text: told(done, text, 2 * count))
    result = summary(found, seed, speed)
    show(result, json, without=("endings",), failed=result["moved_or_shone_after"])


@bench.command()
def inversion(
    starts: Annotated[int, typer.Option("--starts", min=4, help="Starts for each part, near and far.")] = 40,
    cases: Annotated[int, typer.Option("--cases", min=1, help="Scans for each case that must not mislead.")] = 20,
    json: JsonOption = False,
) -> None:
    """Find the pose of five parts from near and far, with clutter and 40 % missing, and refuse what must be refused."""
    from lab.bench.inversion.campaign import CASES, campaign
    from lab.bench.inversion.scenes import PARTS

    with bar() as told:
        report = campaign(starts, cases, counted(told, starts * len(PARTS) + cases * (len(CASES) + 5)))
    show(report, json)


@bench.command()
def placed(
    effect: Annotated[
        list[str] | None, typer.Option("--effect", help="Just this one; may be repeated. All of them without.")
    ] = None,
    seeds: WorldsOption = 5,
    level: LevelOption = Level.nominal,
    job: JobOption = "pot",
    corrections: Annotated[int, typer.Option(min=0, max=5, help="place.corrections of the job.")] = 0,
    accept: Annotated[str | None, typer.Option(help='place.accept of the job, such as "0.05 mm".')] = None,
    workers: WorkersOption = 0,
    json: JsonOption = False,
) -> None:
    """Put effects between surface and part that nobody sees before it is placed, and hold what is seen then against the
    truth. Exit code 1 when a part was placed whose true error exceeds the stated bound."""
    from lab.bench.job.part_effects import EFFECTS
    from lab.bench.job.placed_part import campaign

    chosen = list(dict.fromkeys(effect or EFFECTS))
    place = f"corrections = {corrections}" + ("" if accept is None else f'\naccept = "{accept}"')
    with bar() as told:
        done = counted(told, len(chosen) * seeds)
        result = campaign(range(1, seeds + 1), level.value, job, chosen, place=place, done=done, workers=workers)
    show(result, json, without=("runs",), failed=result["outside_bound"])


@bench.command()
def realism(
    effect: Annotated[
        list[str] | None,
        typer.Option(
            "--effect",
            help="Just this one; may be repeated. All of them, then together.",
            autocompletion=options.effects,
        ),
    ] = None,
    seeds: WorldsOption = 20,
    job: JobOption = "pot",
    workers: WorkersOption = 0,
    json: JsonOption = False,
) -> None:
    """Put each effect of a workshop into simulated cells and see whether what is stated of the part still holds.

    An effect is well when its count of worlds inside the stated 95 % ellipsoid, or refused by the effect's name, is one
    that a true share of 90 % explains: 15 of 20 (95 % confidence). Exit code 1 when one is not, or a part was placed
    outside the job's tolerance.
    """
    from drivers.errors import ConfigError
    from lab.bench.job.realism import ALONE, TOGETHER, campaign, is_well
    from sim_backends.world.levels import OUTDOOR, Effects

    known = (ALONE, *Effects.names(), TOGETHER)
    # No parts of the workshop: a scan camera needs a global shutter, what droops is broken, oil is wiped off. The open
    # has a bench of its own.
    options = ("rolling_shutter", "droop", "oil", *OUTDOOR)
    chosen = list(dict.fromkeys(effect or [name for name in known if name not in options]))
    if unknown := [name for name in chosen if name not in known]:
        raise ConfigError(f"--effect {unknown[0]} is none of {', '.join(known)}")
    with bar() as told:
        result = campaign(chosen, range(1, seeds + 1), job, counted(told, len(chosen) * seeds), workers)
    show(result, json, without=("runs",), failed=not all(is_well(entry) for entry in result["effects"].values()))


@bench.command()
def reconstruction(seed: SeedOption = 1, json: JsonOption = False) -> None:
    """Milliseconds from the last frame of a sweep to the cloud, on profiles of 480 and of 1088 rows."""
    from lab.bench.reconstruction.scenes import speed

    with bar() as told:
        result = speed(seed, told)
    show(result, json)


@bench.command()
def schedules(
    job: Annotated[list[str] | None, typer.Option("--job", "-j", help="A job; may be repeated.")] = None,
    level: Annotated[list[Level] | None, typer.Option("--level", help="Of the worlds; may be repeated.")] = None,
    count: Annotated[int, typer.Option("--count", min=1, max=100_000, help="How many schedules are drawn.")] = 50,
    first_seed: Annotated[int, typer.Option("--first-seed", min=0, help="The first is drawn from this seed.")] = 1,
    schedule: Annotated[
        str | None, typer.Option("--schedule", help="This one as JSON, or a file of them, instead of drawn ones.")
    ] = None,
    workers: WorkersOption = 0,
    json: JsonOption = False,
) -> None:
    """Draw schedules of faults and people's acts, run whole jobs by them, and judge them by the world's truth. Exit
    code 1 when a rule was broken; the smallest schedule that breaks it is shown with the command that repeats it."""
    import tempfile
    from pathlib import Path

    from drivers.errors import ConfigError
    from lab.bench.schedules.schedule import Schedule
    from lab.bench.schedules.search import campaign, repeated

    levels = [each.value for each in level or [Level.nominal]]
    try:
        text = Path(schedule).read_text(encoding="utf-8") if schedule and schedule[0] != "{" else schedule or ""
        given = [Schedule.from_json(line) for line in text.splitlines() if line.strip()]
    except (ValueError, OSError) as error:
        raise ConfigError(f"--schedule: {error}") from error
    with tempfile.TemporaryDirectory(prefix="cell-schedules-") as folder, bar() as told:

        def progress(text: str, done: int, total: int) -> None:
            told(done, f"{done} of {total} {text}", total)

        if given:
            result = repeated(given, Path(folder), workers, progress)
        else:
            jobs = job or ["pot"]
            result = campaign(jobs, levels, count, first_seed, folder=Path(folder), workers=workers, told=progress)
    show(result, json, without=("schedule",), failed=result["violations"])


@bench.command()
def planner(
    pairs: Annotated[int, typer.Option(min=1, max=10_000, help="Random pairs of free postures.")] = 200,
    job: JobOption = "pot",
    seed: SeedOption = 1,
    patience: Annotated[
        float, typer.Option(min=1.0, max=600.0, help="Processor time for a pair that no planner joined, s.")
    ] = 20.0,
    json: JsonOption = False,
) -> None:
    """How many random pairs of free postures the planner joins, how fast, how far apart, beside OMPL's own planners.
    Exit code 1 when it joins less than 99.5 % of those that have a way, or bodies come closer than 5 mm."""
    from lab.bench.job.planner import planner as campaign

    with bar() as told:
        result = campaign(str(job), pairs, seed, patience, counted(told, pairs))
    show(result, json, failed=not result["within_limits"])


@bench.command()
def servo(
    seconds: Annotated[float, typer.Option(min=2.0, max=600.0, help="How long each of the two streams is.")] = 20.0,
    seed: SeedOption = 1,
    json: JsonOption = False,
) -> None:
    """Stream to a simulated arm, first alone, then beside perception; exit 1 if that missed and a bare loop did not. On
    a machine where a loop that only sleeps is late as well, there is no verdict: the figures say so."""
    from lab.bench.wires.servo import measure

    with bar() as told:
        found = measure(seconds, seed, told)
    show(found, json, failed=found["verdict"] == "missed")


@bench.command()
def outdoor(
    seeds: WorldsOption = 3, job: JobOption = "pot", workers: WorkersOption = 0, json: JsonOption = False
) -> None:
    """Jobs under 0 to 100 klx of sun with a moving shadow, wind and uneven ground; with a band-pass filter and without.
    Exit code 1 when a part was placed outside the job's tolerance."""
    from lab.bench.job.outdoor import KLX, campaign

    with bar() as told:
        told(0, "the first runs are on their way")
        result = campaign(job, range(1, seeds + 1), KLX, counted(told, 2 * seeds), workers)
    show(result, json, without=("runs",), failed=any(row["wrong"] for row in result["rows"].values()))


@bench.command()
def soak(
    minutes: Annotated[float, typer.Option(min=0.0, max=10000.0, help="For how long jobs are begun.")] = 60.0,
    job: JobOption = "pot",
    seed: SeedOption = 1,
    speed: Annotated[float, typer.Option(min=0.5, max=5.0, help="How many times faster than the wall.")] = 1.0,
    json: JsonOption = False,
) -> None:
    """Repeat a job over the wires of a simulated cell; exit 1 if memory, threads or handles grow from job to job."""
    from lab.bench.wires.soak import soak as run

    with bar() as told:
        found = run(minutes, seed, job, told, speed=speed)
    show(found, json, without=("processes",), failed=found["verdict"].startswith("grows"))


@bench.command()
def stripe(
    pictures: Annotated[int, typer.Option(min=1, max=100, help="Pictures of 1024 rows for each condition.")] = 3,
    accuracy: Annotated[bool, typer.Option(help="Errors beside the Cramér–Rao bound.")] = True,
    profiles: Annotated[bool, typer.Option(help="Other profiles, widths, texture, colour and depth.")] = True,
    speed: Annotated[bool, typer.Option(help="Time per frame.")] = True,
    json: JsonOption = False,
) -> None:
    """Stripe centres: RMS error, bias and stated deviation beside the bound, and speed."""
    from lab.bench.stripe import campaign

    result = {}
    with bar() as told:
        if speed:
            result["speed"] = campaign.speed(told)
        if accuracy:
            result["accuracy"] = campaign.accuracy(told, pictures)
        if profiles:
            result["profiles"] = campaign.profiles(told, pictures)
    show(result, json)


@bench.command()
def interim(
    seeds: WorldsOption = 20,
    level: LevelOption = Level.nominal,
    checks: Annotated[int, typer.Option("--checks", min=1, max=1000, help="Of each cell that nobody touched.")] = 10,
    workers: WorkersOption = 0,
    json: JsonOption = False,
) -> None:
    """Plant twelve shifts in many calibrated cells, and look at the fine board as a job does before it begins. Exit
    code 1 when a cell that nobody touched is called changed."""
    from lab.bench.calibration.interim import UNTOUCHED, campaign

    with bar() as told:
        told(0, "the first cells are on their way")
        found = campaign(range(1, seeds + 1), level.value, checks, counted(told, seeds), workers)
    show(found, json, without=("runs",), failed=found["shifts"][UNTOUCHED]["found"])


@bench.command()
def verify(
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="How many worlds.")] = 20,
    level: LevelOption = Level.nominal,
    json: JsonOption = False,
) -> None:
    """Find 0.2 mm or 0.05° in every part of the chain, over many simulated worlds (no pictures are rendered)."""
    from lab.bench.calibration.verification import KINDS_OF_CHANGE, campaign, disturbances

    chosen = disturbances()
    with bar() as told:
        progress = counted(told, seeds * (len(chosen) + KINDS_OF_CHANGE + 1))
        found = campaign(range(1, seeds + 1), level.value, chosen, progress)
    show(found, json)
