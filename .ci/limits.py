"""Figures of the tree beside `.ci/limits.toml`: prints a table, exits 1 where one is over its limit or a limit rose.

`python .ci/limits.py` counts tracked files and imports none of them. A limit that has room is to be lowered by hand.
"""

import ast
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LIMITS = ".ci/limits.toml"
PRODUCT = ("cell", "drivers", "statemachine", "sim_backends")
BRANCHES = (
    ast.If, ast.For, ast.While, ast.IfExp, ast.ExceptHandler, ast.comprehension, ast.With, ast.Assert, ast.match_case,
)  # fmt: skip
LONG_LINES, TANGLED, MANY_ARGUMENTS, SHORT_FILE, FULL_FOLDER, TESTED_LINES, LONG_SENTENCE = 60, 15, 6, 40, 15, 60, 30


COUNTED = (
    "files_under_40_lines", "modules_without_a_test_at_their_address", "functions_over_60_lines", "complexity_over_15",
    "calls_with_6_positional_arguments", "any",
)  # fmt: skip


def git(*words: str) -> str:
    """What a git command prints. Raises `CalledProcessError` where it fails: nothing counted would pass every limit."""
    return subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=True).stdout


def complexity(function: ast.AST) -> int:
    """One more than the branches of a function, those of functions inside it included."""
    nodes = list(ast.walk(function))
    choices = sum(len(node.values) - 1 for node in nodes if isinstance(node, ast.BoolOp))
    return 1 + choices + sum(isinstance(node, BRANCHES) for node in nodes)


def is_kernel(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Whether it is compiled: a kernel's length is that of its arithmetic."""
    return any(re.search("compiled|njit", ast.unparse(decorator)) for decorator in function.decorator_list)


def sentences(text: str) -> list[int]:
    """Words of each sentence of a Markdown text, without code, tables, headings and pictures."""
    text = re.sub(r"```.*?```", "", text, flags=re.S)
    text = "\n".join(line for line in text.splitlines() if not re.match(r"\s*(\||#|!\[)", line))
    blocks = re.split(r"\n\s*\n|\n\s*[-*\d]+[.)]?\s", text)
    found = [part for block in blocks for part in re.split(r"(?<=[.!?])\s+", re.sub(r"\s+", " ", block))]
    return [words for part in found if (words := len(part.split())) > 3]


def mean(words: list[int]) -> float:
    """Rounded to a tenth; 0 of nothing."""
    return round(sum(words) / max(1, len(words)), 1)


def of_code(texts: dict[str, str]) -> Iterator[tuple[str, str]]:
    """Name of a figure and where it was met, for everything that is counted one by one in the product's code."""
    for path, text in texts.items():
        if not path.startswith(tuple(f"{package}/" for package in PRODUCT)):
            continue
        lines = len(text.splitlines())
        if not path.endswith("__init__.py"):
            if lines < SHORT_FILE:
                yield "files_under_40_lines", path
            folder, _, name = path.rpartition("/")
            if lines > TESTED_LINES and f"tests/unit/{folder}/test_{name}" not in texts:
                yield "modules_without_a_test_at_their_address", path
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                where = f"{path}:{node.lineno} {node.name}"
                if (node.end_lineno or 0) - node.lineno + 1 > LONG_LINES and not is_kernel(node):
                    yield "functions_over_60_lines", where
                if complexity(node) > TANGLED:
                    yield "complexity_over_15", where
            elif isinstance(node, ast.Call):
                if len(node.args) >= MANY_ARGUMENTS and not any(isinstance(one, ast.Starred) for one in node.args):
                    yield "calls_with_6_positional_arguments", f"{path}:{node.lineno}"
            elif isinstance(node, ast.Name) and node.id == "Any":
                yield "any", f"{path}:{node.lineno}"


def class_names_twice(texts: dict[str, str]) -> list[str]:
    """Names that more than one class of the product has."""
    product = [text for path, text in texts.items() if path.split("/")[0] in PRODUCT]
    nodes = (node for text in product for node in ast.walk(ast.parse(text)))
    names = Counter(node.name for node in nodes if isinstance(node, ast.ClassDef))
    return sorted(name for name, count in names.items() if count > 1)


def measured() -> tuple[dict[str, float], dict[str, list[str]]]:
    """Every figure, and where each counted one was met."""
    names = [name for name in git("ls-files", "-z", "*.py").split("\0") if name]
    texts = {name: (ROOT / name).read_text(encoding="utf-8") for name in names}
    met: dict[str, list[str]] = {name: [] for name in COUNTED}
    for name, where in of_code(texts):
        met[name].append(where)
    met["class_names_twice"] = class_names_twice(texts)
    folders = Counter(path.rpartition("/")[0] for path in texts if not path.endswith("__init__.py"))
    met["folders_over_15_files"] = [folder for folder, count in folders.items() if count > FULL_FOLDER]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    docs = [w for path in (ROOT / "docs").rglob("*.md") for w in sentences(path.read_text(encoding="utf-8"))]
    size = {path: len(text.splitlines()) for path, text in texts.items()}
    figures: dict[str, float] = {name: len(places) for name, places in met.items()}
    figures["lines_of_cell"] = sum(lines for path, lines in size.items() if path.startswith("cell/"))
    figures["lines_of_python"] = sum(size.values())
    figures["readme_lines"] = len(readme.splitlines())
    figures["readme_bytes"] = len(readme.encode())
    figures["readme_words_a_sentence"] = mean(sentences(readme))
    figures["docs_words_a_sentence"] = mean(docs)
    figures["docs_sentences_over_30_words"] = sum(words > LONG_SENTENCE for words in docs)
    figures["deep_imports_in_readme"] = len(re.findall(r"^\s*(?:from|import) cell\.\w", readme, flags=re.M))
    return figures, met


def read(text: str) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """The limits of a `limits.toml`, and by figure the lines that issues may add."""
    limits = tomllib.loads(text)
    budgets = limits.pop("budget", {})
    # Until figures had budgets of their own, all of them were for `lines_of_python`.
    flat = {issue: budgets.pop(issue) for issue in list(budgets) if not isinstance(budgets[issue], dict)}
    return limits, budgets | ({"lines_of_python": flat} if flat else {})


def flattened(limits: dict[str, float], budgets: dict[str, dict[str, float]]) -> list[tuple[tuple[str, ...], float]]:
    """Each number of a `limits.toml` with its name, that of a budget by figure and issue."""
    rows = [((figure, issue), lines) for figure, issues in budgets.items() for issue, lines in issues.items()]
    return [*(((name,), limit) for name, limit in limits.items()), *rows]


def main() -> int:
    """Compare, and say which limit is broken and where to look."""
    limits, budgets = read((ROOT / LIMITS).read_text(encoding="utf-8"))
    before: dict[tuple[str, ...], float] = {}
    for commit in git("log", "--format=%H", "--", LIMITS).split():
        for name, limit in flattened(*read(git("show", f"{commit}:{LIMITS}"))):
            before[name] = min(limit, before.get(name, limit))
    if rose := [name for name, limit in flattened(limits, budgets) if limit > before.get(name, limit)]:
        sys.exit(f"{', '.join(map(' '.join, rose))}: rose; a limit or a budget in {LIMITS} may only fall")
    figures, met = measured()
    if unpaired := sorted(limits.keys() ^ figures.keys()):
        sys.exit(f"{', '.join(unpaired)}: each figure needs a limit in {LIMITS}, and each limit a figure")
    wrong = False
    for name, limit in limits.items():
        value = figures[name]
        limit += sum(budgets.get(name, {}).values())
        over = value > limit
        wrong |= over
        print(f"{name:<45}{value:>9g} of{limit:>9g}  {'over' if over else ''}")
        if over:
            print(*(f"    {where}" for where in met.get(name, [])[:40]), sep="\n")
    if wrong:
        print(f"Bring the figure down; a limit in {LIMITS} may only fall.")
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())
