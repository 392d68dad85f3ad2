"""The loops in one file by the names of its columns: a log of one loop, or an export of many tags."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from servoscope.models.loop import Columns
from servoscope.signals.readers.guess_columns import guess_mapping

# What a tag's last part says, as control systems and historians name it
SIGNALS = {
    **dict.fromkeys(("sp", "sv", "spt", "wsp", "setpoint", "r"), "reference"),
    **dict.fromkeys(("op", "mv", "co", "out", "output", "cv", "u"), "input"),
    **dict.fromkeys(("pv", "mes", "meas", "value", "y"), "output"),
    **dict.fromkeys(("mode", "md", "mod"), "segment"),  # automatic, manual: each stretch counts by itself
}


def find_loops(names: Sequence[str]) -> dict[str, Columns]:
    """Return the columns of each loop in a file by its tag; FIC101.PV, FIC101.OP and FIC101.SP are of FIC101.

    Without tags there is one loop called "", whose columns are guessed by their names.
    """
    guess = guess_mapping(names)
    if not {"u", "y"} <= set(names):
        tagged: dict[str, dict[str, str]] = {}
        for name in names:
            tag, field = _split_tag(name.strip())
            if field:
                tagged.setdefault(tag, {}).setdefault(field, name)
        clock = {"time": guess["time"], "time_unit": guess["time_unit"]}
        loops = {tag: fields for tag, fields in tagged.items() if {"input", "output"} <= fields.keys()}
        if loops:
            return {tag: _form_columns({**clock, **fields}) for tag, fields in loops.items()}
    mode = next((name for name in names if _split_tag(name.strip())[1] == "segment"), None)
    return {"": _form_columns({**{key: value for key, value in guess.items() if value}, "segment": mode})}


def _form_columns(fields: Mapping[str, str | None]) -> Columns:
    segment = fields.get("segment")
    return Columns.model_validate({**fields, "segment": (segment,) if segment is not None else ()})


def _split_tag(name: str) -> tuple[str, str]:
    """Return a column's tag, and the field that its last part names; "" if none."""
    for pattern in (r"(?:(.*?)[._/:\s-]+)?([A-Za-z]+)", r"(.+?)(SP|SV|OP|MV|CO|PV)"):
        parts = re.fullmatch(pattern, name)
        if parts and (field := SIGNALS.get(parts[2].lower())):
            return parts[1] or "", field
    return "", ""
