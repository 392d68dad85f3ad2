"""What the name of a column says: its words, the quantity that it holds, and whether that is asked for or measured."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import pairwise

from servoscope.signals.readers.units import ANGLES, COUNTS, LENGTHS, SPEEDS, is_unit, split_unit

# English, German, French, Italian, Spanish, without accents; the names of makers' tools; the most telling first.
# Chinese names have no blanks: its words are looked for inside.
TIME = (
    *("t", "time", "timestamp", "timestamps", "zeit", "zeitstempel", "temps", "tempo", "tiempo", "horodatage", "tout"),
    *("时间", "时刻", "timer", "seconds", "elapsed", "datetime", "uhrzeit", "heure", "ora", "hora", "date", "datum"),
    *("fecha", "data", "tick", "today"),
)
REFERENCE = (
    *("r", "ref", "reference", "setpoint", "set", "sp", "soll", "sollwert", "fuhrungsgrosse", "consigne"),
    *("riferimento", "consigna", "referencia", "command", "commanded", "cmd", "desired", "des", "demand", "demanded"),
    *("dmd", "nominal", "trajectory", "profile", "limited", "qg", "vorgabe", "goal", "target", "tgt", "objetivo"),
    *("obiettivo", "rpos", "cpos", "pcmd", "cmdu", "poscmd", "mcmd", "设定", "给定", "目标", "指令", "参考"),
)
MEASURED = (
    *("y", "pv", "actual", "act", "ist", "istwert", "regelgrosse", "measured", "measurement", "meas", "feedback"),
    *("fbk", "fdbk", "fb", "achieved", "present", "estimate", "estimated", "est", "mesure", "mesuree", "reelle"),
    *("misura", "misurata", "reale", "medida", "real", "gemessen", "encoder", "fpos", "pfb", "posf", "实际", "反馈"),
    *("测量",),
)
POSITION = (
    *("position", "pos", "angle", "lage", "weg", "winkel", "displacement", "encoder", "lvdt", "theta", "posizione"),
    *("posicion", "pulses", "pulse", "qm", "qg", "q", "rpos", "apos", "cpos", "fpos", "pcmd", "pfb", "posf", "pl", "x"),
    *("s", "位置", "角度"),
)
SPEED = (
    *("speed", "velocity", "velo", "vel", "rpm", "erpm", "drehzahl", "geschwindigkeit", "vitesse", "velocita"),
    *("velocidad", "vcmd", "vl", "qd", "rates", "v", "速度", "转速"),
)
EFFORT = (
    *("torque", "trq", "tau", "tor", "moment", "drehmoment", "couple", "coppia", "par", "转矩", "扭矩", "力矩", "tcmd"),
    *(
        "current",
        "curr",
        "cur",
        "strom",
        "iq",
        "isq",
        "icmd",
        "il",
        "i",
        "amps",
        "courant",
        "corrente",
        "corriente",
        "电流",
    ),
    *(
        "force",
        "kraft",
        "forza",
        "fuerza",
        "voltage",
        "volt",
        "volts",
        "spannung",
        "tension",
        "tensione",
        "voltaje",
        "电压",
    ),
    *("pwm", "duty", "load", "auslastung"),
)
# what the controller puts out, whatever it is
ACTUATION = (
    *("u", "input", "control", "controller", "ctrl", "valve", "servo", "stell", "stellgrosse", "stellsignal"),
    *(
        "stellwert",
        "ventil",
        "effort",
        "op",
        "co",
        "cv",
        "cveu",
        "mv",
        "lmn",
        "dcom",
        "dout",
        "vir",
        "commande",
        "comando",
    ),
    *("mando", "控制量", "阀", "output", "out"),
)
COMMANDS = ("command", "commanded", "cmd")  # of the controller where there is a reference besides, else the reference
PLANNED = {"target", "goal", "tgt"}  # of a torque: from the planned motion, not what the controller puts out
# r - y in the place of y, as drives log it
ERRORS = (
    *("error", "err", "deviation", "abweichung", "regelabweichung", "schleppfehler", "schleppabstand", "erreur"),
    *("ecart", "lag", "droop", "following", "diff", "pe"),
)
SUPPLY = ("supply", "system", "bus", "vbus", "versorgung", "battery", "link", "zwischenkreis", "mains", "main")
# no signals of the loop
NO_SIGNALS = (
    *("acc", "accel", "acceleration", "beschleunigung", "jerk", "ruck", "qdd", "temperature", "temp", "temperatur"),
    *("status", "state", "zustand", "mode", "fault", "alarm", "power", "leistung", "reactive", "direct", "ratio"),
    *(
        "override",
        "gain",
        "limit",
        "feedforward",
        "offset",
        "enable",
        "turns",
        "word",
        "hours",
        "noise",
        "moving",
        "idfb",
    ),
)
PRESSURES = ("pressure", "druck", "press", "pression", "pressione", "presion", "压力")
# parts of a message's stamp and counters, which are no signals whatever else their names say
STAMPS = ("stamp", "timestamp", "sec", "nanosec", "nsec", "secs", "nsecs", "seq")
# parts of compounds that tell nothing of themselves
PARTS = (
    "motor",
    "antriebs",
    "achse",
    "axis",
    "pid",
    "wert",
    "value",
    "point",
    "grosse",
    "joint",
    "q",
    "x",
    "p",
    "wirk",
)
PID = ("pid", "regler", "controller", "scaled")  # whose output is u, and input y
SUPPLY_UNITS, CELSIUS = {"V", "mV"}, {"°C", "degC", "°F", "degF", "K"}
HUNGARIAN = re.compile(r"^(?:lr|di|st|[bfnirew])(?=[A-Z])")  # what programs of PLC put ahead of a name: fActPosition
LINKS = ("", "en", "s", "n", "es")  # between the parts of a German compound


@dataclass(frozen=True)
class NameParts:
    """What a column's name says."""

    words: frozenset[str]  # all of it, the unit aside
    own: tuple[str, ...]  # of the last part of a path, in its order
    quantity: str  # position, speed, effort, error, other; "" where no word says it
    role: str  # reference, measured, ""
    index: str  # number that the name ends in: of a joint
    stem: frozenset[str]  # words but those of the role
    unit: str


@lru_cache(maxsize=4096)
def describe_name(name: str) -> NameParts:
    """Return what a column's name says; the end of a path such as ``axis.encoder.pos`` counts before its beginning."""
    bare, unit = split_unit(name)
    parts = [words for part in re.split(r"[.:](?!\d)|::", bare) if (words := split_words(part))]
    own = parts[-1] if parts else ()
    path = tuple(word for part in parts for word in part)
    quantity = next((named for words in reversed(parts) if (named := _quantity(words))), "") or _quantity_of_letter(own)
    if not quantity or (quantity == "position" and not set(own) & set(POSITION)):
        quantity = _quantity_of_unit(unit) or quantity
    if (unit in SUPPLY_UNITS and set(path) & set(SUPPLY)) or unit in CELSIUS:
        quantity = "other"
    role = next((told for words in reversed(parts) if (told := _role(words, len(path) == 1))), "")
    stem = frozenset(word for word in path if len(word) == 1 or word not in {*REFERENCE, *MEASURED})
    index = re.search(r"(\d+)[\])]?$", bare)
    return NameParts(frozenset(path), own, quantity, role, index[1] if index else "", stem, unit)


def split_words(text: str) -> tuple[str, ...]:
    """Return the words of a name in small letters without accents, those of a compound where all are known."""
    bare = HUNGARIAN.sub("", plain_text(text, fold=False))
    chinese = [word for word in sorted(known_words()) if not word.isascii() and word in text]
    bare = re.sub(r"\d+[A-Za-z](?![A-Za-z])", " ", bare)  # 24V, 0x6064
    tokens = re.findall(r"[A-Z]?[a-zß]+|[A-Z]+(?![a-z])", bare)
    return (*(word for token in tokens for word in split_compound(token.casefold())), *chinese)


@lru_cache(maxsize=4096)
def split_compound(word: str) -> tuple[str, ...]:
    """Return the parts of a word such as ``lagesollwert`` where all of them are known, else the word."""
    known = known_words()
    if word in known:
        return (word,)
    if word[0] in "ruyqxf" and word[1:] in known and len(word) > 3:  # yref, umeas
        return (word[0], word[1:])
    for length in range(len(word) - 2, 2, -1):
        if (head := word[:length]) in known:
            for link in LINKS:
                tail = word[length + len(link) :]
                if word[length:].startswith(link) and len(tail) > 2 and all(p in known for p in split_compound(tail)):
                    return (head, *split_compound(tail))
    return (word,)


@cache
def known_words() -> frozenset[str]:
    """Return all words that mean something."""
    groups = (
        TIME,
        REFERENCE,
        MEASURED,
        POSITION,
        SPEED,
        EFFORT,
        ACTUATION,
        ERRORS,
        SUPPLY,
        NO_SIGNALS,
        PRESSURES,
        PARTS,
    )
    return frozenset(word for group in groups for word in group)


def plain_text(text: str, *, fold: bool = True) -> str:
    """Return a text without accents, in small letters if `fold`."""
    kept = unicodedata.normalize("NFKD", text)
    bare = "".join(c for c in kept if not unicodedata.combining(c)).strip()
    return bare.casefold() if fold else bare


def _quantity(words: tuple[str, ...]) -> str:
    """Return the quantity that the last of these words names; an error, a supply or a temperature goes first."""
    if set(words) & set(ERRORS):
        return "error"
    if set(words) & {*NO_SIGNALS, *PRESSURES} or (set(words) & set(SUPPLY) and not _motions(words)):
        return "other"
    if any(a == "d" and b == "axis" for a, b in pairwise(words)):
        return "other"  # the current that makes no torque
    if words[-1:] == ("id",) or (words[:1] == ("id",) and len(words) == 2 and words[1] in {*MEASURED, *REFERENCE}):
        return "other"
    quantity = ""
    for word, after in zip(words, (*words[1:], ""), strict=True):
        if word == "current" and after in {*POSITION, *SPEED, "value"}:
            continue  # what is now, not a current
        quantity = (len(word) > 1 and _quantity_of_word(word)) or quantity
    return quantity


def _quantity_of_letter(words: tuple[str, ...]) -> str:
    """Return the quantity that a single letter names, where no word does."""
    if any(len(word) > 1 and word in ACTUATION for word in words):
        return ""
    single = "".join(word for word in words if len(word) == 1)  # q_des, i_actual, i_q
    if single in ("id", "da"):
        return "other"
    return "effort" if single in ("iq", "ia", "qa") else _quantity_of_word(single[-1:])  # i_A is a current in A


def _motions(words: tuple[str, ...]) -> bool:
    return bool(set(words) & {*POSITION, *SPEED})


def _quantity_of_word(word: str) -> str:
    groups = {"position": POSITION, "speed": SPEED, "effort": EFFORT}
    return next((quantity for quantity, group in groups.items() if word in group), "")


def _quantity_of_unit(unit: str) -> str:
    if unit in SPEEDS:
        return "speed"
    if unit in {**LENGTHS, **ANGLES, **COUNTS}:
        return "position"
    return "effort" if unit.endswith(("A", "Nm", "Arms")) and is_unit(unit) else ""


def _role(words: tuple[str, ...], alone: bool) -> str:
    """Return the role that the last telling word gives; ``current position`` is measured; letters tell if `alone`."""
    role = ""
    for word, after in zip(words, (*words[1:], ""), strict=True):
        if (word in MEASURED and (len(word) > 1 or alone)) or (word == "current" and after in POSITION):
            role = "measured"
        elif word in REFERENCE and (len(word) > 1 or alone):
            role = "reference"
    return role
