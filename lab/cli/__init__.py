"""The laboratory's commands, `cell bench` and `cell paper`; `cell` finds them by their entry point.

So nothing of the product imports the laboratory.
"""

import typer

from lab.cli.bench import bench
from lab.cli.paper import paper


def register(app: typer.Typer) -> None:
    """Add `cell bench` and `cell paper` to `app`."""
    app.add_typer(bench, name="bench")
    app.add_typer(paper, name="paper")
