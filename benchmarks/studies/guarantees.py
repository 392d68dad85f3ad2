"""What n healthy recordings guarantee, on recordings whose scatter is known; prints a Markdown table.

python benchmarks studies/guarantees [--draws 2000] [--json]

Means of features of n + 2 recordings are drawn from one law. Guaranteed: the first new one has the smallest conformal
p-value, 1/(n + 1). In a row: both new ones do. By the model: the first one exceeds the limit that the n healthy
recordings lead to by leaving out one at a time, for one in 200.
"""

from __future__ import annotations

from collections.abc import Callable
from math import comb

import numpy as np
from tables import Table, parser, show

from servoscope.baseline.feature_model import FeatureGroup, FeatureModel, GroupStatistic
from servoscope.baseline.feature_spans import SpanFeatures
from servoscope.baseline.threshold import score_limit
from servoscope.core.arrays import FloatArray
from servoscope.core.blas import with_one_blas_thread
from servoscope.models.loop import FEATURE_FALSE_ALARMS

RECORDINGS = (5, 10, 20, 50)
FEATURES = 4
NEW = 2


def laws(rng: np.random.Generator) -> dict[str, Callable[[tuple[int, int]], FloatArray]]:
    """Return laws of the scatter between recordings, by name."""
    return {
        "normal": lambda size: rng.standard_normal(size),
        "Student's t, 3 degrees": lambda size: rng.standard_t(3.0, size),
        "log-normal": lambda size: rng.lognormal(0.0, 1.0, size),
    }


def group_of(means: FloatArray) -> FeatureGroup:
    """Return recordings as the group of features that `learn` would keep of them."""
    d = means.shape[1]
    within = tuple(map(tuple, np.eye(d).tolist()))
    rows = tuple(map(tuple, means.tolist()))
    return FeatureGroup(level=0, kept=tuple(range(d)), means=rows, within=within, degrees=100, windows=4.0)


def judge(means: FloatArray, n: int) -> tuple[list[bool], bool]:
    """Return whether each new recording has the smallest p-value, and whether the first exceeds the model's limit."""
    healthy, ones = means[:n], np.ones(1)
    group = group_of(healthy)
    model = FeatureModel.model_construct(groups=(group,), left_out=(1.0,) * n)
    p = [model.conformal_p_value(SpanFeatures(new[None], ones, np.zeros(5))) for new in means[n:]]
    left_out = [GroupStatistic.of(group_of(np.delete(healthy, i, axis=0))).score(healthy[i], 4.0) for i in range(n)]
    limit = score_limit(left_out, FEATURE_FALSE_ALARMS)
    return [one < 1.5 / (n + 1.0) for one in p], GroupStatistic.of(group).score(means[n], 4.0) > limit


@with_one_blas_thread
def rows(draws: int) -> list[tuple[str, ...]]:
    """Count over draws."""
    rng = np.random.default_rng(21)
    mix = rng.standard_normal((FEATURES, FEATURES))
    found = []
    for name, law in laws(rng).items():
        for n in RECORDINGS:
            said = [judge(law((n + NEW, FEATURES)) @ mix, n) for _ in range(draws)]
            first, both, model = (float(np.mean(x)) for x in zip(*((s[0], all(s), m) for s, m in said), strict=True))
            error = 2.0 * np.sqrt(1.0 / (n + 1) / draws)
            promised = f"{1.0 / (n + 1):.4f} +- {error:.4f}"
            in_a_row = f"{1.0 / comb(n + NEW, NEW):.4f}"
            found.append((name, f"{n}", promised, f"{first:.4f}", in_a_row, f"{both:.4f}", f"{model:.4f}"))
    return found


def main() -> None:
    """Run the command line of this process."""
    command = parser(__doc__)
    command.add_argument("--draws", type=int, default=2000, help="recordings judged per row")
    given = command.parse_args()
    heads = (
        "scatter",
        "n",
        "guaranteed, 1/(n + 1)",
        "counted",
        "two in a row, ranked",
        "counted",
        "by the model, 0.005",
    )
    note = (
        f"{given.draws} draws per row, {FEATURES} features, exchangeable recordings. What should be, with two standard "
        "errors of counting, stands before what was counted; the last column is the model's word."
    )
    show([Table("Guarantees", note, heads, tuple(rows(given.draws)))], given.json)
