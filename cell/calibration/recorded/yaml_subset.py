"""As much of YAML as pose files use: nested maps and lists by indent, flow lists and maps, numbers and words.

Anchors, multi-line text and types are not read: a file that has them raises ValueError and is named as not understood.
"""

from __future__ import annotations

import re
from typing import Any

Line = tuple[int, str]
PAIR = re.compile(r"""^("[^"]*"|'[^']*'|[^\s\[\]{},"'][^:]*?)\s*:(?:\s+(.*))?$""")


def read_yaml(text: str) -> Any:
    """The maps, lists, numbers and words of a text; a list of those of its documents. Raises ValueError."""
    documents = [lines for part in re.split(r"(?m)^---.*$", text) if (lines := _lines(part))]
    found = [_document(lines) for lines in documents]
    return found if len(found) > 1 else found[0] if found else None


def _document(lines: list[Line]) -> Any:
    value, rest = _block(lines, 0)
    if rest < len(lines):
        raise ValueError(f"{lines[rest][1][:40]!r} does not belong to what is before it")
    return value


def _lines(text: str) -> list[Line]:
    """Indent and content of each line; flow lists that run over several lines are joined."""
    found: list[Line] = []
    depth = 0
    for raw in text.splitlines():
        content = re.sub(r"(^|\s)#.*$", "", raw.expandtabs(4)).rstrip()
        if not content.strip() or content.startswith(("%", "---", "...")):
            continue
        if depth > 0:
            found[-1] = found[-1][0], f"{found[-1][1]} {content.strip()}"
        else:
            found.append((len(content) - len(content.lstrip()), content.strip()))
        depth += sum(content.count(c) for c in "[{") - sum(content.count(c) for c in "]}")
    return found


def _block(lines: list[Line], at: int) -> tuple[Any, int]:
    """The value that begins in line `at`, and the line after it."""
    indent, content = lines[at]
    if content == "-" or content.startswith("- "):
        return _list(lines, at, indent)
    if PAIR.match(content):
        return _map(lines, at, indent)
    return _scalar(content), at + 1


def _list(lines: list[Line], at: int, indent: int) -> tuple[list[Any], int]:
    items: list[Any] = []
    while at < len(lines) and lines[at][0] == indent and (lines[at][1] == "-" or lines[at][1].startswith("- ")):
        rest = lines[at][1][1:]
        inner = indent + 1 + len(rest) - len(rest.lstrip())
        if rest.strip():
            # What follows the dash is the first line of a block of its own.
            lines[at] = inner, rest.strip()
            value, at = _block(lines, at)
        elif at + 1 < len(lines) and lines[at + 1][0] > indent:
            value, at = _block(lines, at + 1)
        else:
            value, at = None, at + 1
        items.append(value)
    return items, at


def _map(lines: list[Line], at: int, indent: int) -> tuple[dict[str, Any], int]:
    found: dict[str, Any] = {}
    while at < len(lines) and lines[at][0] == indent:
        match = PAIR.match(lines[at][1])
        if match is None:
            break
        key = match[1].strip("\"'")
        if key in found:
            raise ValueError(f"the key {key!r} is there twice")
        value = re.sub(r"^!+\S+\s*", "", match[2] or "")
        following = lines[at + 1] if at + 1 < len(lines) else (-1, "")
        if value:
            found[key], at = _scalar(value), at + 1
        elif following[0] > indent or (following[0] == indent and following[1].startswith("- ")):
            found[key], at = _block(lines, at + 1)
        else:
            found[key], at = None, at + 1
    return found, at


def _scalar(text: str) -> Any:
    if text[:1] in "[{":
        value, rest = _flow(text, 0)
        if text[rest:].strip():
            raise ValueError(f"{text[rest:][:40]!r} follows a closed list")
        return value
    if text[:1] in "|>&*":
        raise ValueError(f"{text[:40]!r} is more of YAML than is read here")
    if len(text) > 1 and text[0] in "\"'" and text[-1] == text[0]:
        return text[1:-1]
    try:
        return float(text.replace(".nan", "nan").replace(".inf", "inf"))
    except ValueError:
        return text


def _flow(text: str, at: int) -> tuple[Any, int]:
    """A flow list or map that opens at `at`, and the place after it."""
    closing = "]" if text[at] == "[" else "}"
    items: list[Any] = []
    pairs: dict[str, Any] = {}
    at += 1
    while True:
        while at < len(text) and text[at] in " ,":
            at += 1
        if at >= len(text):
            raise ValueError("a list is not closed")
        if text[at] == closing:
            return (items if closing == "]" else pairs), at + 1
        key = ""
        if closing == "}":
            end = text.find(":", at)
            if end < at + 1:
                raise ValueError(f"{text[at:][:40]!r} is no pair of key and value")
            key, at = text[at:end].strip(" \"'"), end + 1
            while at < len(text) and text[at] == " ":
                at += 1
        if at < len(text) and text[at] in "[{":
            value, at = _flow(text, at)
        else:
            match = re.compile(r"[^,\[\]{}]+").match(text, at)
            if match is None:
                raise ValueError(f"{text[at:][:40]!r} does not belong into a list")
            value, at = _scalar(match[0].strip()), match.end()
        if closing == "}":
            pairs[key] = value
        else:
            items.append(value)
