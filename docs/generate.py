"""Writes the pages that code knows best: cell.toml, job.toml, command line, fault codes, and the picture of the rooms.

`python docs/generate.py` writes them; a test compares what it would write with what is there.
"""

import ast
import inspect
import re
import types
import typing
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import typer
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from cell.config.job import Job, PartSection, job_path, load_job
from cell.procedures.steps.kinds import kind_of
from drivers.common.units import parse_quantity
from statemachine.sequence import JobTrigger

DOCS = Path(__file__).parent
ROOT = DOCS.parent
NOTE = "<!-- Written by `python docs/generate.py`; do not edit. -->\n\n"
ROOMS = ("apps", "run", "check", "procedures", "devices", "config", "makes", "motion", "measure", "base")
BESIDE = ("drivers", "statemachine", "sim_backends")
CODE = re.compile(r"(arm|rail|vehicle|camera|laser|claw|sim)\.[a-z_0-9]+")


def row(*cells: str) -> str:
    """A row of a table; bars and line ends inside a cell would end it."""
    return "| " + " | ".join(" ".join(cell.split()).replace("|", "\\|") for cell in cells) + " |\n"


def table(*head: str) -> str:
    """The head of a table."""
    return row(*head) + "|" + "---|" * len(head) + "\n"


# --- cell.toml and job.toml ---


def comments(text: str) -> dict[str, str]:
    """What a TOML file says beside its keys, by `table.key`."""
    found, section = {}, ""
    for line in text.splitlines():
        if head := re.match(r"\[+([\w.]+)\]+", line):
            section = head[1]
        elif pair := re.match(r"(\w+) = .*?\s# (.+)", line):
            found[f"{section}.{pair[1]}"] = pair[2]
    return found


def limits(metadata: tuple[Any, ...]) -> dict[str, Any]:
    """What a validator of `drivers.common.units` was made with: low, high, unit, allowed."""
    functions = [each.func for each in metadata if inspect.isfunction(getattr(each, "func", None))]
    found = [dict(inspect.getclosurevars(each).nonlocals) for each in functions]
    return next((each for each in found if "low" in each), {})


def kind(annotation: Any, metadata: tuple[Any, ...] = ()) -> str:
    """What may be written for an annotation, in words."""
    if known := limits(metadata):
        text = ", ".join(map(str, known.get("allowed", ()))) or f"{known['low']:g} to {known['high']:g}"
        return f"{text} {known.get('unit', '')}".strip()
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return kind(inner[0], inner[1:])
    if origin is typing.Literal:
        return " or ".join(f'`"{each}"`' if isinstance(each, str) else f"`{each}`" for each in inner)
    if origin is tuple:
        each = kind(inner[0])
        return f"list of {each}" if inner[-1] is Ellipsis else f"{len(inner)} × ({each})"
    if origin in (typing.Union, types.UnionType):
        return " or ".join(kind(each) for each in inner if each is not type(None))
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        return f"table `{annotation.__name__}`"
    return {"str": "text", "bool": "`true` or `false`", "int": "whole number", "float": "number"}.get(
        getattr(annotation, "__name__", ""), str(annotation)
    )


def default(field: Any) -> str:
    """A field's default as a file would have it."""
    value, unit = field.default, limits(tuple(field.metadata)).get("unit")
    if value is PydanticUndefined:
        return "required"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    if isinstance(value, int | float):
        return f'`"{value / parse_quantity(f"1 {unit}", unit):g} {unit}"`' if unit else f"`{value:g}`"
    return "none" if value is None else "`[]`" if value == () else "optional"


def keys(model: type[BaseModel], section: str, told: dict[str, str]) -> str:
    """The keys of a record as a table."""
    text = table("key", "allowed", "default", "meaning")
    for name, field in model.model_fields.items():
        text += row(
            f"`{name}`", kind(field.annotation, tuple(field.metadata)), default(field),
            told.get(f"{section}.{name}", ""),
        )  # fmt: skip
    return text + "\n"


def summary(thing: Any) -> str:
    """The first paragraph of a thing's docstring."""
    return summary_of(inspect.getdoc(thing))


def summary_of(docstring: str | None) -> str:
    """The first paragraph of a docstring."""
    return " ".join((docstring or "").split("\n\n")[0].split())


def records(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    """The records that fields of this one are made of, each once, those of Table `Pose` among them."""
    for field in model.model_fields.values():
        for each in re.findall(r"table `(\w+)`", kind(field.annotation, tuple(field.metadata))):
            yield from (found for found in known_records() if found.__name__ == each)


def known_records(of: type[BaseModel] | None = None) -> list[type[BaseModel]]:
    """All records that are imported."""
    from drivers.make import Table

    found = [each for part in (of or Table).__subclasses__() for each in (part, *known_records(part))]
    return list(dict.fromkeys(found))


def inner(models: list[type[BaseModel]], told: dict[str, str]) -> str:
    """The tables inside tables, each once."""
    todo, text, done = [each for model in models for each in records(model)], "", set[str]()
    while todo:
        model = todo.pop(0)
        if model.__name__ not in done and model not in models:
            done.add(model.__name__)
            text += f"### {model.__name__}\n\n{summary(model)}\n\n{keys(model, '', told)}"
            todo += records(model)
    return f"## Tables inside tables\n\n{text}" if text else ""


def cell_toml() -> str:
    """The page of `cell.toml`."""
    from cell.config.cell_config import DEVICES, CalibrationConfig, CellConfig, CellSection, default_toml
    from cell.makes import BUILT_IN

    told = comments(default_toml())
    text = "# cell.toml\n\n" + NOTE
    text += 'Every quantity carries its unit, such as `"35 mm"`. A bare number is refused. '
    text += "So is an unknown key, and a value outside its range.\n\n"
    text += f"## [cell]\n\n{summary(CellSection)}\n\n{keys(CellSection, 'cell', told)}"
    models: list[type[BaseModel]] = [CellSection]
    for sort in dict.fromkeys(DEVICES.values()):
        tables = [name for name, of in DEVICES.items() if of == sort]
        text += "## " + ", ".join(f"[{name}]" for name in tables) + "\n\n"
        for make in (each for each in BUILT_IN if each.kind == sort):
            models.append(make.record)
            text += (
                f'### driver = "{make.name}" ({sort})\n\n{summary(make.record)}\n\n{keys(make.record, tables[0], told)}'
            )
    models.append(CalibrationConfig)
    text += f"## [calibration]\n\n{summary(CalibrationConfig)}\n\n{keys(CalibrationConfig, 'calibration', told)}"
    obstacle = next(
        each for each in known_records() if each.__name__ in kind(CellConfig.model_fields["obstacle"].annotation)
    )
    models.append(obstacle)
    text += f"## [[obstacle]]\n\n{summary(obstacle)}\n\n{keys(obstacle, 'obstacle', told)}"
    return text + inner(models, told)


def job_toml() -> str:
    """The page of a job's file."""
    from cell.apps.new_job.questions import job_text

    part = PartSection.model_validate({"mesh": "part.stl", "mesh_unit": "mm"})
    pot = load_job("pot")[0]
    place = pot.place.model_copy(update={"accept": pot.place.tolerance})
    # `pot` says most. What it leaves out `cell new-job` says for any job, the others for themselves alone.
    shipped = [
        comments(job_path(name).read_text(encoding="utf-8")) for name in ("two-stations", "unload", "shell", "pot")
    ]
    written = comments(job_text(pot.model_copy(update={"part": part, "place": place}), []))
    told = shipped[0] | shipped[1] | shipped[2] | written | shipped[3]
    text, models = "# job.toml\n\n" + NOTE, list(records(Job))
    text += '`cell new-job` writes such a file for a mesh. Every quantity carries its unit, such as `"35 mm"`.\n\n'
    for name, field in Job.model_fields.items():
        (model,) = [each for each in models if f"`{each.__name__}`" in kind(field.annotation)]
        shown = f"[[{name}]]" if kind(field.annotation).startswith("list") else f"[{name}]"
        text += f"## {shown}\n\n{summary(model)}\n\n{keys(model, name, told)}"
    return text + inner(models, told)


# --- command line ---


def commands(command: Any, path: str) -> Iterator[tuple[str, Any]]:
    """A command and those below it, with the words that call them."""
    if hasattr(command, "commands"):
        for name, each in sorted(command.commands.items()):
            if not each.hidden and path + name not in ("cell bench", "cell paper"):
                yield from commands(each, f"{path}{name} ")
    if command.callback is not None and path.strip() != "cell":
        yield path.strip(), command


def command_line() -> str:
    """The page of the command line."""
    from cell.apps.cli.app import app

    text = "# Command line\n\n" + NOTE
    text += "Exit codes: 0 success, 1 a refused or failed run, 2 a wrong command line, configuration or job, "
    text += "130 an interrupt.\n"
    text += "`cell COMMAND --help` prints the same. `cell --version` names the version. `cell --install-completion` "
    text += "completes commands, runs, jobs, devices, steps and faults in your shell.\n\n"
    for path, command in commands(typer.main.get_command(app), "cell "):
        text += f"## {path}\n\n" + re.sub(r"\s*\n\s*", " ", (command.help or "").split("\f")[0].strip()) + "\n\n"
        shown = [each for each in command.params if not getattr(each, "hidden", False) and each.name != "help"]
        if shown:
            text += table("argument or option", "meaning")
        for each in shown:
            names = ", ".join(f"`{name}`" for name in (*each.opts, *each.secondary_opts))
            option = each.opts[0].startswith("-")
            text += row(names if option else f"`{each.metavar or each.name.upper()}`", getattr(each, "help", "") or "")
        text += "\n"
    return text


# --- faults ---

FAULTS = ("DeviceFault", "fault", "_fault", "_made")
"""What makes a fault: device (or none), code, message, hint by position or name."""
Causes = dict[str, tuple[set[str], set[str], set[str]]]


def words(node: ast.AST | None, names: dict[str, str]) -> str:
    """The text of an expression; what is filled in when it happens becomes an ellipsis."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if isinstance(node, ast.JoinedStr):
        return "".join(words(each, names) if isinstance(each, ast.Constant) else "…" for each in node.values)
    if isinstance(node, ast.BinOp):
        return words(node.left, names) + words(node.right, names)
    if isinstance(node, ast.IfExp):
        return f"{words(node.body, names)} Or: {words(node.orelse, names)}"
    return names.get(node.id, "…") if isinstance(node, ast.Name) else "…"


def texts(nodes: list[Any]) -> dict[str, str]:
    """The texts that assignments among these nodes give names."""
    found = [(target, each.value) for each in nodes if isinstance(each, ast.Assign) for target in each.targets]
    return {target.id: words(value, {}) for target, value in found if isinstance(target, ast.Name)}


def codes(text: str, devices: tuple[str, ...] = ()) -> list[str]:
    """The codes that an argument names; one without its device is that of each of `devices`."""
    both = [text.replace("…", device) for device in devices] if re.fullmatch(r"…\.[a-z_]+", text) else [text]
    return [each for each in both if CODE.fullmatch(each)]


@cache
def causes() -> Causes:
    """What happened, who recovers and what to do, by fault code, as the source has them."""
    found: Causes = {}
    for path in sorted(path for room in ("drivers", "cell") for path in (ROOT / room).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if not (CODE.search(text) or any(f"{maker}(" in text for maker in FAULTS)):
            continue
        tree = ast.parse(text)
        at_top = texts(tree.body)
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                made_in(node, at_top, found, ("laser", "claw") if "relay" in path.parts else ("arm", "rail", "camera"))
            elif isinstance(node, ast.Dict):
                for key, value in zip(node.keys, node.values, strict=True):
                    if codes(words(key, {})) and isinstance(value, ast.Tuple) and len(value.elts) == 3:
                        what, who, hint = value.elts
                        add(found, words(key, {}), words(what, {}), who, words(hint, {}))
    return found


def made_in(function: ast.FunctionDef, at_top: dict[str, str], found: Causes, devices: tuple[str, ...]) -> None:
    """The faults that a function makes."""
    nodes = list(ast.walk(function))
    names = at_top | texts(nodes)
    for node in nodes:
        if not isinstance(node, ast.Call) or getattr(node.func, "id", getattr(node.func, "attr", "")) not in FAULTS:
            continue
        args = [words(each, names) for each in node.args] + ["", ""]
        at = next((i for i, each in enumerate(args) if codes(each, devices)), None)
        if at is not None:
            named = {each.arg: each.value for each in node.keywords}
            what = args[at + 1] if args[at + 1].strip(" …") else summary_of(ast.get_docstring(function))
            hint = words(named["hint"], names) if "hint" in named else args[at + 2]
            for code in codes(args[at], devices):
                add(found, code, what, named.get("recoverable"), hint)


def add(found: Causes, code: str, what: str, recoverable: ast.AST | None, hint: str) -> None:
    """One more place that makes a fault of this code."""
    known = isinstance(recoverable, ast.Constant)
    who = ("the program" if recoverable.value else "a person") if known else "as it happened" if recoverable else ""
    for each, text in zip(found.setdefault(code, (set(), set(), set())), (what, who, hint), strict=True):
        text = re.sub(r"^[\s…:;,.]+", "", text)
        each.update([text] if text.strip(" …") else [])


def faults() -> str:
    """The page of fault codes."""
    from cell.run.recorded_work import CONFIRMED_BY_A_PERSON

    text = "# Fault codes\n\n" + NOTE
    text += "What happened and what to do are the words of who raises the fault; … stands for a value. "
    text += "[Recover from a fault](../how-to/recover.md) says how.\n\n"
    found = causes()
    for device in sorted({code.split(".")[0] for code in found}):
        text += f"## {device}\n\n" + table("code", "what happened", "recovered by", "what to do")
        for code in sorted(code for code in found if code.split(".")[0] == device):
            what, who, hint = ("<br>".join(sorted(each)) for each in found[code])
            who = "the program, after a person confirms" if code in CONFIRMED_BY_A_PERSON else who
            text += row(f"`{code}`", what or "see the message", who, hint)
        text += "\n"
    return text


# --- rooms ---


def room_of(module: str) -> str:
    """The room of a module: the folder below `cell`, or one of the packages beside it."""
    parts = module.split(".")
    return parts[1] if parts[0] == "cell" and len(parts) > 1 else parts[0]


def arrows() -> set[tuple[str, str]]:
    """Which room imports which, by the imports at the top level of their modules."""
    found = set()
    for path in (path for room in ("cell", *BESIDE) for path in (ROOT / room).rglob("*.py")):
        here = room_of(".".join(path.relative_to(ROOT).with_suffix("").parts))
        modules = re.findall(r"^(?:from|import) ([\w.]+)", path.read_text(encoding="utf-8"), re.MULTILINE)
        found |= {(here, room_of(module)) for module in modules}
    rooms = {*ROOMS, *BESIDE}
    return {(a, b) for a, b in found if a != b and {a, b} <= rooms}


def rooms_svg() -> str:
    """The rooms in the order of their layers, with an arc for each import: inside `cell` right, beside it left."""
    y = {name: 40 + 52 * i for i, name in enumerate((*ROOMS, *BESIDE))}
    box = '<rect x="280" y="{}" width="160" height="36" rx="6" fill="{}" stroke="#555"/>'
    arc = '<path d="M{} {} C{:.0f} {} {:.0f} {} {} {}" fill="none" stroke="{}" marker-end="url(#a)"/>'
    draw = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 720 720" font-family="sans-serif" font-size="15">',
        '<rect width="720" height="720" fill="white"/>',
        '<defs><marker id="a" markerWidth="8" markerHeight="8" refX="7" refY="4" orient="auto">',
        '<path d="M0 0L8 4L0 8z" fill="context-stroke"/></marker></defs>',
    ]
    for i, (a, b) in enumerate(sorted(arrows(), key=lambda pair: (y[pair[0]], y[pair[1]]))):
        side, reach = (280, -1) if b in BESIDE else (440, 1)
        start, end = y[a] + 6, y[b] - 6 + (i % 3) * 4
        bow = side + reach * (30 + 0.45 * abs(end - start))
        colour = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#8c564b")[list(y).index(a) % 5]
        draw.append(arc.format(side, start, bow, start, bow, end, side, end, colour))
    for name in y:
        shown, fill = (f"cell/{name}", "#eaf2fb") if name in ROOMS else (name, "#f5efe1")
        draw.append(box.format(y[name] - 18, fill))
        draw.append(f'<text x="360" y="{y[name] + 5}" text-anchor="middle">{shown}</text>')
    return "\n".join((*draw, "</svg>\n"))


# --- the sequence ---


def sequence_page() -> str:
    """The page about the sequence, with its diagram drawn anew."""
    there = (DOCS / "explanation/sequence.md").read_text(encoding="utf-8")
    return re.sub(r"(?<=```mermaid\n).*?(?=```)", diagram(), there, count=1, flags=re.DOTALL)


def diagram() -> str:
    """The sequence of a job that looks at its placed part, for Mermaid; what all steps or states share is one arrow."""
    sequence = kind_of(load_job("shell")[0]).sequence()
    steps, states = set(sequence.steps), {str(row.source) for row in sequence.table}
    inside: dict[str, None] = {}
    around: dict[str, None] = {}
    for row in sequence.table:
        alike = [other for other in sequence.table if other.trigger is row.trigger]
        sources = {str(other.source) for other in alike if other.target == row.target}
        targets = {str(other.target) for other in alike if other.source == row.source}
        source = "any_state" if sources == states else "job" if steps <= sources and row.source in steps else row.source
        target = "job" if targets == steps else str(row.target)
        # To any step up to the one where it stands: one arrow says as much as all of them.
        if row.trigger is JobTrigger.AGAIN:
            source = target = "job"
        label = row.trigger.value + (f" [{row.guard.value}]" if row.guard.value else "")
        (inside if {source, target} <= steps else around)[f"{source} --> {target} : {label}"] = None
    lines = ["stateDiagram-v2", "    direction LR", "    state job {", "        direction LR"]
    lines += [*(f"        {edge}" for edge in inside), "    }", '    state "any state" as any_state']
    lines += ["    [*] --> idle", *(f"    {edge}" for edge in around)]
    lines += [f"    {end} --> [*]" for end in ("placed", "refused", "misplaced", "faulted", "aborted")]
    return "\n".join(lines) + "\n"


PAGES = {
    "explanation/sequence.md": sequence_page,
    "reference/cell-toml.md": cell_toml,
    "reference/job-toml.md": job_toml,
    "reference/command-line.md": command_line,
    "reference/faults.md": faults,
    "images/rooms.svg": rooms_svg,
}

if __name__ == "__main__":
    for page, written in PAGES.items():
        (DOCS / page).write_text(written(), encoding="utf-8")
