"""`python docs/measure.py [WORDS …]` runs the commands of `docs/results/rows.toml` and writes what they give.

A row is chosen by words of its command; without words all are run, which takes hours. Each row of the page's table gets
the figure, the date and the commit. A tree with changes that are not committed is refused: nobody could repeat it.
`--from FILE` takes the JSON that the one chosen command has printed already.
"""

import argparse
import json
import shlex
import subprocess
import sys
import tomllib
from datetime import date
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"


def git(*words: str) -> str:
    """What git prints."""
    return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def run(command: str) -> dict[str, Any]:
    """What the command prints as JSON; a bench that misses a limit ends with 1 and has a result all the same."""
    print(command, file=sys.stderr)
    done = subprocess.run([*shlex.split(command), "--json"], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    if done.returncode > 1:
        sys.exit(f"{command}: exit code {done.returncode}")
    return dict(json.loads(done.stdout))


def written(page: str, row: dict[str, str], figure: str, measured: str) -> str:
    """The page with the row replaced; it begins with the row's `what`."""
    lines = page.splitlines()
    made = f"| {row['what']} | {figure} | `{row['command']}` | {measured} |"
    places = [k for k, line in enumerate(lines) if line.startswith(f"| {row['what']} |")]
    if len(places) != 1:
        sys.exit(f'"{row["what"]}" stands {len(places)} times in {row["page"]}; write its row first')
    lines[places[0]] = made
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run what was chosen, row by row."""
    parser = argparse.ArgumentParser(description="Measure again what docs/results/ says.")
    parser.add_argument("words", nargs="*", help="only rows whose command has all of these words")
    parser.add_argument("--from", dest="ready", type=Path, help="the JSON that the one chosen command printed")
    asked = parser.parse_args()
    if git("status", "--porcelain", "--", "cell", "drivers", "statemachine", "sim_backends", "lab"):
        sys.exit("the sources are changed and not committed; commit them first")
    rows = tomllib.loads((RESULTS / "rows.toml").read_text(encoding="utf-8"))["row"]
    chosen = [row for row in rows if all(word in row["command"].split() for word in asked.words)]
    commands = list(dict.fromkeys(row["command"] for row in chosen))
    if not commands or (asked.ready and len(commands) > 1):
        sys.exit(f"{len(commands)} commands are chosen: {'; '.join(commands) or 'see docs/results/rows.toml'}")
    measured = f"{date.today().isoformat()}, {git('rev-parse', '--short', 'HEAD')}"
    for command in commands:
        told = json.loads(asked.ready.read_text(encoding="utf-8")) if asked.ready else run(command)
        for row in (row for row in chosen if row["command"] == command):
            path = RESULTS / row["page"]
            path.write_text(written(path.read_text(encoding="utf-8"), row, row["figure"].format_map(told), measured))
            print(f"{row['page']}: {row['what']}")


if __name__ == "__main__":
    main()
