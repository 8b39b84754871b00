"""URScript's words: a text cut into tokens. Source: the maker's script manual, chapter on the language."""

from __future__ import annotations

import re
from dataclasses import dataclass


class ScriptError(Exception):
    """The text is no URScript: it does not compile, and nothing of it is run.

    `line` and `column` count from 1, 0 where they are not known; `told` is how a controller says it to its clients.
    """

    def __init__(self, words: str, line: int = 0, column: int = 0, told: str = "") -> None:
        super().__init__(words)
        self.line, self.column, self.told = line, column, told or words


def syntax_error(text: str, line: int, column: int, what: str) -> ScriptError:
    """The error of a program `text` at a place; a controller repeats the whole line."""
    rows = text.split("\n")
    row = rows[line - 1] if line <= len(rows) else ""
    return ScriptError(f"line {line}{what}", line, column, f"syntax_error_on_line:{line}:{row}:")


@dataclass(frozen=True)
class Token:
    """One token: `kind` is number, text, name, sign or end (of a statement)."""

    kind: str
    text: str
    line: int
    column: int


_TOKEN = re.compile(
    r"""(?P<space>[ \t\r]+|\#[^\n]*|\$[^\n]*)
    |(?P<end>[\n;])
    |(?P<number>0[xX][0-9a-fA-F]+|(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)
    |(?P<text>"[^"\n]*"|'[^'\n]*')
    |(?P<name>[A-Za-z_]\w*)
    |(?P<sign>==|!=|<=|>=|[-+*/%<>=()\[\],:.])""",
    re.VERBOSE,
)
_UNFINISHED = frozenset(
    ("+", "-", "*", "/", "%", "<", ">", "=", "==", "!=", "<=", ">=", ",", "and", "or", "xor", "not")
)
"""After one of these a statement goes on in the next line."""


def tokens(text: str) -> list[Token]:
    """The tokens of `text`; comments and the editor's `$` labels are dropped. Raises `ScriptError`."""
    found: list[Token] = []
    at, line, begun, depth = 0, 1, 0, 0
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None:
            raise syntax_error(text, line, at - begun + 1, f": {text[at : at + 20]!r} is no URScript")
        column = at - begun + 1
        at, kind, word = match.end(), str(match.lastgroup), match[0]
        if kind == "end":
            whole = depth == 0 and found and found[-1].kind != "end" and found[-1].text not in _UNFINISHED
            if whole:
                found.append(Token("end", "\n", line, column))
            if word == "\n":
                line, begun = line + 1, at
        elif kind != "space":
            depth += (word in "([") - (word in ")]") if kind == "sign" else 0
            found.append(Token(kind, word, line, column))
    found.append(Token("end", "\n", line, len(text) - begun + 1))
    return found


_OPENS = re.compile(r"^[ \t]*(?:def|sec|thread|if|while|switch)\b")
_CLOSES = re.compile(r"^[ \t]*end[ \t\r]*(?:#.*)?$")


class ScriptCollector:
    """Collects the bytes of one script connection into complete texts: programs, and single lines beside them."""

    def __init__(self, longest: int = 1 << 20) -> None:
        """A text of more than `longest` bytes is thrown away."""
        self._longest = longest
        self._rest = b""
        self._lines: list[str] = []
        self._size = self._depth = 0

    def feed(self, data: bytes) -> list[str]:
        """Texts completed by `data`: a `def` or `sec` runs to the `end` that closes it, else each line is one."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        texts = []
        for raw in lines:
            line = raw.decode("utf-8", "replace")
            if not self._depth and not line.strip():
                continue
            self._lines.append(line + "\n")
            self._size += len(raw)
            self._depth += (_OPENS.match(line) is not None) - (_CLOSES.match(line) is not None)
            if self._depth <= 0 and line.lstrip()[:1] not in ("#", ""):
                texts.append("".join(self._lines))
                self._drop()
        if self._size + len(self._rest) > self._longest:
            self._rest = b""
            self._drop()
        return texts

    def _drop(self) -> None:
        self._lines, self._size, self._depth = [], 0, 0
