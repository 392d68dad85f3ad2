"""Which columns of a file become r, u, y and t: column mappings and linear combinations of channels."""

from __future__ import annotations

import ast
import contextlib
import re
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from pydantic import ValidationError

from servoscope.core.errors import LoopError, RecordingError
from servoscope.core.settings_errors import closest_names, describe_error
from servoscope.models.loop import Columns
from servoscope.signals.readers.guess_columns import guess_mapping, mapping_template

FIELDS = {
    **{key: "time" for key in ("t", "time")},
    **{key: "reference" for key in ("r", "reference")},
    **{key: "input" for key in ("u", "input")},
    **{key: "output" for key in ("y", "output")},
    "segment": "segment",
}
ALLOWED_EXPRESSIONS = (
    "only sums of channels and numbers, times or divided by numbers, are understood, channel % range where it wraps,"
    " and one | other where files differ"
)
MAX_SHOWN = 12
HEADER_HINT = "; if a line of it has their names, say --header-row"


class LinearCombination(NamedTuple):
    """A linear combination: constant + sum of factor times channel; `wraps` are the ranges of channels that wrap."""

    factors: dict[str, float]
    constant: float
    wraps: Mapping[str, float] = MappingProxyType({})

    def __add__(self, other: object) -> LinearCombination:
        """Sum of two combinations."""
        if not isinstance(other, LinearCombination):
            return NotImplemented
        factors = dict(self.factors)
        for name, factor in other.factors.items():
            factors[name] = factors.get(name, 0.0) + factor
        return LinearCombination(factors, self.constant + other.constant, {**self.wraps, **other.wraps})

    def scale(self, factor: float) -> LinearCombination:
        """Return the combination times a number."""
        factors = {name: f * factor for name, f in self.factors.items()}
        return LinearCombination(factors, self.constant * factor, self.wraps)


def parse_columns(text: str, base: Columns | None = None) -> Columns:
    """Read a mapping such as ``"r=qg, u=35.15 * vir, y=qm, t=time[ms]"``.

    The keys are t, r, u, y (or their long names) and segment (several columns with ``+`` between them). A unit in
    brackets after the time column is its unit, a zone such as [Europe/Berlin] that of its dates; ``t=`` means that
    there is no such column; y may stand several times, once per sensor. Keys that are not named stay as in `base`.
    Raises LoopError if a pair cannot be read.
    """
    fields = {**(base or Columns()).model_dump(), **parse_fields(text)}
    try:
        return Columns.model_validate(fields)
    except ValidationError as error:
        raise LoopError(f"columns: {describe_error(error, Columns)}") from None


def parse_fields(text: str) -> dict[str, object]:
    """Return the fields of `Columns` that a mapping names; raises LoopError if a pair cannot be read."""
    fields: dict[str, object] = {}
    outputs: list[str] = []
    for pair in re.findall(r"(?:`[^`]*`|[^,`])+", text):
        key, equals, value = (part.strip() for part in pair.partition("="))
        if not equals or key not in FIELDS or (not value and key not in ("t", "time")):
            raise LoopError(f"columns: {pair.strip()!r} is not one of t=, r=, u=, y=, segment= and a column's name")
        field = FIELDS[key]
        if field == "segment":
            fields[field] = tuple(_strip_backticks(part) for part in value.split("+"))
        elif field == "time":
            named = re.fullmatch(r"(.*?)\s*\[(\w+(?:/[\w/]+)?)\]", value)
            fields["time"] = _strip_backticks(named[1] if named else value) or None
            zone = named is not None and "/" in named[2]
            fields["time_unit"] = named[2] if named and not zone else "s"
            fields["time_zone"] = named[2] if named and zone else None
        elif field == "output":
            outputs.append(value)
            fields[field] = tuple(outputs) if len(outputs) > 1 else value
        else:
            fields[field] = value
    return fields


def find_channel(name: str, known: Iterable[str], where: str) -> str:
    """Return the channel called `name`; of alternatives, ``"Position | ActPos"``, the first that there is.

    `where`: how errors begin, for example ``file.csv: [columns] output``. Raises RecordingError if there is none, with
    the nearest names, or all of them, and how to name columns where none were named.
    """
    known = list(known)
    name = _strip_backticks(name)
    chosen = next((spelling for spelling in (name, *map(_strip_backticks, name.split("|"))) if spelling in known), None)
    if chosen is not None:
        return chosen
    defaults = Columns()
    key = where.rpartition("[columns] ")[2]
    other = guess_mapping(known).get(key)
    near = list(dict.fromkeys([*closest_names(name, known, count=3), *filter(None, [other])]))
    if not near and name == getattr(defaults, key if key in Columns.model_fields else "name", None):
        where = where.removesuffix(f": [columns] {key}")
        hint = f"say where the signals stand: {mapping_template(guess_mapping(known))} or [columns] in the loop file"
        name_ = f"no column {name!r}; {hint}; the file has {', '.join(known[:MAX_SHOWN]) or 'none'}"
        raise RecordingError(f"{where}: {name_}" + (", ..." if len(known) > MAX_SHOWN else "") + header_hint(known))
    shown = ", ".join(near or known[:MAX_SHOWN]) + (", ..." if not near and len(known) > MAX_SHOWN else "")
    hint = f"did you mean {shown}?" if near else f"the file has {shown or 'none'}"
    if other is not None:
        hint += f" Where files differ, write {name} | OTHER"
    raise RecordingError(f"{where}: no column {name!r}, {hint}")


def header_hint(names: Sequence[str]) -> str:
    """Return what to do where no line was found that names the columns, as the end of a message; else nothing."""
    return HEADER_HINT if list(names) == [f"c{index}" for index in range(len(names))] else ""


def parse_combination(text: str, known: Iterable[str], where: str) -> LinearCombination:
    """Read a channel's name or a linear combination, such as ``"0.025 * counts + 3"``.

    Names with blanks or odd characters are put in backticks inside combinations: "-`motor speed`/2". A text that is the
    name of a channel is that channel. "counts % 65536" is a channel that wraps in a range of 65536, unwrapped;
    "Position | ActPos" is the first of them that there is. `where`: how errors begin. Raises LoopError if the text is
    not a linear combination, RecordingError if a channel does not exist.
    """
    known = list(known)
    stripped = text.strip()
    if _strip_backticks(stripped) in known:
        return LinearCombination({_strip_backticks(stripped): 1.0}, 0.0)
    quoted: list[str] = []

    def hide(match: re.Match[str]) -> str:
        quoted.append(match[1].strip())
        return f" quoted_{len(quoted) - 1}_ "

    code = re.sub(r"`([^`]+)`", hide, stripped)
    try:
        tree = ast.parse(code.strip(), mode="eval").body
        names = {f"quoted_{index}_": name for index, name in enumerate(quoted)}
        combination = _evaluate(tree, names, known, where)
    except (SyntaxError, ValueError, RecursionError, ZeroDivisionError, OverflowError, MemoryError):
        if re.fullmatch(r"[\w .]+", stripped):
            find_channel(stripped, known, where)
        raise LoopError(f"{where} = {text!r}: {ALLOWED_EXPRESSIONS}; put odd names in backticks") from None
    if not any(combination.factors.values()):
        raise LoopError(f"{where} = {text!r}: names no channel")
    return combination


def parse_output(columns: Columns, known: Iterable[str], where: str) -> tuple[LinearCombination, ...]:
    """Read the channels of the output, one per sensor; arguments and errors as for `parse_combination`."""
    known = list(known)
    return tuple(parse_combination(text, known, where) for text in columns.outputs)


def _evaluate(node: ast.expr, quoted: Mapping[str, str], known: list[str], where: str) -> LinearCombination:
    if isinstance(node, ast.Name | ast.Attribute | ast.Subscript):
        name = ast.unparse(node)
        return LinearCombination({find_channel(quoted.get(name, name), known, where): 1.0}, 0.0)
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and type(node.value) is not bool:
        return LinearCombination({}, float(node.value))
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.UAdd | ast.USub):
        return _evaluate(node.operand, quoted, known, where).scale(-1.0 if isinstance(node.op, ast.USub) else 1.0)
    if not isinstance(node, ast.BinOp):
        raise ValueError("not linear")
    if isinstance(node.op, ast.BitOr):
        with contextlib.suppress(RecordingError):
            return _evaluate(node.left, quoted, known, where)
        return _evaluate(node.right, quoted, known, where)
    left, right = (_evaluate(side, quoted, known, where) for side in (node.left, node.right))
    if isinstance(node.op, ast.Add):
        return left + right
    if isinstance(node.op, ast.Sub):
        return left + right.scale(-1.0)
    if isinstance(node.op, ast.Mod) and not right.factors and right.constant > 0.0:
        if list(left.factors.values()) == [1.0] and not left.constant and not left.wraps:
            return left._replace(wraps=dict.fromkeys(left.factors, right.constant))
        raise ValueError("only a channel itself wraps")
    if isinstance(node.op, ast.Mult) and not left.factors:
        return right.scale(left.constant)
    if isinstance(node.op, ast.Mult) and not right.factors:
        return left.scale(right.constant)
    if isinstance(node.op, ast.Div) and not right.factors:
        return left.scale(1.0 / right.constant)
    raise ValueError("not linear")


def _strip_backticks(name: str) -> str:
    name = name.strip()
    return name[1:-1].strip() if len(name) > 2 and name[0] == name[-1] == "`" and "`" not in name[1:-1] else name
