"""The machine code of a recursion: templates filled with the sizes of a plan and with the steps of the chain."""

from __future__ import annotations

import functools
from collections import namedtuple
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from servoscope import drive, estimators, moves, stretch
from servoscope.chain import HEAD, TILE, WATCHED, Chain, Plan
from servoscope.compiled import filled, inlined, kernel, traced, turning
from servoscope.cusum import LAGS
from servoscope.readout import Readout

SAID = ("evaluate", "respond", "tell")
STEPS = ("renew", "calm", "tick", "advance", "used", "learn", "note")
LOOPS = {"weigh": ("e",), "glide": ("s", "h"), "alarm": ("s", "h")}  # over the samples of a tile; what they keep
ALONE = ("begin", "advance", "learn", "follow", "forget")  # where neighbours may do something else


@functools.cache
def machine(plan: Plan, lanes: int, width: int, own: int) -> SimpleNamespace:
    """Return the drivers of `servoscope.drive` for a plan, by name; each compiles when it is first called."""
    estimator, sizes = estimators.load(plan.estimator), plan.sizes
    steps, readout = Chain(plan, getattr(estimator, "steady", None), lanes == 1), Readout(plan)
    to, at = dict(plan.to), dict(plan.at)
    several = WATCHED if lanes == 1 else lanes  # CUSUMs of one asset go side by side, or those of several assets
    literals = {x: getattr(sizes, x) for x in ("n", "rows", "row", "floats", "frequencies", "extra", "watched")}
    literals |= {"columns": sizes.n + 1, "room": sizes.n + 2, "tile": 4 * TILE, "handed": (sizes.n + LAGS + 1) * TILE}
    literals["size"] = HEAD + sizes.floats + sizes.watched + sizes.extra
    literals |= {"lanes": lanes, "width": width, "own": own, "several": several}
    names: dict[str, object] = {f"_{name}": number for name, number in literals.items()}
    names |= {"_to": namedtuple("To", to)(**to), "_at": namedtuple("At", at)(**at), "_update": estimator.update}
    shared = "" if own else "c"
    for step in STEPS:
        names[f"_{step}"] = traced(getattr(steps, step), width, shared)
    for step, kept in LOOPS.items():
        names[f"_{step}"] = traced(getattr(steps, step), width, shared, kept)
    names["_highest"] = traced(steps.highest)
    names["_listen"] = traced(steps.listen, WATCHED if lanes == 1 else width, "w" if lanes == 1 else shared, ("g",))
    names |= {"_turn": turning(width), "_square": turning(HEAD)}
    for step in SAID:
        names[f"_{step}"] = traced(getattr(readout, step), width, shared)
    for step in ALONE:
        names[f"_{step}_one"] = traced(getattr(steps, step))
    heap = not sizes.steady  # estimators with a P of their own allocate
    fits = lanes > 1 and min(sizes.row, sizes.floats) >= width
    templates: list[tuple[Callable[..., Any], Callable[..., Any]]] = list(zip(moves.MOVES, moves.SQUARES, strict=True))
    for move, square in templates:
        each = inlined(filled(move, names), heap)
        names[f"_{move.__name__}_each"] = each
        names[f"_{move.__name__}"] = inlined(filled(square, names), heap) if fits else each
    calm = (lanes > 1 or sizes.watched) and sizes.steady and not sizes.speed
    roles = {  # which part does what for these sizes
        "settled" if sizes.steady else "refreshed": "take",
        "together" if sizes.steady else "apart": "take_all",
        "gliding" if calm else "never": "glided",
        "plain" if sizes.start else "complete": "write",
    }
    for template in stretch.PARTS:
        name = template.__name__
        made = inlined(filled(template, names), heap)
        names |= {f"_{name}": made, f"_{roles.get(name, name)}": made}
    what = repr((plan, lanes, width, own))
    return SimpleNamespace(**{driver.__name__: kernel(filled(driver, names, what), heap) for driver in drive.DRIVERS})
