"""Self-contained HTML pages from the templates of this folder: one file, no script, nothing from outside."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from servoscope.core import messages
from servoscope.core.errors import OutputError
from servoscope.core.files import atomic_write
from servoscope.core.messages import say, translate, translate_range
from servoscope.report import format_values

if TYPE_CHECKING:
    from jinja2 import Environment

BROWSERS = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "msedge",
    "microsoft-edge",
)
PRINT_S = 120.0  # the longest that printing may take
FILTERS = {
    "capitalised": lambda text: str(text)[:1].upper() + str(text)[1:],
    "count": format_values.format_count,
    "duration": format_values.format_duration,
    "percent": format_values.format_percent,
    "plain_name": lambda name: translate(format_values.plain_name(translate(name))),
    "probability": format_values.format_probability,
    "split_symbols": lambda text: format_values.split_symbols(str(text)),
    "symbol_parts": format_values.symbol_parts,
    "word_range": lambda cell: type(cell)(translate_range(cell)) if isinstance(cell, str) else cell,  # Markup stays so
}


@dataclass(frozen=True)
class ResultTable:
    """A table of results as plain text, for a page and a terminal alike.

    `head` has one name per column; the first `words` columns are text, the others numbers.
    """

    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    words: int = 1
    kind: ClassVar[str] = "table"

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
    return _environment(package).get_template(template).render(values, language=messages.current_language())


def write_page(path: str | Path, content: str) -> None:
    """Write a page; nothing half-written stays behind. A name that ends in .pdf is printed by a browser.

    Raises OutputError if the file cannot be written, or there is no browser to print it.
    """
    # A file name that is no valid text must not stop the report on the file.
    page = content.encode("utf-8", errors="replace")
    # nobody unfolds what is on paper
    printed = Path(path).suffix.lower() == ".pdf"
    atomic_write(path, _printed(page.replace(b"<details", b"<details open"), path) if printed else page)


def find_browser(path: str | Path) -> str:
    """Return the browser that prints to a path; raises OutputError if there is none."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise OutputError(say("report.no_browser", path=str(path), page=Path(path).with_suffix(".html").name))
    return browser


def _printed(page: bytes, path: str | Path) -> bytes:
    """Return a page as a browser prints it, as PDF."""
    command = [find_browser(path), "--headless", "--disable-gpu", "--disable-dev-shm-usage", "--no-pdf-header-footer"]
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        command.append("--no-sandbox")  # it does not start as root otherwise; the page is ours, without scripts
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source, printed = folder / "page.html", folder / "page.pdf"
        source.write_bytes(page)
        try:
            subprocess.run(
                [*command, f"--user-data-dir={folder / 'profile'}", f"--print-to-pdf={printed}", source.as_uri()],
                check=True,
                capture_output=True,
                timeout=PRINT_S,
            )
            return printed.read_bytes()
        except (OSError, subprocess.SubprocessError) as error:
            raise OutputError(say("report.not_printed", path=str(path), error=type(error).__name__)) from None


@functools.cache
def _environment(package: str) -> Environment:
    from jinja2 import (  # late: commands start without it
        ChoiceLoader,
        Environment,
        PackageLoader,
        StrictUndefined,
        pass_context,
    )

    loaders = [PackageLoader(name) for name in dict.fromkeys((package, "servoscope.report"))]
    environment = Environment(
        loader=ChoiceLoader(loaders),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= FILTERS
    # with a context: else constant words are translated once, into the language of the first page
    environment.filters["word"] = pass_context(lambda _, words: translate(words))
    folder = files("servoscope.report")
    environment.globals["style"] = "".join(
        folder.joinpath(name).read_text(encoding="utf-8") for name in ("palette.css", "report.css")
    )
    environment.globals["say"] = say
    return environment
