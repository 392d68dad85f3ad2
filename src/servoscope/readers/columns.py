"""Which columns of a file become r, u, y and t: column mappings and linear combinations of channels."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from pydantic import ValidationError

from servoscope.complaints import describe, nearest
from servoscope.errors import LoopError, RecordingError
from servoscope.loop import Columns

__all__ = ["Combination", "find_channel", "parse_columns", "parse_combination"]

FIELDS = {
    **{key: "time" for key in ("t", "time")},
    **{key: "reference" for key in ("r", "reference")},
    **{key: "input" for key in ("u", "input")},
    **{key: "output" for key in ("y", "output")},
    "segment": "segment",
}
ALLOWED = "only sums of channels and numbers, times or divided by numbers, are understood"
MOST_SHOWN = 12
SAY = "say where the signals stand: --columns 't=..., r=..., u=..., y=...' or [columns] in the loop file"


class Combination(NamedTuple):
    """A linear combination: constant + sum of factor times channel."""

    factors: dict[str, float]
    constant: float

    def __add__(self, other: object) -> Combination:
        """Sum of two combinations."""
        if not isinstance(other, Combination):
            return NotImplemented
        factors = dict(self.factors)
        for name, factor in other.factors.items():
            factors[name] = factors.get(name, 0.0) + factor
        return Combination(factors, self.constant + other.constant)

    def scaled(self, factor: float) -> Combination:
        """Return the combination times a number."""
        return Combination({name: f * factor for name, f in self.factors.items()}, self.constant * factor)


def parse_columns(text: str, base: Columns | None = None) -> Columns:
    """Read a mapping such as ``"r=qg, u=35.15 * vir, y=qm, t=time[ms]"``.

    Parameters
    ----------
    text
        Pairs with commas between them; the keys are t, r, u, y (or their long names) and segment (several
        columns with ``+`` between them). A unit in brackets after the time column is its unit; ``t=`` says
        that there is no such column.
    base
        What keys that are not named stay at; None: the defaults.

    Raises
    ------
    LoopError
        If a pair cannot be read.
    """
    told: dict[str, object] = (base or Columns()).model_dump()
    for pair in re.findall(r"(?:`[^`]*`|[^,`])+", text):
        key, equals, value = (part.strip() for part in pair.partition("="))
        if not equals or key not in FIELDS or (not value and key not in ("t", "time")):
            raise LoopError(f"columns: {pair.strip()!r} is not one of t=, r=, u=, y=, segment= and a column's name")
        field = FIELDS[key]
        if field == "segment":
            told[field] = tuple(_bare(part) for part in value.split("+"))
        elif field == "time":
            named = re.fullmatch(r"(.*?)\s*\[(\w+)\]", value)
            told["time"] = _bare(named[1] if named else value) or None
            told["time_unit"] = named[2] if named else "s"
        else:
            told[field] = value
    try:
        return Columns.model_validate(told)
    except ValidationError as error:
        raise LoopError(f"columns: {describe(error, Columns)}") from None


def find_channel(name: str, known: Iterable[str], where: str) -> str:
    """Return the channel called `name`.

    Parameters
    ----------
    where
        What errors begin with, for example ``file.csv: [columns] output``.

    Raises
    ------
    RecordingError
        If there is none; the message lists the nearest names, or all, and says how to name columns where
        none were named.
    """
    known = list(known)
    name = _bare(name)
    if name in known:
        return name
    near = nearest(name, known, count=3)
    defaults = Columns()
    key = where.rpartition("[columns] ")[2]
    if not near and name == getattr(defaults, key if key in Columns.model_fields else "name", None):
        where = where.removesuffix(f": [columns] {key}")
        name_ = f"no column {name!r}; {SAY}; the file has {', '.join(known[:MOST_SHOWN]) or 'none'}"
        raise RecordingError(f"{where}: {name_}" + (", ..." if len(known) > MOST_SHOWN else ""))
    shown = ", ".join(near or known[:MOST_SHOWN]) + (", ..." if not near and len(known) > MOST_SHOWN else "")
    hint = f"did you mean {shown}?" if near else f"the file has {shown or 'none'}"
    raise RecordingError(f"{where}: no column {name!r}, {hint}")


def parse_combination(text: str, known: Iterable[str], where: str) -> Combination:
    """Read a channel's name or a linear combination, such as ``"0.025 * counts + 3"``.

    Names with blanks or odd characters stand in backticks inside combinations: "-`motor speed`/2".

    Parameters
    ----------
    text
        What the column mapping says; a text that is a channel's name as it stands is that channel.
    known
        Names of the channels, upper and lower case distinguished.
    where
        What errors begin with, for example ``file.csv: [columns] output``.

    Raises
    ------
    LoopError
        If the text is not a linear combination.
    RecordingError
        If a channel does not exist.
    """
    known = list(known)
    stripped = text.strip()
    if _bare(stripped) in known:
        return Combination({_bare(stripped): 1.0}, 0.0)
    quoted: list[str] = []

    def hide(match: re.Match[str]) -> str:
        quoted.append(match[1].strip())
        return f" quoted_{len(quoted) - 1}_ "

    code = re.sub(r"`([^`]+)`", hide, stripped)
    try:
        tree = ast.parse(code.strip(), mode="eval").body
        names = {f"quoted_{index}_": name for index, name in enumerate(quoted)}
        found = _evaluate(tree, names, known, where)
    except (SyntaxError, ValueError, RecursionError, ZeroDivisionError, OverflowError, MemoryError):
        if re.fullmatch(r"[\w .]+", stripped):
            find_channel(stripped, known, where)
        raise LoopError(f"{where} = {text!r}: {ALLOWED}; put odd names in backticks") from None
    if not any(found.factors.values()):
        raise LoopError(f"{where} = {text!r}: names no channel")
    return found


def _evaluate(node: ast.expr, quoted: Mapping[str, str], known: list[str], where: str) -> Combination:
    if isinstance(node, ast.Name | ast.Attribute | ast.Subscript):
        name = ast.unparse(node)
        return Combination({find_channel(quoted.get(name, name), known, where): 1.0}, 0.0)
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and type(node.value) is not bool:
        return Combination({}, float(node.value))
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.UAdd | ast.USub):
        return _evaluate(node.operand, quoted, known, where).scaled(-1.0 if isinstance(node.op, ast.USub) else 1.0)
    if not isinstance(node, ast.BinOp):
        raise ValueError("not linear")
    left, right = (_evaluate(side, quoted, known, where) for side in (node.left, node.right))
    if isinstance(node.op, ast.Add):
        return left + right
    if isinstance(node.op, ast.Sub):
        return left + right.scaled(-1.0)
    if isinstance(node.op, ast.Mult) and not left.factors:
        return right.scaled(left.constant)
    if isinstance(node.op, ast.Mult) and not right.factors:
        return left.scaled(right.constant)
    if isinstance(node.op, ast.Div) and not right.factors:
        return left.scaled(1.0 / right.constant)
    raise ValueError("not linear")


def _bare(name: str) -> str:
    name = name.strip()
    return name[1:-1].strip() if len(name) > 2 and name[0] == name[-1] == "`" and "`" not in name[1:-1] else name
