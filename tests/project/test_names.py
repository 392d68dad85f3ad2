"""The rules of names: of modules, classes and constants."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from itertools import pairwise

import pytest
from sources import SOURCES, house, listing

PARTICIPLES = 0.04

# Participles that do not end in -ed, and `since`, which names nothing either. Not here: forms that are a noun of the
# field or a plain verb as well (bound, cut, fit, put, read, run, set, split).
_IRREGULAR = """
arisen awoken beaten become begun bent bitten blown born borne bought broken brought built caught chosen come dealt done
drawn driven eaten fallen felt fled flown forgotten found fought frozen given gone grown heard held hidden hung kept
known laid learnt left lent lost made meant met overheard overtaken paid proven ridden risen said seen sent shaken shown
slept sold sought spelt spent spoken spun stolen stood struck stuck swept sworn taken taught thought thrown told torn
undone understood unheard unseen won worn woven written
since
"""
IRREGULAR = frozenset(_IRREGULAR.split())

# Words in -ing and -ed that count nowhere, with the reason. A participle that could stand there as a plain adjective
# (`fitted`, `measured`, `weighted`) is no exception: the thing has a noun.
EXCEPTIONS: dict[str, str] = {
    # not formed from a verb at all
    "string": "no participle",
    "ring": "no participle: a ring buffer",
    "spring": "no participle: a mechanical spring",
    "thing": "no participle",
    "nothing": "no participle",
    "speed": "no participle: a signal",
    "seed": "no participle: of random numbers",
    "feed": "no participle: a feed of data, feed rate",
    "need": "no participle",
    "exceed": "no participle: the infinitive",
    "embed": "no participle: the infinitive",
    "red": "no participle: the colour",
    "hundred": "no participle: the number",
    # parts and properties of a machine
    "bearing": "noun: the machine part",
    "gearing": "noun: the machine part",
    "coupling": "noun: the machine part; coupling between axes",
    "damping": "noun: the coefficient",
    # control, signals and statistics
    "tuning": "noun: of an estimator or a controller",
    "tracking": "noun: tracking error, control's word for following a reference",
    "settling": "noun: settling time",
    "sampling": "noun: sampling time, sampling rate",
    "timing": "noun: of samples or of a benchmark",
    "filtering": "noun: of signals",
    "smoothing": "noun: of signals",
    "whitening": "noun: of noise",
    "forgetting": "noun: forgetting factor of a recursion",
    "rounding": "noun: rounding error",
    "scaling": "noun: of variables",
    "scoring": "noun: of detectors",
    "learning": "noun: as in machine learning; the package",
    "monitoring": "noun: condition monitoring, the field itself",
    "engineering": "noun: the profession",
    # data and software
    "recording": "noun: the data of one measurement, the product's central record",
    "reading": "noun: the value that an instrument shows",
    "setting": "noun: what a user configures",
    "warning": "noun: as in the standard library",
    "logging": "noun: as in the standard library",
    "finding": "noun: one result of an inspection or audit",
    "streaming": "noun: Spark Structured Streaming",
    "plotting": "noun: as in matplotlib and pandas",
    "housekeeping": "noun: of a service",
}

# Pairs of words that are one term.
TERMS: dict[tuple[str, str], str] = {
    ("closed", "loop"): "control's term",
    ("sliding", "window"): "the estimator's name in the literature",
    ("coloured", "noise"): "term of statistics",
    ("fixed", "point"): "term of arithmetic and of analysis",
    ("mean", "squared"): "term of statistics",
    ("shared", "memory"): "term of operating systems",
}


def words_of(name: str) -> list[str]:
    """Split a name at underscores and capitals: ``_OrderTried`` and ``order_tried`` are both order, tried."""
    parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)
    return [part.lower() for part in parts]


def participles_in(name: str) -> list[str]:
    """Return the words of a name that are participles or gerunds, and no exceptions."""
    words = words_of(name)
    for one, other in pairwise(words):
        if (one, other) in TERMS:
            words = [word for word in words if word not in (one, other)]
    return [word for word in words if word in IRREGULAR or (word.endswith(("ing", "ed")) and word not in EXCEPTIONS)]


def test_no_two_classes_have_the_same_name() -> None:
    twice = house.repeated_classes(SOURCES)
    lines = [f"{name}: {', '.join(path.as_posix() for path in paths)}" for name, paths in twice.items()]
    assert not lines, f"{len(lines)} class names that stand twice:{listing(lines)}"


@pytest.mark.parametrize("kind", ["modules", "classes"])
def test_few_names_are_participles(kind: str) -> None:
    if kind == "modules":
        paths = [source.path.parent if source.path.stem == "__init__" else source.path for source in SOURCES]
        names = [path.stem for path in paths]
    else:
        names = [name for source in SOURCES for name in source.classes]
    total, named = len(names), [name for name in names if participles_in(name)]
    share = len(named) / total
    assert share < PARTICIPLES, f"{100 * share:.1f} % of {kind} are named by a participle or gerund:{listing(named)}"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("OrderTried", ["tried"]),
        ("_Said", ["said"]),
        ("telling", ["telling"]),
        ("loop_closed", ["closed"]),
        ("closed_loop", []),
        ("SlidingWindow", []),
        ("RecordingError", []),
        ("settings", []),
        ("HTTPServer", []),
        ("LearnedMQTTFault", ["learned"]),
        ("mat5", []),
        ("tuning", []),
        ("StringRing", []),
    ],
)
def test_participles_are_told_from_nouns(name: str, words: list[str]) -> None:
    assert participles_in(name) == words


def test_the_exceptions_among_names_are_needed() -> None:
    idle = [word for word in EXCEPTIONS if not word.endswith(("ing", "ed"))]
    assert not idle, f"no exceptions, these would not be counted anyway: {idle}"
    assert not IRREGULAR & set(EXCEPTIONS)


# Adjectives, superlatives and participles that say nothing of what they bound.
VAGUE = set(
    re.findall(
        r"\w+",
        """
        absurd ahead alike as beside clearer closer coarse counted distinct enough explained far
        farthest fastest few fewest filled follow followed forgotten free furthest hopeless impossible
        inconstant largest later least likely long longest lost loud loudest many moved near nearby nearly
        negative negligible noisy odd often other others quiet rare relevant remembered rough said same
        settled sharp shortest significant slowest small smallest smoother some steady strong suitable tiny
        tried unasked unlikely unseen weak weakest whole wide wider widest
        """,
    )
)
OF_A_BOUND = {"most", "least", "fewest", "largest", "longest", "shortest", "smallest", "slowest", "fastest", "weakest"}


def constants_of(tree: ast.Module) -> Iterator[str]:
    """Yield the names of a module's constants."""
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = (each.id for target in targets for each in ast.walk(target) if isinstance(each, ast.Name))
            yield from (name for name in names if name.isupper())


def is_vague(constant: str) -> bool:
    """Tell whether a constant is an adjective alone, or begins with a superlative in the place of MIN or MAX."""
    words = constant.lower().strip("_").split("_")
    return words[0] in OF_A_BOUND or (len(words) == 1 and words[0] in VAGUE)


def test_a_constant_says_what_it_bounds() -> None:
    vague = [
        f"{source.path.as_posix()}: {name}"
        for source in SOURCES
        for name in constants_of(source.tree)
        if is_vague(name)
    ]
    assert not vague, f"name the quantity: MIN_SAMPLES, DELAY_TOLERANCE, NOISE_SHARE:{listing(vague)}"


def test_constants_that_bound_are_told_from_vague_ones() -> None:
    names = constants_of(ast.parse("FEW = 1\nMOST_ROWS, MAX_ROWS = 1, 2\nSETTLED: int = 3\nSETTLED_SHARE = x = 4"))
    assert [name for name in names if is_vague(name)] == ["FEW", "MOST_ROWS", "SETTLED"]


VAGUE_LOCALS = {"one", "found", "each", "rest", "more"}  # which say nothing of what they hold


def locals_of(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Yield the names that functions, lambdas and comprehensions bind, each with its line."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield from (
                (argument.arg, argument.lineno) for argument in ast.walk(node.args) if isinstance(argument, ast.arg)
            )
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.comprehension):
            names = (name for name in ast.walk(node) if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store))
            yield from ((name.id, name.lineno) for name in names)


def test_locals_say_what_they_are() -> None:
    vague = {
        f"{source.path.as_posix()}:{line}: {name}"
        for source in SOURCES
        for name, line in locals_of(source.tree)
        if name in VAGUE_LOCALS
    }
    assert not vague, f"name what it is, a recording, a fault:{listing(sorted(vague))}"


def test_vague_locals_are_found() -> None:
    tree = ast.parse("def f(each):\n    found = [one for one in each]\n    return lambda more: more\nrest = 1")
    assert {name for name, _ in locals_of(tree)} == {"each", "found", "one", "more"}
