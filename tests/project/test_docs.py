"""What comments cite stands in the repository, with the numbered section that they name."""

import re
from collections.abc import Iterator

import pytest

from tests.support import ROOT

CODE = ("cell", "drivers", "statemachine", "sim_backends", "lab", "tests")
DOCUMENT = re.compile(r"docs/[\w/-]+\.md")
# A citation may go on in the next line, with or without a comment's sign.
SECTION = re.compile(r"(docs/[\w/-]+\.md),\s+(?:#\s+)?sections?\s+(?:#\s+)?(\d+)")


def texts() -> Iterator[tuple[str, str]]:
    """Path and content of each file of code, and of the documents themselves."""
    files = [path for room in CODE for path in (ROOT / room).rglob("*.py")]
    for path in [*files, ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        yield str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")


def sections(document: str) -> list[int]:
    """Numbers of the headings `## N. Title` of a document, in their order."""
    text = (ROOT / document).read_text(encoding="utf-8")
    return [int(number) for number in re.findall(r"^## (\d+)\. ", text, re.MULTILINE)]


def test_every_document_that_is_named_exists():
    named = {(document, path) for path, text in texts() for document in DOCUMENT.findall(text)}
    assert len({document for document, _ in named}) >= 5
    assert [(document, path) for document, path in sorted(named) if not (ROOT / document).is_file()] == []


def test_every_section_that_is_cited_exists():
    cited = {(document, int(number), path) for path, text in texts() for document, number in SECTION.findall(text)}
    assert {document for document, _, _ in cited} >= {"docs/explanation/theory.md", "docs/reference/protocols.md"}
    assert [entry for entry in sorted(cited) if entry[1] not in sections(entry[0])] == []


@pytest.mark.parametrize("document", ["docs/explanation/theory.md", "docs/reference/protocols.md"])
def test_sections_are_numbered_without_gaps(document: str):
    assert sections(document) == list(range(1, len(sections(document)) + 1))


def test_every_place_of_the_walks_exists():
    walks = (ROOT / "docs/explanation/walks.md").read_text(encoding="utf-8")
    places = re.findall(r"^\d+\. `([^`]+)`(?:, `(\w+)`)?:", walks, re.MULTILINE)
    assert len(places) > 20
    for file, name in places:
        assert re.search(rf"^(?:def|class) {name}\b" if name else "", (ROOT / file).read_text("utf-8"), re.MULTILINE), (
            file
        )
