"""Feeding, counting, and the table of what came of it."""

from __future__ import annotations

import random
import resource
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

from hostile.damage import damaged
from hostile.other_files import leaked
from hostile.targets import Target, targets
from servoscope.core.errors import MessageError, ServoscopeError

__all__ = ["broken_bounds", "fed", "feed_all", "markdown"]

SHOWN = 3  # of what must not happen, on stderr
MAX_S, MAX_MB = 20.0, 1000.0  # for one input; memory is that of a whole process, its libraries included


def fed(target: Target, inputs: int, seed: int = 1) -> dict[str, Any]:
    """Feed one target; return how often what happened."""
    chance = random.Random(f"{seed} {target.name}")
    came: Counter[str] = Counter()
    cases: Counter[str] = Counter()
    slowest, shown = 0.0, 0
    Path("/proc/self/clear_refs").write_text("5")  # the peak of its memory begins anew
    before = peaks_kb()
    for good in target.good:
        target.feed(good, chance)  # as it is, it is read
    for number in range(inputs):
        data = damaged(chance.choice(target.good), chance, number) if target.good else b""
        begun = time.perf_counter()
        try:
            target.feed(data, chance)
            came["read"] += 1
        except ServoscopeError as error:
            text = str(error)
            came["leaked"] += leaked(text)
            came["refused" if text and "\n" not in text else "badly told"] += 1
            cases[error.kind if isinstance(error, MessageError) else type(error).__name__] += 1
        except Exception as error:
            came["other"] += 1
            cases[f"!{type(error).__name__}"] += 1
            shown += 1
            if shown <= SHOWN:
                print(f"{target.name}, input {number}:", file=sys.stderr)
                traceback.print_exc()
        slowest = max(slowest, time.perf_counter() - begun)
    for data in target.others:
        try:
            answer = target.show(data)
        except ServoscopeError as error:
            answer = str(error)
        came["leaked"] += leaked(answer)
    return {
        "name": target.name, "inputs": inputs, "others": len(target.others), "leaked": came["leaked"],
        **{key: came[key] for key in ("read", "refused", "badly told", "other")},
        "cases": dict(cases.most_common()), "slowest_s": round(slowest, 2),
        "peak_mb": round(max(kb for one, kb in peaks_kb().items() if kb > before.get(one, 0) or one == "self") / 1024),
    }  # fmt: skip


def peaks_kb() -> dict[str, int]:
    """Return the most memory [kB] of this process, of those that it has started, and of the largest that ended."""
    children = Path("/proc/self/task").glob("*/children")
    living = ["self", *(word for file in children for word in file.read_text(encoding="utf-8").split())]
    ended = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return {"ended": ended, **{each: _peak_kb(each) for each in living}}


def _peak_kb(process: str) -> int:
    try:
        text = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    except OSError:  # it has just ended
        return 0
    return next((int(line.split()[1]) for line in text.splitlines() if line.startswith("VmHWM")), 0)


def broken_bounds(found: list[dict[str, Any]]) -> list[str]:
    """Return the names of targets with an input that came to something else than read or refused, in bounds."""
    return [
        one["name"]
        for one in found
        if one["other"] + one["badly told"] + one["leaked"] or one["slowest_s"] > MAX_S or one["peak_mb"] > MAX_MB
    ]


def feed_all(inputs: int, only: str = "") -> list[dict[str, Any]]:
    """Feed all of them, or those whose names contain a word."""
    warnings.simplefilter("ignore")  # libraries warn of what they meet in broken files
    with tempfile.TemporaryDirectory(prefix="servoscope-hostile-") as folder:
        return [fed(target, inputs) for target in targets(Path(folder)) if only in target.name]


def markdown(found: dict[str, Any]) -> str:
    """Return the table."""
    lines = [
        (
            *("reader or decoder", "inputs", "read", "refused", "any other exception", "slowest", "most memory"),
            *("names another file", "shows some of it"),
        ),
        ("---",) * 9,
    ]
    lines += [
        (
            one["name"],
            f"{one['inputs']}",
            f"{one['read']}",
            f"{one['refused']}",
            f"{one['other'] + one['badly told']}",
            f"{one['slowest_s']:.2f} s",
            f"{one['peak_mb']} MB",
            f"{one['others']}",
            f"{one['leaked']}",
        )
        for one in found["targets"]
    ]
    refused = Counter[str]()
    for one in found["targets"]:
        if one["name"].startswith(("MQTT", "OPC UA", "blocks")):
            refused.update(one["cases"])
    cases = ", ".join(f"{kind} {count}" for kind, count in sorted(refused.items(), key=lambda x: -x[1]))
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return f"{table}\n\nRefused messages, values and blocks by case: {cases}. {found['machine']}."
