"""What is said of a result: sections of facts, sentences, tables and pictures, which every view draws alike.

A builder returns the sections of one result (`diagnosis_document`, for example) in the language that is spoken where it
is called. The report page, the terminal and the pages of the server draw them, and know of no result.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, NamedTuple

from servoscope.core.messages import translate
from servoscope.report.page import ResultTable, render_page

HEADLINE, EVIDENCE, DETAILS = 0, 1, 2  # levels: read first; what it rests on; for experts, folded away


class Fact(NamedTuple):
    """A name, what is read first, and lines below that."""

    name: str
    value: str
    lines: tuple[str, ...] = ()


@dataclass(frozen=True)
class Facts:
    """Facts side by side."""

    facts: tuple[Fact, ...]
    kind: ClassVar[str] = "facts"


@dataclass(frozen=True)
class Notes:
    """Sentences; `ordered`: as a list whose first entry comes first, `tone`: a list of warnings."""

    texts: tuple[str, ...]
    ordered: bool = False
    kind: ClassVar[str] = "notes"


@dataclass(frozen=True)
class PicturePart:
    """A picture by its name; a view that has none of this name leaves it out."""

    name: str
    kind: ClassVar[str] = "picture"


Part = Facts | Notes | ResultTable | PicturePart


class Section(NamedTuple):
    """A part of a document under a title; the first one of a document has the verdict as its title.

    `lead`: how the section is read, shown above it where there is room.
    """

    title: str
    body: tuple[Part, ...]
    level: int
    lead: str = ""

    def drawn(self, pictures: Container[str] = ()) -> Section:
        """Return it with these pictures alone."""
        return self._replace(body=tuple(p for p in self.body if not isinstance(p, PicturePart) or p.name in pictures))


Document = tuple[Section, ...]


def with_pictures(document: Document, pictures: Container[str] = ()) -> Document:
    """Return the sections that are left where there are these pictures alone."""
    drawn = (section.drawn(pictures) for section in document)
    return tuple(section for section in drawn if section.body)


def to_html(document: Document, pictures: Mapping[str, str], **about: Any) -> str:
    """Return the sections as a page of one file; `pictures`: SVG by name.

    `about` is what the page says around them: ``title``, ``kind`` (a class of report.css that gives the tone),
    ``label`` of the kind, ``name`` of what was judged, what it is ``about``, and lines on its ``size``.
    """
    return render_page("document.html", sections=with_pictures(document, pictures), pictures=pictures, **about)


def to_json(document: Document) -> list[dict[str, Any]]:
    """Return the sections as plain values, as the pages of the server take them."""
    return [
        {
            "title": translate(section.title),
            "level": section.level,
            "lead": translate(section.lead),
            "body": [_part_values(part) for part in section.body],
        }
        for section in document
    ]


def _part_values(part: Part) -> dict[str, Any]:
    if isinstance(part, Facts):  # a named tuple within a dataclass stays one
        return {"kind": part.kind, "facts": [fact._asdict() | {"name": translate(fact.name)} for fact in part.facts]}
    if isinstance(part, ResultTable):
        return {"kind": part.kind, **asdict(part), "head": tuple(map(translate, part.head))}
    return {"kind": part.kind, **asdict(part)}
