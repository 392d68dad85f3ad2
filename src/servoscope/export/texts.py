"""The templates of exported sources: values in ``@{...}``, statements behind ``@@``, and how both are written."""

from __future__ import annotations

import functools
import re
import textwrap
from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt
from jinja2 import Environment, PackageLoader, StrictUndefined

from servoscope.core.jit.c_source import c_literal
from servoscope.core.jit.st_source import st_literal

MAX_LINE = 108
MAX_ITEMS = 24  # in a line of golden values


def fill_template(template: str, **values: Any) -> str:
    """Return a template with its values filled in; in XML they are escaped."""
    return _environment().get_template(template).render(values)


def plain_text(text: str) -> str:
    """Return text that no comment of C or Structured Text ends in."""
    return re.sub(r"\*/|\*\)|\(\*|[\\\"\n]", " ", text).replace("/*", " ")


@functools.cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("servoscope.export"),
        autoescape=lambda template: str(template).endswith(".xml"),
        undefined=StrictUndefined,
        keep_trailing_newline=True,
        variable_start_string="@{",
        variable_end_string="}",
        block_start_string="@%",
        block_end_string="%@",
        comment_start_string="@#",
        comment_end_string="#@",
        line_statement_prefix="@@",
    )
    environment.filters |= {"c": c_literal, "st": st_literal, "plain": plain_text}
    environment.filters |= {"table": _table, "wrapped": _wrapped, "items_in_lines": _items_in_lines}
    return environment


def _table(rows: npt.ArrayLike) -> str:
    """Return the rows of an array as initialisers of C."""
    return ",\n".join(
        f"    {{{', '.join(map(c_literal, row))}}}" for row in np.asarray(rows, dtype=np.float64).tolist()
    )


def _wrapped(items: Iterable[str]) -> str:
    return textwrap.fill(", ".join(items), MAX_LINE, initial_indent="    ", subsequent_indent="    ")


def _items_in_lines(items: Iterable[object]) -> str:
    texts = [str(item) for item in items]
    return ",\n".join(", ".join(texts[i : i + MAX_ITEMS]) for i in range(0, len(texts), MAX_ITEMS))
