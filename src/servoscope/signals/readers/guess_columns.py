"""Which columns of a file may be t, r, u and y, by their names in six languages: a proposal for the user to check."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from typing import Any

from servoscope.signals.readers.units import SPEEDS, si_factor, split_unit

# Words in names, the most telling first; the order of the letters decides which signal chooses first. English, then
# German, French, Italian, Spanish; without accents. Chinese names have no blanks: its words are looked for inside.
WORDS = {
    "t": (
        *(
            "t",
            "time",
            "timestamp",
            "timestamps",
            "zeit",
            "zeitstempel",
            "temps",
            "tempo",
            "tiempo",
            "horodatage",
            "时间",
            "时刻",
        ),
        *(
            "timer",
            "seconds",
            "elapsed",
            "datetime",
            "uhrzeit",
            "heure",
            "ora",
            "hora",
            "date",
            "datum",
            "fecha",
            "data",
        ),
    ),
    "r": (
        *("r", "ref", "reference", "setpoint", "set", "sp", "soll", "sollwert", "sollposition", "sollwinkel", "target"),
        *("solldrehzahl", "sollgeschwindigkeit", "fuhrungsgrosse", "consigne", "riferimento", "consigna", "referencia"),
        *("desired", "des", "demand", "demanded", "dmd", "commanded", "objetivo", "obiettivo", "qg", "goal", "vorgabe"),
        *("设定", "给定", "目标", "指令", "参考"),
    ),
    "u": (
        *("u", "input", "control", "controller", "valve", "servo", "stell", "stellgrosse", "stellsignal", "stellwert"),
        *("ventil", "torque", "current", "voltage", "force", "pwm", "effort", "vir", "iq", "moment", "drehmoment"),
        *("motorspannung", "motormoment", "antriebsmoment", "stellspannung", "stellstrom", "ventilspannung"),
        *("strom", "motorstrom", "spannung", "kraft", "couple", "courant", "tension", "commande", "coppia", "corrente"),
        *("tensione", "comando", "forza", "par", "corriente", "tensionsalida", "mando", "fuerza", "voltaje"),
        *(
            "电流",
            "转矩",
            "扭矩",
            "力矩",
            "电压",
            "控制量",
            "阀",
            "tau",
            "duty",
            "load",
            "cur",
            "curr",
            "amps",
            "trq",
            "mv",
        ),
    ),
    "y": (
        *("y", "output", "ist", "istwert", "istposition", "istwinkel", "istdrehzahl", "actual", "act", "measured"),
        *("feedback", "position", "pos", "angle", "speed", "velocity", "encoder", "displacement", "qm", "mesure"),
        *("mesuree", "reelle", "vitesse", "misura", "misurata", "posizione", "reale", "velocita", "posicion", "medida"),
        *("real", "velocidad", "lage", "winkel", "drehzahl", "geschwindigkeit", "weg", "meas", "pv", "fbk", "fdbk"),
        *("实际", "反馈", "位置", "测量", "速度", "角度", "q"),
    ),
}
# what u is and r is not: a reference of the torque is what the controller puts out
QUANTITIES = {
    *(
        "torque",
        "current",
        "voltage",
        "force",
        "drehmoment",
        "strom",
        "spannung",
        "kraft",
        "couple",
        "courant",
        "coppia",
    ),
    *("corrente", "forza", "corriente", "fuerza", "电流", "转矩", "扭矩", "力矩", "电压"),
}
# r - y in the place of y, as drives log it
ERRORS = {
    "error",
    "err",
    "deviation",
    "abweichung",
    "regelabweichung",
    "schleppfehler",
    "schleppabstand",
    "erreur",
    "ecart",
}
SPEED_WORDS = {
    *("speed", "velocity", "rpm", "drehzahl", "istdrehzahl", "geschwindigkeit", "istgeschwindigkeit"),
    *("vitesse", "velocita", "velocidad", "速度", "转速"),
}
PRESSURE_WORDS = {"p", "pressure", "druck", "press", "pression", "pressione", "presion", "压力"}
PRESSURE_SIDES = {
    "A": {"a"},
    "B": {"b"},
    "supply": {"s", "supply", "pump", "system", "versorgung", "pumpe", "pompe", "pompa", "bomba"},
}
# parts of a message's stamp and counters, which are no signals whatever else their names say
STAMP_WORDS = {"stamp", "timestamp", "sec", "nanosec", "nsec", "secs", "nsecs", "seq"}
MEASURED_WORDS = {"actual", "act", "ist", "measured", "meas", "feedback", "fbk", "mesure", "misura", "reelle", "real"}
CONTROLLER_WORDS = {"control", "controller", "command", "cmd", "drive"}  # whose output is u
COMMAND = ("command", "cmd")  # what the controller commands where there is a reference besides, else the reference
FIELDS = {"t": "time", "r": "reference", "u": "input", "y": "output"}
TIME_UNITS = {"ms": "ms", "us": "us", "µs": "us", "μs": "us", "ns": "ns", "min": "min", "s": "s", "sec": "s"}
CLOCK_PARTS = (
    ("date", "datum", "fecha", "data"),
    ("time", "zeit", "uhrzeit", "heure", "hora", "ora"),
    ("millitm", "msec"),
)


def guess_columns(names: Sequence[str]) -> dict[str, str]:
    """Return the likeliest column for t, r, u and y, each column once; without those that no name suggests."""
    parts = {name: _words(name) for name in names}
    bare = {name: re.sub(r"(?<=[a-z])[_\-. ](?=[a-z])", "", _plain(split_unit(name)[0])) for name in names}
    values = [name for name in names if not parts[name] & ERRORS]
    signals = [name for name in values if not parts[name] & STAMP_WORDS]
    plain = [name for name in signals if not parts[name] & QUANTITIES]
    has_reference = any(parts[name] & set(WORDS["r"]) and not parts[name] & set(COMMAND) for name in plain)
    heir = "u" if has_reference else "r"
    words = {**WORDS, heir: (*WORDS[heir][:2], *COMMAND, *WORDS[heir][2:])}
    guesses: dict[str, str] = {}
    if (pair := _named_alike(plain, parts)) is not None:
        guesses["r"], guesses["y"] = pair
    for whole in (True, False):  # a name that is the word comes before one that only contains it
        for letter in [word for word in words if word not in guesses]:
            among = {"t": values, "r": plain}.get(letter, signals)
            if letter == "y":
                among = [name for name in signals if not ("output" in parts[name] and parts[name] & CONTROLLER_WORDS)]
            left = [name for name in among if name not in guesses.values()]
            matches = (
                name
                for word in words[letter]
                for name in left
                if (bare[name] == word if whole else word in parts[name])
            )
            if (match := next(matches, None)) is not None:
                guesses[letter] = match
    return {letter: guesses[letter] for letter in WORDS if letter in guesses}


def _named_alike(names: Sequence[str], parts: Mapping[str, set[str]]) -> tuple[str, str] | None:
    """Return the first reference whose name is another's with a word such as target before it, and that other.

    Or the other way round, as Siemens names them: Position, and ActualPosition which follows it.
    """
    ahead = set(WORDS["r"]) - {"r"}
    for measured in names:
        if parts[measured] & MEASURED_WORDS and (stem := parts[measured] - MEASURED_WORDS):
            for name in names:
                if parts[name] == stem and stem & set(WORDS["y"]) and _units_agree(measured, name):
                    return name, measured
    for reference in names:
        if parts[reference] & ahead and (stem := parts[reference] - ahead):
            for name in names:
                if parts[name] == stem and _units_agree(reference, name):
                    return reference, name
    return None


def _units_agree(name: str, other: str) -> bool:
    """Tell whether two names have the same unit, or one has none."""
    units = {split_unit(name)[1], split_unit(other)[1]} - {""}
    return len(units) < 2


def _plain(name: str) -> str:
    """Return a name in small letters without accents."""
    kept = unicodedata.normalize("NFKD", name.casefold())
    return "".join(c for c in kept if not unicodedata.combining(c)).strip()


def _words(name: str) -> set[str]:
    """Return the words of a name, its unit aside; of Chinese, all words that it contains."""
    bare = "".join(c for c in unicodedata.normalize("NFKD", split_unit(name)[0]) if not unicodedata.combining(c))
    latin = {part.casefold() for part in re.findall(r"[A-Z]?[a-zß]+|[A-Z]+(?![a-z])", bare)}
    return latin | {word for synonyms in WORDS.values() for word in synonyms if not word.isascii() and word in name}


def guess_mapping(names: Sequence[str]) -> dict[str, Any]:
    """Return the guess as the fields of `Columns`, in SI units after the units in the names.

    None stands where no name suggests a column; a date and a time of day in two columns are one clock.
    """
    columns = guess_columns(names)
    fields: dict[str, Any] = {field: None for field in FIELDS.values()}
    for letter, column in columns.items():
        fields[FIELDS[letter]] = column if letter == "t" else scaled_channel(column)
    if "r" in columns and "y" not in columns:
        error = next((name for name in names if _words(name) & ERRORS), None)
        fields["output"] = error and f"{scaled_channel(columns['r'], True)} - {scaled_channel(error, True)}"
    clock = _clock_columns(names)
    if len(clock) > 1:
        fields["time"] = " + ".join(clock)
    unit = "s" if len(clock) > 1 else TIME_UNITS.get(split_unit(columns.get("t", ""))[1], "s")
    return {**fields, "time_unit": unit, "segment": []}


def guess_pressures(names: Sequence[str]) -> dict[str, str] | None:
    """Return the columns of the pressures at a piston's sides A and B and of its supply; None without all three."""
    parts = {name: _words(name) for name in names}
    chosen = {
        side: next((name for name in names if parts[name] & PRESSURE_WORDS and parts[name] & words), None)
        for side, words in PRESSURE_SIDES.items()
    }
    columns = {side: scaled_channel(name) for side, name in chosen.items() if name is not None}
    return columns if len({*columns.values()}) == len(PRESSURE_SIDES) else None


def names_speed(channel: str) -> bool:
    """Tell whether a channel, as `[columns]` names it, is a speed: by its unit, or by a word in its name."""
    column = channel.rpartition("* ")[2].strip("`")
    return split_unit(column)[1] in SPEEDS or bool(_words(column) & SPEED_WORDS)


def names_target_torque(column: str) -> bool:
    """Tell whether a column is a torque, force or current that is asked for, and not measured."""
    words = _words(column)
    return bool(words & QUANTITIES) and bool(words & {*WORDS["r"], *COMMAND})


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
    clock = [next((name for name in names if _plain(name) in words), None) for words in CLOCK_PARTS]
    return [name for name in clock if name is not None] if clock[1] and (clock[0] or clock[2]) else []
