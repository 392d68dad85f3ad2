"""Which columns of a file may be t, r, u and y, by their names in six languages: a proposal for the user to check."""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from servoscope.signals.readers.column_words import (
    ACTUATION,
    COMMANDS,
    EFFORT,
    MEASURED,
    PID,
    PLANNED,
    POSITION,
    PRESSURES,
    REFERENCE,
    SPEED,
    STAMPS,
    TIME,
    NameParts,
    describe_name,
    plain_text,
)
from servoscope.signals.readers.units import SPEEDS, si_factor, split_unit

PRESSURE_SIDES = {
    "A": {"a"},
    "B": {"b"},
    "supply": {"s", "supply", "pump", "system", "versorgung", "pumpe", "pompe", "pompa", "bomba"},
}
VALVES = {"valve", "servo", "ventil"}
# words of what a controller puts out, also within a name
FIRM_ACTUATION = {*ACTUATION} - {*VALVES, "u", "input", "control", "controller", "ctrl"}
PLANT = {"plant", "process", "actuator", "motor"}
SPEED_COST = 2.5  # of a speed as y against a position: a log that has both is of a position loop
PLANNED_COST = 0.3  # of a target, which may be the end of the move, against a set point
FIELDS = {"t": "time", "r": "reference", "u": "input", "y": "output"}
NO_PARTS = describe_name("")
MAX_CANDIDATES = 100  # for r and for y, whose pairs are compared
TIME_UNITS = {"ms": "ms", "us": "us", "µs": "us", "μs": "us", "ns": "ns", "min": "min", "s": "s", "sec": "s"}
CLOCK_PARTS = (
    ("date", "datum", "fecha", "data"),
    ("time", "zeit", "uhrzeit", "heure", "hora", "ora"),
    ("millitm", "msec"),
)


def guess_columns(names: Sequence[str]) -> dict[str, str]:
    """Return the likeliest column for t, r, u and y, each column once; without those that no name suggests.

    The quantity counts before words of the role: no torque, current or voltage is y. r and y are chosen as a pair of
    one quantity, u by what the controller puts out, a command before what was measured of it.
    """
    time = _find_time(names)
    meanings = {name: meaning for name in names if name != time and _is_signal(meaning := describe_name(name))}
    guesses = {"t": time} if time else {}
    bare = {plain_text(meaning.own[-1]) if meaning.own else "": name for name, meaning in meanings.items()}
    if {"r", "u", "y"} <= bare.keys():  # also out.r, out.u, out.y
        return guesses | {letter: bare[letter] for letter in "ruy"}
    if {"w", "x", "y"} <= bare.keys() and not {"r", "u"} & bare.keys():  # DIN 19226: w is r, y is u, x is y
        return guesses | {"r": bare["w"], "u": bare["y"], "y": bare["x"]}
    r, y = _find_pair(meanings)
    u = _find_input(meanings, {r, y}, y or r or "")
    efforts = {name: meaning for name, meaning in meanings.items() if meaning.quantity == "effort"}
    if y is None and r is None and (twins := _find_twins(efforts)):  # a loop of force or current
        _, *pair = min(twins)
        if (other := _find_input(meanings, pair, pair[1])) is not None:
            (r, y), u = pair, other
    return guesses | {letter: name for letter, name in (("r", r), ("u", u), ("y", y)) if name is not None}


def _is_signal(meaning: NameParts) -> bool:
    clock = not meaning.own or (meaning.own[-1] in TIME and len(meaning.own[-1]) > 1)
    return not clock and meaning.quantity not in ("error", "other") and not meaning.words & {*STAMPS}


def _find_time(names: Sequence[str]) -> str | None:
    """Return the likeliest clock: a name that is the word comes before one that only contains it."""
    values = {name: describe_name(name) for name in names}
    values = {name: meaning for name, meaning in values.items() if meaning.quantity != "error"}
    whole = {
        re.sub(r"(?<=[a-z])[_\-. ](?=[a-z])", "", plain_text(split_unit(name)[0])): name for name in reversed(values)
    }
    for word in TIME:
        if word in whole:
            return whole[word]
    return next(
        (name for word in TIME for name, meaning in values.items() if word in meaning.words and len(word) > 1), None
    )


def _find_pair(meanings: Mapping[str, NameParts]) -> tuple[str | None, str | None]:
    """Return the likeliest reference and the output that follows it; None for what no name suggests."""
    motions = {name: meaning for name, meaning in meanings.items() if meaning.quantity != "effort"}
    outputs = {name: cost for name, meaning in motions.items() if (cost := _output_cost(meaning)) is not None}
    references = {name: cost for name, meaning in motions.items() if (cost := _reference_cost(meaning)) is not None}
    pairs = [
        (outputs[y] + cost, r, y)
        for y in [*outputs][:MAX_CANDIDATES]
        for r in [*references][:MAX_CANDIDATES]
        if r != y and (cost := _pair_cost(motions[r], motions[y], references[r])) is not None
    ]
    pairs += _find_twins(motions)
    alone = [(cost + 5.0, "", y) for y, cost in outputs.items()]
    if not pairs and not alone:
        return min(references, key=lambda name: references[name], default=None), None
    order = {name: place for place, name in enumerate(motions)}
    _, r, y = min(
        [*pairs, *alone], key=lambda pair: (pair[0], -_shared(pair[1], pair[2]), order[pair[2]], order.get(pair[1], 0))
    )
    return r or None, y


def _find_twins(motions: Mapping[str, NameParts]) -> list[tuple[float, str, str]]:
    """Return pairs of r and y, with their costs, that only words of a role tell apart.

    Position and ActualPosition, R and RDes, control_position and position.
    """
    stems: dict[frozenset[str], list[str]] = {}
    for name, meaning in motions.items():
        stems.setdefault(meaning.stem, []).append(name)
    twins = []
    for names in stems.values():
        for r, y in itertools.permutations(names[:MAX_CANDIDATES], 2):
            asked, measured = motions[r], motions[y]
            told = _says(asked, "reference") + _says(measured, "measured")
            belong = asked.role != "measured" and not _long_role(measured, REFERENCE) and _same_joint(asked, measured)
            if told and belong and _units_agree(asked, measured):
                cost = {"position": 0.0, "speed": SPEED_COST}.get(measured.quantity, 0.4)
                twins.append((cost - 0.5 * told + PLANNED_COST * bool(asked.words & PLANNED), r, y))
    return twins


def _says(meaning: NameParts, role: str) -> bool:
    return meaning.role == role and _long_role(meaning)


def _long_role(meaning: NameParts, words: Sequence[str] = (*REFERENCE, *MEASURED)) -> bool:
    """Tell whether a word of more than a letter gives a role."""
    return any(len(word) > 1 and word in words for word in meaning.words)


def _output_cost(meaning: NameParts) -> float | None:
    """Return how unlikely a column is y, None if it is none."""
    if meaning.role == "reference":
        return None
    measured = meaning.role == "measured"
    if meaning.quantity:
        preference = 0.01 * len(meaning.words & {*MEASURED})  # $AXIS_ACT_MEAS before $AXIS_ACT
        return (
            {"position": 0.0, "speed": SPEED_COST}[meaning.quantity]
            + (not measured)
            - preference
            + 2.0 * bool({*meaning.own} & VALVES)
            + 1e-3 * len(meaning.own)  # theta before theta_d, which may be desired or a derivative
        )
    if measured:
        return 0.4
    if meaning.words & {*PID}:
        return 0.6 if "input" in meaning.own else None
    return 3.0 if {*meaning.own} & {"output"} and not meaning.words & {"control", "ctrl", "drive", "motor"} else None


def _reference_cost(meaning: NameParts) -> float | None:
    """Return how unlikely a column is r, None if it is none."""
    if meaning.role == "reference":
        generic = not meaning.quantity and meaning.words & {*COMMANDS}
        return 2.0 * bool(generic) + PLANNED_COST * bool(meaning.words & PLANNED)
    asked = meaning.words & {"control", "controller"} and {*meaning.own} & {*POSITION, *SPEED} and not meaning.role
    return 1.0 if asked else None


def _pair_cost(r: NameParts, y: NameParts, cost: float) -> float | None:
    """Return how unlikely it is that y follows r; None if they are two quantities."""
    if (r.quantity and y.quantity and r.quantity != y.quantity) or not _same_joint(r, y):
        return None
    return cost + (r.quantity != y.quantity) - (r.stem == y.stem) + 3.0 * (not _units_agree(r, y))


def _find_input(meanings: Mapping[str, NameParts], taken: Collection[str | None], near: str) -> str | None:
    """Return the likeliest u: the controller's output by its name, else a torque, current or voltage."""
    joint = meanings.get(near, NO_PARTS)
    left = {name: m for name, m in meanings.items() if name not in taken and _same_joint(m, joint)}
    costs = {name: cost for name, m in left.items() if (cost := _input_cost(m)) is not None}
    return min(costs, key=lambda name: (costs[name], -_shared(name, near)), default=None)


def _input_cost(meaning: NameParts) -> tuple[float, int] | None:
    """Return how unlikely a column is u, and the place of its word; None if it is none."""
    own, words = {*meaning.own}, meaning.words
    if meaning.quantity == "effort":
        place = next((place for place, word in enumerate(EFFORT) if word in words), len(EFFORT))
        asked = 4.0 if words & PLANNED else 2.0
        cost = {"reference": asked, "": 2.5, "measured": 3.0}[meaning.role]
        return cost + 3.0 * bool(own & {"load", "auslastung"}) + 4.0 * ("input" in own), place
    place = next((place for place, word in enumerate(ACTUATION) if word in own), len(ACTUATION))
    if meaning.quantity or meaning.role == "measured":
        return (6.0, place) if own & VALVES else None
    if len(meaning.own) == 1 and place < len(ACTUATION):
        return 0.0, place
    if "input" in own and own & PLANT:  # what arrives there: the controller's output, feedforward and limits
        return 0.5, place
    if own & FIRM_ACTUATION or (own & {"control", "pid"} and own & {"signal", "output", "out"}):
        return 1.0, place
    if own & {*COMMANDS}:
        return 1.2, place
    return (3.5, place) if place < len(ACTUATION) and meaning.role != "reference" else None


def _shared(name: str, other: str) -> int:
    """Return how many letters two names begin with together."""
    return sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], zip(name, other, strict=False)))


def _same_joint(r: NameParts, y: NameParts) -> bool:
    """Tell whether two names end in the same number, or one in none: never u of one joint with y of another."""
    return len({r.index, y.index} - {""}) < 2


def _units_agree(r: NameParts, y: NameParts) -> bool:
    """Tell whether two names have the same unit, or one has none."""
    return len({r.unit, y.unit} - {""}) < 2


def guess_mapping(names: Sequence[str]) -> dict[str, Any]:
    """Return the guess as the fields of `Columns`, in SI units after the units in the names.

    None stands where no name suggests a column; a date and a time of day in two columns are one clock.
    """
    columns = guess_columns(names)
    fields: dict[str, Any] = {field: None for field in FIELDS.values()}
    for letter, column in columns.items():
        fields[FIELDS[letter]] = column if letter == "t" else scaled_channel(column)
    if "r" in columns and "y" not in columns:
        error = next((name for name in names if describe_name(name).quantity == "error"), None)
        fields["output"] = error and f"{scaled_channel(columns['r'], True)} - {scaled_channel(error, True)}"
    clock = _clock_columns(names)
    if len(clock) > 1:
        fields["time"] = " + ".join(clock)
    unit = "s" if len(clock) > 1 else _time_unit(columns.get("t", ""))
    return {**fields, "time_unit": unit, "segment": []}


def _time_unit(name: str) -> str:
    """Return the unit of a clock by its name: time [ms], but also TimeUS and ms_today."""
    words = [split_unit(name)[1], *re.findall(r"[A-Z]?[a-zµμ]+|[A-Z]+(?![a-z])", name)[::-1]]
    return next((TIME_UNITS[w] for w in map(str.lower, words) if w in TIME_UNITS and len(w) > 1), "s")


def guess_pressures(names: Sequence[str]) -> dict[str, str] | None:
    """Return the columns of the pressures at a piston's sides A and B and of its supply; None without all three."""
    parts = {name: describe_name(name).words for name in names}
    chosen = {
        side: next((name for name in names if parts[name] & {*PRESSURES, "p"} and parts[name] & words), None)
        for side, words in PRESSURE_SIDES.items()
    }
    columns = {side: scaled_channel(name) for side, name in chosen.items() if name is not None}
    return columns if len({*columns.values()}) == len(PRESSURE_SIDES) else None


def names_speed(channel: str) -> bool:
    """Tell whether a channel, as `[columns]` names it, is a speed: by its unit, or by a word in its name."""
    column = channel.rpartition("* ")[2].strip("`")
    return split_unit(column)[1] in SPEEDS or describe_name(column).quantity == "speed"


def names_target_torque(column: str) -> bool:
    """Tell whether a column is a torque, force or current that is asked for, and not measured."""
    meaning = describe_name(column)
    return meaning.quantity == "effort" and meaning.role == "reference"


def mapping_template(fields: Mapping[str, Any]) -> str:
    """Return ``--columns`` with what is known of a file, and ... where somebody has to say it."""
    known = format_mapping({**fields, **{field: fields[field] or "..." for field in FIELDS.values()}})
    return f"--columns '{known}'"


def format_mapping(fields: Mapping[str, Any]) -> str:
    """Return a guess as ``--columns`` takes it; what was not found is left out."""
    pairs = {letter: fields[field] for letter, field in FIELDS.items() if fields[field] is not None}
    if "t" in pairs:
        unit = "" if fields["time_unit"] == "s" else f"[{fields['time_unit']}]"
        pairs["t"] = pairs["t"] if " + " in pairs["t"] or pairs["t"] == "..." else quoted_channel(pairs["t"]) + unit
    quoted = {
        letter: text if " " not in text or "`" in text or " + " in text else quoted_channel(text)
        for letter, text in pairs.items()
    }
    return ", ".join(f"{letter}={text}" for letter, text in quoted.items())


def scaled_channel(column: str, quoted: bool = False) -> str:
    """Return a column as `[columns]` name it, times what turns it into SI units; `quoted`: as a part of a sum."""
    factor = si_factor(column)
    if factor == 1.0:
        return quoted_channel(column) if quoted else column
    return f"{factor:.15g} * {quoted_channel(column)}"


def turned_channel(text: str) -> str:
    """Return a column, or a multiple of one, times -1."""
    text = text if "`" in text else quoted_channel(text)
    return f"-{text}" if "* " in text else f"-1 * {text}"


def quoted_channel(column: str) -> str:
    """Return a column's name, in backticks unless it is one plain word."""
    return column if column.isidentifier() else f"`{column}`"


def _clock_columns(names: Sequence[str]) -> list[str]:
    """Return the columns that make one clock together: a date, a time of day, and its milliseconds."""
    clock = [next((name for name in names if plain_text(name) in words), None) for words in CLOCK_PARTS]
    return [name for name in clock if name is not None] if clock[1] and (clock[0] or clock[2]) else []
