"""A reader who starts at README finds what he needs: each of ten facts is at most two links away."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from servoscope.cli.examples import EXAMPLES

PROJECT = Path(__file__).resolve().parents[2]
LINK = re.compile(r"(?<!!)\[[^\]]+\]\(([^)#\s]+)(?:#[^)\s]*)?\)")
MAX_CLICKS = 2
# of each fact: the words of the link that a reader looks for in README, none if the fact is there; and its sentence
FACTS = {
    "needed data": ("", r"at least a minute of healthy log.*100 Hz.*with u and y"),
    "supported machines": ("", r"hydraulic cylinder.*yes.*bearing or gearbox.*no:"),
    "first command": ("", r"pip install servoscope-.*servoscope demo"),
    "licence": ("licence", r"BSD 3-Clause License"),
    "what it cannot see": ("cannot see", r"Which combinations are not identified.*Three faults at once"),
    "false alarm rate": ("accuracy", r"False alarms at a budget of one per hour, relative to it.*0\.5 to 2"),
    "how to go live": ("go live", r"servoscope run hall\.toml"),
    "a file format": ("files", r"\| baseline \| \d+ \|.*## Baseline\s+JSON, written by `learn`"),
    "how to cite": ("cite", r"cff-version.*please cite it as below"),
    "how to add a plant": ("add a plant", r"## Add a plant\s"),
}


def plain(page: Path) -> str:
    """Return the text of a page without the markers of figures."""
    return re.sub(r"<!--.*?-->", "", page.read_text(encoding="utf-8"), flags=re.S)


def links(page: Path, words: str) -> Iterator[Path]:
    """Yield the pages that a page links to, in paragraphs or rows of tables that have these words."""
    for part in re.split(r"\n\s*\n|\n(?=\|)", plain(page)):
        for target in LINK.findall(part):
            if words in part.lower() and "://" not in target and (page.parent / target).is_file():
                yield (page.parent / target).resolve()


def clicks(fact: str) -> int | None:
    """Return how many links a reader follows to a fact: the first by its words, later ones whatever they say."""
    words, sentence = FACTS[fact]
    pages = {PROJECT / "README.md"}
    for count in range(MAX_CLICKS + 1):
        if any(re.search(sentence, plain(page), re.S) for page in pages):
            return count
        if count == 0 and not words:
            return None
        pages = {linked for page in pages for linked in links(page, words if count == 0 else "")}
    return None


@pytest.mark.parametrize("fact", FACTS)
def test_a_fact_is_at_most_two_links_from_the_readme(fact: str) -> None:
    assert clicks(fact) is not None


def test_the_readme_says_for_whom_and_what_to_type_at_its_top() -> None:
    """In the first minute: some 200 words."""
    top = " ".join(plain(PROJECT / "README.md").split()[:200])
    assert re.search(r"monitors servo actuators.*It detects a change.*\*\*For\*\* .*engineers", top)
    assert re.search(r"pip install .*servoscope demo", top)


def test_the_readme_shows_the_first_commands_and_five_results() -> None:
    text = (PROJECT / "README.md").read_text(encoding="utf-8")
    commands = re.findall(r"^servoscope (\w+)(?= .*  #| \w+\.)", text, re.M)
    assert commands == ["demo", "init", "learn", "diagnose"] and set(commands) <= set(EXAMPLES)
    measured = text.split("## What was measured")[1].split("\n\n")[1].splitlines()[2:]
    assert len(measured) == 5 and all("<!-- value" in row for row in measured)
