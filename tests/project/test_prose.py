"""Documents and messages are short and plain: their words are counted, and so are long sentences."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from servoscope.core.messages import catalogue

PROJECT = Path(__file__).resolve().parents[2]
DOCS = PROJECT / "docs"
RECORDS = [PROJECT / "benchmarks" / "HISTORY.md", *sorted((DOCS / "decisions").glob("*.md"))]
# without records, and without what scripts/api.py writes from docstrings
PAGES = [
    *(PROJECT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")),
    *(page for page in sorted(DOCS.rglob("*.md")) if page not in RECORDS and page.name != "api.md"),
]
MAX_WORDS = 60_000
MAX_WORDS_OF_RECORDS = 15_000
MAX_WORDS_OF_A_SENTENCE = 35
MAX_SHARE_OF_LONG_SENTENCES = 0.03
MIN_WORDS_OF_A_SENTENCE = 3
# words of everyday speech, each with those of the field
AVOIDED = {
    r"hears?|heard": "detect",
    r"beside": "besides, next to, in addition to, in parallel with",
    r"promis\w*": "guarantee, predict",
    r"rehears\w*": "Monte Carlo simulation",
    r"tells?|told": "distinguish, isolate, report",
    r"stands?(?! for\b)|stood": "is, applies, lasts",
    r"loud\w*": "larger noise",
    r"livel(?:y|ier|iest)": "with more excitation",
    r"mend\w*": "correct, repair",
    r"riddle\w*|gladly|merely": "",
}
MAX_AVOIDED_WORDS = 5  # in all of them: a verdict is called "cannot tell", a product may have such a name
AVOIDED_WORDS = re.compile(rf"\b(?:{'|'.join(AVOIDED)})\b", re.I)


def words(text: str) -> list[str]:
    """Return the words of a page: what is between spaces and has a letter or a digit; markers of figures are none."""
    return [word for word in re.sub(r"<!--.*?-->", "", text, flags=re.S).split() if re.search(r"\w", word)]


def paragraphs(text: str) -> Iterator[str]:
    """Yield the paragraphs of a page, the items of its lists and the cells of its tables, without code."""
    text = re.sub(r"<!--.*?-->", "", text, flags=re.S)
    text = re.sub(r"^ *```.*?^ *```", "", text, flags=re.S | re.M)
    for block in re.split(r"\n\s*\n", text):
        if all(line.startswith("    ") for line in block.split("\n") if line.strip()):
            continue
        parts = [""]
        for line in block.split("\n"):
            if line.lstrip().startswith("|"):
                parts += [*re.split(r"(?<!\\)\|", line.strip().strip("|")), ""]
            elif line.startswith("#"):
                parts.append("")
            elif re.match(r"\s*([-*+]|\d+\.)\s", line):
                parts.append(line)
            else:
                parts[-1] += f" {line.strip()}"
        yield from parts


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences of a page; addresses of links are none of their words."""
    for paragraph in paragraphs(text):
        plain = re.sub(r"\]\([^)]*\)", "]", paragraph)
        for sentence in re.split(r"(?<=[.!?])[\"*)]*\s+(?=[\"*(`\[]*[A-Z0-9`])", plain):
            if len(words(sentence)) >= MIN_WORDS_OF_A_SENTENCE:
                yield sentence


def test_words_and_sentences_are_counted() -> None:
    page = "# Head\n\nOne two three. Four `a b` (six) [seven](x y.md)!\n\n    code\n\n| five cells are here | - |\n"
    assert [len(words(sentence)) for sentence in sentences(page)] == [3, 5, 4]
    assert words("a <!-- table x: y -->b<!-- end --> | --- | 3 %") == ["a", "b", "3"]


def test_the_documents_are_short() -> None:
    assert sum(len(words(page.read_text(encoding="utf-8"))) for page in PAGES) <= MAX_WORDS
    assert sum(len(words(page.read_text(encoding="utf-8"))) for page in RECORDS) <= MAX_WORDS_OF_RECORDS


def test_few_sentences_are_long() -> None:
    found = [(page.name, sentence) for page in PAGES for sentence in sentences(page.read_text(encoding="utf-8"))]
    long = [f"{name}: {text.strip()}" for name, text in found if len(words(text)) > MAX_WORDS_OF_A_SENTENCE]
    assert len(long) <= MAX_SHARE_OF_LONG_SENTENCES * len(found), "\n".join(long)


@pytest.mark.parametrize("language", ["en", "de"])
def test_messages_have_short_sentences(language: str) -> None:
    """A message of several parts, divided by a colon or a semicolon, counts as several sentences."""
    long = {
        key: part
        for key, template in catalogue(language).items()
        for part in re.split(r"(?<=[.;:!?])\s|\|", re.sub(r"\{[^{}]*(\{[^}]*\})?[^{}]*\}", "X", template))
        if len(words(part)) > MAX_WORDS_OF_A_SENTENCE
    }
    assert not long


def test_messages_and_documents_use_the_words_of_the_field() -> None:
    texts = {key: re.sub(r"\{[^{}]*(\{[^}]*\})?[^{}]*\}", "", template) for key, template in catalogue().items()}
    for page in (*PAGES, *RECORDS):
        prose = " ".join(paragraphs(page.read_text(encoding="utf-8")))
        texts[page.name] = re.sub(r"`[^`]*`|\]\([^)]*\)", "", prose)
    avoided = {key: AVOIDED_WORDS.findall(text) for key, text in texts.items()}
    assert sum(map(len, avoided.values())) <= MAX_AVOIDED_WORDS, {key: found for key, found in avoided.items() if found}


FILE = re.compile(r"`(?:[^`\n]*[ =])?((?:[\w.-]+/)+[\w.-]+\.(?:py|md|toml|json|js|svg|png))\b[^`\n]*`")


def test_each_file_that_a_document_names_exists() -> None:
    """Relative to the project, the package, its tests or benchmarks, or the page; capitals stand for any name."""
    places = [PROJECT, PROJECT / "src" / "servoscope", PROJECT / "tests", PROJECT / "benchmarks"]
    missing = []
    for page in (*PAGES, *RECORDS):
        text = re.sub(r"^ *```.*?^ *```", "", page.read_text(encoding="utf-8"), flags=re.S | re.M)
        for path in FILE.findall(text):
            placeholder = re.search(r"\b(?!RESULTS|STUDIES|HISTORY|PAPER|NONLINEAR|RECORDINGS)[A-Z]{3,}\b", path)
            if not placeholder and not any((place / path).exists() for place in (*places, page.parent)):
                missing.append(f"{page.relative_to(PROJECT)}: {path}")
    assert not missing, "\n".join(missing)


def test_each_picture_is_shown_by_a_page() -> None:
    pages = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    pictures = sorted(path for path in (DOCS / "images").rglob("*.*") if path.suffix in (".png", ".svg"))
    assert pictures and [path.name for path in pictures if f"/{path.name})" not in pages] == []
