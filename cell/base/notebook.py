"""Results in a notebook: a short table, every word escaped."""

from __future__ import annotations

from collections.abc import Iterable

# A reason can be long, and the report has all of it.
_TABLE = """<table><caption>{{ title | truncate(240, true, " …", 0) }}</caption>
{%- for name, value in rows %}<tr><th style='text-align:left'>{{ name | truncate(240, true, " …", 0) }}</th>
<td>{{ value | truncate(240, true, " …", 0) }}</td></tr>{% endfor %}</table>"""


def table(title: str, rows: Iterable[tuple[str, str]]) -> str:
    """An HTML table of names and values under a title; of each no more than 240 characters."""
    from jinja2 import Environment  # only who shows a table waits for it

    return Environment(autoescape=True).from_string(_TABLE).render(title=title, rows=rows)
