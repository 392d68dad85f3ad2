"""Self-contained HTML pages from the templates of this folder: one file, no script, nothing from outside."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoscope.core import messages
from servoscope.core.files import atomic_write
from servoscope.core.messages import message, render, translate, translate_range
from servoscope.report import format_values

if TYPE_CHECKING:
    from jinja2 import Environment

FILTERS = {
    "capitalised": lambda text: str(text)[:1].upper() + str(text)[1:],
    "change": format_values.format_change,
    "clock_time": format_values.format_clock_time,
    "correlation": format_values.pair_correlation,
    "count": format_values.format_count,
    "duration": format_values.format_duration,
    "number": format_values.format_number,
    "percent": format_values.format_percent,
    "plain_name": lambda name: translate(format_values.plain_name(translate(name))),
    "probability": format_values.format_probability,
    "quantity": format_values.format_quantity,
    "ratios": lambda fault: format_values.format_ratios(fault.ratio, *fault.interval),
    "signed_percent": format_values.format_signed_percent,
    "split_symbols": lambda text: format_values.split_symbols(str(text)),
    "symbol_parts": format_values.symbol_parts,
    "word": translate,
    "word_range": lambda cell: type(cell)(translate_range(cell)) if isinstance(cell, str) else cell,  # Markup stays so
    "with_std": lambda values: format_values.format_with_std(*values),
}


@dataclass(frozen=True)
class ResultTable:
    """A table of results as plain text, for a page and a terminal alike.

    `head` has one name per column; the first `words` columns are text, the others numbers.
    """

    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    words: int = 1

    def without(self, *names: str) -> ResultTable:
        """Return the table without some of its columns."""
        shown = [i for i, name in enumerate(self.head) if name not in names]
        rows = [tuple(row[i] for i in shown) for row in self.rows]
        return ResultTable(tuple(self.head[i] for i in shown), rows, sum(i < self.words for i in shown))


def render_page(template: str, *, package: str = "servoscope.report", **values: Any) -> str:
    """Return a page.

    `template`: file in the folder ``templates`` of `package`, which extends ``base.html`` of this package and may use
    its ``macros.html``; `values`: what the template names: ``title`` and ``kind`` (a class of report.css that gives
    the tone: ``fault``, ``healthy``, ``care`` or ``undetermined``) of every page, and its own.
    """
    return _environment(package).get_template(template).render(values, language=messages.LANGUAGE)


def write_page(path: str | Path, content: str) -> None:
    """Write a page; nothing half-written stays behind.

    Raises OutputError if the file cannot be written.
    """
    # A file name that is no valid text must not stop the report on the file.
    atomic_write(path, content.encode("utf-8", errors="replace"))


def say(key: str, **values: Any) -> str:
    """Return a message of the catalogue as text."""
    return render(message(key, **values))


@functools.cache
def _environment(package: str) -> Environment:
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined  # late: commands start without it

    loaders = [PackageLoader(name) for name in dict.fromkeys((package, "servoscope.report"))]
    environment = Environment(
        loader=ChoiceLoader(loaders), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= FILTERS
    folder = files("servoscope.report")
    environment.globals["style"] = "".join(
        folder.joinpath(name).read_text(encoding="utf-8") for name in ("palette.css", "report.css")
    )
    environment.globals["say"] = say
    return environment
