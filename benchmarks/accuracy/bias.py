"""Is H_hat right on average? Healthy and under all faults of the paper's Table 2, and at five times its noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from accuracy.rig import baseline, loop, record
from accuracy.scenario import Numbers, Row, Scenario, Table
from servoscope.diagnosis.diagnose import diagnose_with_trace
from servoscope.research.paper.conditions import TABLE_2, FaultCase

TARGETS = (0.005, 0.01, 0.02)  # relative, at 1, 10 and 20 Hz
LAST = 50.0  # s, from where the values of a run are averaged
NOISE = 5.0
NOISE_TARGET = 1.0 / 3.0  # of the standard deviation of a single evaluation


def job(seed: int, kind: str, case: FaultCase | None, noise: float) -> Numbers:
    """Return H_hat/H_true at each frequency: mean of the last 10 s and last evaluation, real and imaginary parts."""
    learned = baseline(kind, 60.0, seed, noise=noise)
    faults = (case.event,) if case else ()
    _, trace = diagnose_with_trace(learned, record(kind, 60.0, seed, 1, faults, noise))
    plant = loop().plant.with_ratios({case.parameter: case.ratio} if case else {})
    relative = trace.ifrf.H / plant.frequency_response(trace.ifrf.frequencies)
    found = {"mean": relative[trace.t >= LAST].mean(axis=0), "last": relative[-1]}
    return {key: [[float(x.real), float(x.imag)] for x in values] for key, values in found.items()}


def errors(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show the error of the mean over all runs, with its standard error, in per cent."""
    mean = _complex(found, "mean")
    bias = np.abs(mean.mean(axis=0) - 1.0)
    doubt = _std(mean) / np.sqrt(len(found))
    cells = [
        f"{'' if b <= target else '**'}{b:.2%}{'' if b <= target else '**'} ± {d:.2%}"
        for b, d, target in zip(bias, doubt, TARGETS, strict=True)
    ]
    return [(words, *cells)]


def shares_of_std(words: str, found: Sequence[Numbers]) -> list[Row]:
    """Show the error of the mean in standard deviations of a single evaluation, and these in per cent."""
    mean, last = _complex(found, "mean"), _complex(found, "last")
    single = _std(last)
    share = np.abs(mean.mean(axis=0) - 1.0) / single
    doubt = _std(mean) / np.sqrt(len(found)) / single
    cells = [
        f"{'' if s <= NOISE_TARGET else '**'}{s:.2f}{'' if s <= NOISE_TARGET else '**'} ± {d:.2f} of {std:.2%}"
        for s, d, std in zip(share, doubt, single, strict=True)
    ]
    return [(words, *cells)]


def _complex(found: Sequence[Numbers], key: str) -> np.ndarray:
    parts = np.array([each[key] for each in found])
    return parts[..., 0] + 1j * parts[..., 1]


def _std(values: np.ndarray) -> np.ndarray:
    """Return the standard deviation over runs, real and imaginary parts together; unknown for one run."""
    return values.std(axis=0, ddof=1) if len(values) > 1 else np.full(values.shape[1], np.nan)


def _scenario(case: FaultCase | None) -> Scenario:
    id_ = f"bias/{case.parameter}-x{case.ratio:g}" if case else "bias/healthy"
    return Scenario(id_, str(case or "healthy"), 20, job, ("multisine", case, 1.0), errors)


TABLES = (
    Table(
        "bias",
        ("plant", *(f"{f} Hz ({target:.1%})" for f, target in zip((1, 10, 20), TARGETS, strict=True))),
        (_scenario(None), *(_scenario(case) for case in TABLE_2)),
    ),
    Table(
        "noise",
        ("reference", *(f"{f} Hz (1/3)" for f in (1, 10, 20))),
        tuple(
            Scenario(f"noise/{kind}", kind, 100, job, (kind, None, NOISE), shares_of_std)
            for kind in ("multisine", "profile")
        ),
    ),
)
