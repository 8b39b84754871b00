"""A run as one page for a browser and for paper: made of what lies in its folder, and of the runs beside it."""

from __future__ import annotations

from base64 import b64encode
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Environment


def render(package: str, name: str, **values: object) -> str:
    """The Jinja2 template `name` that lies in `package`, with these values: all of them are escaped, but for TOML. `raw
    | base64` writes bytes for a `data:` address. Raises `jinja2.UndefinedError` for a value that is not given."""
    return _environment(package).get_template(name).render(values)


@cache
def _environment(package: str) -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined  # only who writes a page waits for it

    made = Environment(loader=PackageLoader(package, ""), undefined=StrictUndefined)
    made.autoescape = lambda name: name is None or ".toml." not in name
    made.trim_blocks = made.lstrip_blocks = True
    made.filters["base64"] = lambda raw: b64encode(raw).decode("ascii")
    return made
