"""A URScript program as the source of a Python one.

Every function and thread becomes a generator that yields where a control cycle ends; a user's function is called with
`yield from`, and so is a command that takes time. A script's names get a `u_` in front, so that it reaches nothing of
Python but what `Machine` gives it. Variables of the program itself, and those declared global, are Python's globals.
Source: the maker's script manual, chapter on the language.
"""

import re
from collections.abc import Collection
from dataclasses import dataclass, field
from itertools import pairwise


class ScriptError(Exception):
    """The text is no URScript: it does not compile, and nothing of it is run. `line` and `column` count from 1, 0 where
    they are not known; `told` is how a controller says it to its clients."""

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


_LEVELS = (("or",), ("xor",), ("and",), ("==", "!=", "<", ">", "<=", ">="), ("+", "-"), ("*", "/", "%"))
"""Binary operators, those that bind least first."""
_KEYWORDS = frozenset(
    (
        *("def", "sec", "thread", "end", "if", "elif", "else", "while", "switch", "case", "default", "break"),
        *("continue", "return", "halt", "global", "local", "run", "kill", "join", "and", "or", "xor", "not"),
        *("True", "False", "enter_critical", "exit_critical"),
    )
)


@dataclass
class _Function:
    """What is known of the function that is being translated."""

    outermost: bool
    mine: set[str] = field(default_factory=set)
    """Its parameters and what it declares local."""
    assigned: set[str] = field(default_factory=set)


@dataclass(frozen=True)
class Translation:
    """The Python `source` and the `name` of the program, whose generator is `u_` + name."""

    source: str
    name: str
    places: list[tuple[int, int]]
    """Line and column of the script for each line of the source."""


def translate(text: str, commands: Collection[str], waiting: Collection[str]) -> Translation:
    """`commands` are those that act at once, `waiting` those that take time. Raises `ScriptError`."""
    return _Translator(text, commands, waiting).program()


class _Translator:
    def __init__(self, text: str, commands: Collection[str], waiting: Collection[str]) -> None:
        self._text = text
        self._words = words = tokens(text)
        self._at = 0
        self._commands, self._waiting = commands, waiting
        pairs = list(pairwise(words))
        self._functions = {after.text for word, after in pairs if word.text in ("def", "thread")}
        self._globals = {after.text for word, after in pairs if word.text == "global"}
        self._lines: list[str] = []
        self._places: list[tuple[int, int]] = []
        self._place = (1, 1)
        self._indent = 0
        self._function = _Function(outermost=True)
        self._choices = 0

    def program(self) -> Translation:
        while self._words and self._now.kind == "end" and self._at < len(self._words) - 1:
            self._at += 1
        if self._now.text in ("def", "sec"):
            name = self._words[self._at + 1].text
            self._define(outermost=True)
        else:
            name = "unnamed"
            self._body("unnamed", [], _Function(outermost=True), until=())
        while self._at < len(self._words):
            if self._take().kind != "end":
                raise self._error("goes on after its end")
        return Translation("\n".join(self._lines) + "\n", name, self._places)

    @property
    def _now(self) -> Token:
        return self._words[min(self._at, len(self._words) - 1)]

    def _take(self) -> Token:
        word = self._now
        self._at += 1
        return word

    def _expect(self, text: str) -> None:
        if self._take().text != text:
            self._at -= 1
            raise self._error(f"has {self._now.text!r} where {text!r} is needed")

    def _name(self) -> str:
        word = self._take()
        if word.kind != "name" or word.text in _KEYWORDS:
            self._at -= 1
            raise self._error(f"has {word.text!r} where a name is needed")
        return word.text

    def _error(self, what: str) -> ScriptError:
        return syntax_error(self._text, self._now.line, self._now.column, f" {what}")

    def _write(self, line: str) -> None:
        self._insert(len(self._lines), line)

    def _insert(self, at: int, line: str) -> None:
        self._lines.insert(at, "    " * self._indent + line)
        self._places.insert(at, self._place)

    def _define(self, outermost: bool = False) -> None:
        self._take()
        name = self._name()
        function = _Function(outermost)
        parameters = []
        self._expect("(")
        while self._now.text != ")":
            parameter = self._name()
            function.mine.add(parameter)
            default = ""
            if self._now.text == "=":
                self._take()
                default = "=" + self._expression()
            parameters.append(f"u_{parameter}{default}")
            if self._now.text != ")":
                self._expect(",")
        self._expect(")")
        self._expect(":")
        self._body(name, parameters, function, until=("end",))
        self._take()

    def _body(self, name: str, parameters: list[str], function: _Function, until: tuple[str, ...]) -> None:
        outer, self._function = self._function, function
        self._write(f"def u_{name}({', '.join(parameters)}):")
        self._indent += 1
        place = len(self._lines)
        self._write("if False: yield")
        self._write("turn()")
        self._statements(until)
        shared = sorted(f"u_{name}" for name in function.assigned - function.mine)
        if shared:
            self._insert(place, "global " + ", ".join(shared))
        self._indent -= 1
        self._function = outer

    def _block(self, *until: str) -> None:
        self._indent += 1
        self._write("pass")
        self._statements(until)
        self._indent -= 1

    def _statements(self, until: tuple[str, ...]) -> None:
        while self._now.text not in until:
            if self._at >= len(self._words):
                if until:
                    raise self._error(f"ends without {until[0]!r}")
                return
            if self._now.kind == "end":
                self._at += 1
            else:
                self._statement()

    def _statement(self) -> None:
        word = self._now.text
        self._place = self._now.line, self._now.column
        if word in ("def", "thread"):
            self._define()
        elif word == "while":
            self._while()
        elif word == "if":
            self._if()
        elif word == "switch":
            self._switch()
        elif word in ("break", "continue"):
            self._write(self._take().text)
        elif word == "return":
            self._take()
            self._write("return" if self._now.kind == "end" else f"return {self._expression()}")
        elif word == "halt":
            self._take()
            self._write("halt()")
        elif word in ("enter_critical", "exit_critical"):
            # Threads change over only where a cycle ends: each is alone in between.
            self._take()
        elif word in ("kill", "join"):
            self._take()
            self._write(("yield from " if word == "join" else "") + f"{word}({self._expression()})")
        elif word in ("global", "local"):
            self._declare(own=word == "local")
        else:
            self._assign_or_act()
        if self._now.kind != "end" and self._now.text not in ("end", "elif", "else", "case", "default"):
            raise self._error(f"has {self._now.text!r} after a statement")

    def _while(self) -> None:
        self._take()
        self._write(f"while {self._condition()}:")
        self._indent += 1
        self._write("turn()")
        self._indent -= 1
        self._block("end")
        self._take()

    def _declare(self, *, own: bool) -> None:
        self._take()
        name = self._name()
        if own:
            self._function.mine.add(name)
        self._assign(name, f"u_{name}")

    def _assign_or_act(self) -> None:
        name = self._now.text
        target = self._expression()
        if self._now.text != "=":
            self._write(target)
        elif target == f"u_{name}":
            self._assign(name, target)
        else:
            self._take()
            self._write(f"{target} = own({self._expression()})")

    def _assign(self, name: str, target: str) -> None:
        self._expect("=")
        value = self._expression()
        function = self._function
        if function.outermost:
            self._globals.add(name)
        if name in self._globals:
            function.assigned.add(name)
        else:
            function.mine.add(name)
        self._write(f"{target} = own({value})")

    def _condition(self) -> str:
        condition = self._expression()
        self._expect(":")
        return condition

    def _if(self) -> None:
        word = "if"
        while word in ("if", "elif"):
            self._place = self._now.line, self._now.column
            self._take()
            self._write(f"{word} {self._condition()}:")
            self._block("elif", "else", "end")
            word = self._now.text
        if word == "else":
            self._take()
            self._expect(":")
            self._write("else:")
            self._block("end")
        self._take()

    def _switch(self) -> None:
        self._take()
        self._choices += 1
        choice = f"choice_{self._choices}"
        self._write(f"{choice} = {self._condition()}")
        word = "if"
        while True:
            while self._now.kind == "end":
                self._take()
            kind = self._take().text
            if kind == "case":
                self._write(f"{word} {choice} == ({self._condition()}):")
                word = "elif"
            elif kind == "default":
                self._expect(":")
                self._write("else:" if word == "elif" else "if True:")
            elif kind == "end":
                return
            else:
                self._at -= 1
                raise self._error(f"has {kind!r} in a switch")
            self._block("end")
            self._take()

    def _expression(self, level: int = 0) -> str:
        if level == len(_LEVELS):
            return self._unary()
        left = self._expression(level + 1)
        while self._now.text in _LEVELS[level] and self._now.kind != "text":
            operator = self._take().text
            right = self._expression(level + 1)
            if operator == "xor":
                left = f"(bool({left}) != bool({right}))"
            else:
                left = f"({left} {operator} {right})"
        return left

    def _unary(self) -> str:
        if self._now.text == "not":
            self._take()
            return f"(not {self._expression(3)})"
        if self._now.text in ("-", "+"):
            sign = self._take().text
            return f"({sign}{self._unary()})"
        return self._members(self._primary())

    def _members(self, value: str) -> str:
        while True:
            if self._now.text == "[":
                self._take()
                value += f"[{self._expression()}]"
                if self._now.text == ",":
                    self._take()
                    value += f"[{self._expression()}]"
                self._expect("]")
            elif self._now.text == ".":
                self._take()
                value += f".u_{self._name()}"
                if self._now.text == "(":
                    value += self._arguments("")
            else:
                return value

    def _primary(self) -> str:
        word = self._take()
        if word.kind == "number":
            return str(int(word.text, 16)) if word.text[:2] in ("0x", "0X") else _decimal(word.text)
        if word.kind == "text":
            return repr(word.text[1:-1])
        if word.text == "(":
            inner = [self._expression()]
            while self._now.text == ",":
                self._take()
                inner.append(self._expression())
            self._expect(")")
            # Clients write lists in round brackets too, and controllers take them.
            return f"({inner[0]})" if len(inner) == 1 else f"List([{', '.join(inner)}])"
        if word.text == "[":
            return f"List({self._elements()})"
        if word.text == "p" and self._now.text == "[":
            self._take()
            return f"Pose({self._elements()})"
        if word.text in ("True", "False"):
            return word.text
        if word.text == "run":
            name = self._name()
            return f"run({name!r}, u_{name}{self._arguments('u_')})"
        self._at -= 1
        name = self._name()
        return self._call(name) if self._now.text == "(" else f"u_{name}"

    def _call(self, name: str) -> str:
        if name in self._functions:
            return f"(yield from u_{name}{self._arguments('u_')})"
        if name in self._waiting:
            return f"(yield from {name}{self._arguments('')})"
        if name in self._commands:
            return f"{name}{self._arguments('')}"
        word = self._words[self._at - 1]
        raise ScriptError(
            f"line {word.line} calls {name!r}, which is neither a function of it nor a command of this controller",
            word.line, word.column, f"compile_error_name_not_found:{name}:",
        )  # fmt: skip

    def _elements(self) -> str:
        values = []
        while self._now.text != "]":
            values.append(self._expression())
            if self._now.text != "]":
                self._expect(",")
        self._take()
        return "[" + ", ".join(values) + "]"

    def _arguments(self, prefix: str) -> str:
        values = []
        self._expect("(")
        while self._now.text != ")":
            after = self._words[min(self._at + 1, len(self._words) - 1)]
            if self._now.kind == "name" and after.text == "=":
                name = self._name()
                self._take()
                values.append(f"{prefix}{name}={self._argument(prefix)}")
            else:
                values.append(self._argument(prefix))
            if self._now.text != ")":
                self._expect(",")
        self._take()
        return "(" + ", ".join(values) + ")"

    def _argument(self, prefix: str) -> str:
        """A script's own functions get copies."""
        value = self._expression()
        return f"own({value})" if prefix else value


def _decimal(text: str) -> str:
    """Python takes no 007 for a number."""
    return text.lstrip("0") or "0" if text.isdigit() else text
