"""Remaining time on simulated courses of wear, beside a straight line and other libraries' prognoses.

python benchmarks studies/prognosis [--share 0.1] [--alone] [--json]

ProgPy and SurPyval have to be installed (pip install -r benchmarks/requirements-prognosis.txt), or --alone leaves them
out.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
from tables import Table, parser, show

from servoscope.core.arrays import FloatArray
from servoscope.prognosis.forecast import DAY_S, prognose
from servoscope.prognosis.series import SizeSeries

COURSES, QUIET, UNKNOWN = 200, 200, 50
LIMIT = 1.0
STEPS = 5000  # of a simulated course
SHARES = (0.5, 0.7, 0.9)  # of the life, at which is looked
LOOKS = 6  # at a history without wear
ALPHA = 0.2  # of the alpha-lambda accuracy
KINDS = ("linear", "power", "exponential", "stick")
OTHERS = ("none", "two rates", "slowing")  # no wear, and wear that the method does not know
Interval = tuple[float, float, float]
Forecaster = Callable[[SizeSeries], Interval | None]


@dataclass(frozen=True, eq=False)
class Course:
    """A size that reaches `LIMIT` at `life` [s], as it is measured."""

    kind: str
    series: SizeSeries
    life: float

    def until(self, share: float) -> SizeSeries:
        """Return what is known after a share of the life."""
        return cut(self.series, self.series.t[0] + share * (self.life - self.series.t[0]))


def cut(series: SizeSeries, t: float) -> SizeSeries:
    """Return what is known at `t`."""
    keep = series.t <= t
    covariates = {name: each[keep] for name, each in series.covariates.items()}
    return SizeSeries(series.name, series.t[keep], series.value[keep], series.std[keep], covariates)


def course(seed: int, kind: str, temperature: bool) -> Course:
    """Draw a life of 60 to 500 days with 60 to 400 values, up to 3 % of its wear random, noise of 0.2 to 2 %."""
    rng = np.random.default_rng([seed, KINDS.index(kind) if kind in KINDS else 9 + OTHERS.index(kind)])
    days, count = rng.uniform(60.0, 500.0), int(rng.integers(60, 400))
    # the size goes on between its values, and may reach the limit there
    share = np.linspace(0.0, 1.3, STEPS)
    measured = np.sort(rng.choice(STEPS, count, replace=False))
    if kind == "linear":
        x = share
    elif kind == "power":
        x = share ** rng.uniform(1.4, 3.0)
    elif kind == "exponential":
        k = rng.uniform(1.0, 4.0)
        x = np.expm1(k * share) / math.expm1(k)
    elif kind == "stick":
        begin = rng.uniform(0.1, 0.45)
        x = np.maximum(share - begin, 0.0) / (1.0 - begin)
    elif kind == "two rates":
        bend, ratio = rng.uniform(0.2, 0.6), rng.uniform(0.5, 2.5)
        x = np.minimum(share, bend) + ratio * np.maximum(share - bend, 0.0)
        x = x / (bend + ratio * (1.0 - bend))
    elif kind == "slowing":
        x = share ** rng.uniform(0.6, 0.9)
    else:
        x = np.zeros(STEPS)
    growth = np.diff(x, prepend=0.0)
    x = x + np.cumsum(rng.uniform(0.0, 0.03) * np.sqrt(growth) * rng.standard_normal(STEPS))
    reached, t = x >= LIMIT, share[measured] * days
    std = math.exp(rng.uniform(math.log(0.002), math.log(0.02)))
    warm = 5.0 * np.sin(2.0 * np.pi * t / rng.uniform(1.0, 365.0)) + 2.0 * rng.standard_normal(count)
    effect = rng.normal(0.0, 0.005) if temperature else 0.0
    value = x[measured] + effect * warm + std * rng.standard_normal(count)
    covariates = {"temperature": warm} if temperature else {}
    series = SizeSeries(kind, t * DAY_S, value, np.full(count, std), covariates)
    return Course(kind, series, float(share[np.argmax(reached)]) * days * DAY_S if reached.any() else math.inf)


def ours(series: SizeSeries) -> Interval | None:
    """Return the interval of the remaining time [s] as the command gives it."""
    found = prognose(series, LIMIT)
    if found.outlook != "forecast" or found.remaining_s is None:
        return None
    low, middle, high = (math.inf if each is None else each for each in found.remaining_s)
    return low, middle, high


def line(series: SizeSeries) -> Interval | None:
    """Extrapolate the straight line of least squares, with the interval of its slope, where that is significant."""
    t = series.t - series.t[-1]
    A = np.stack([np.ones_like(t), t / DAY_S, *(each - each.mean() for each in series.covariates.values())], axis=1)
    fit, *_ = np.linalg.lstsq(A, series.value, rcond=None)
    rest = series.value - A @ fit
    slope, error = fit[1], math.sqrt(rest @ rest / (t.size - A.shape[1]) * np.linalg.inv(A.T @ A)[1, 1])
    if slope < 3.0 * error:
        return None
    return tuple((LIMIT - fit[0]) / each * DAY_S for each in (slope + 1.645 * error, slope, slope - 1.645 * error))


def progpy_forecaster() -> Forecaster:
    """Return ProgPy's way: its Kalman filter on a level with a rate that may walk, then Monte Carlo to the limit.

    The user of ProgPy brings model and noise; here the rate may walk by half of the mean rate over the life, and the
    noise is the true one. Nothing in it decides whether there is wear at all; a rate three deviations above 0 is asked.
    """
    from progpy import LinearModel
    from progpy.state_estimators import KalmanFilter
    from progpy.uncertain_data import MultivariateNormalDist

    class Wear(LinearModel):  # type: ignore[misc]
        inputs, states, outputs, events = (), ("level", "rate"), ("size",), ("worn",)
        A, B, E = np.array([[0.0, 1.0], [0.0, 0.0]]), np.zeros((2, 0)), np.zeros((2, 1))
        C, D, F, G = np.array([[1.0, 0.0]]), np.zeros((1, 1)), np.array([[-1.0, 0.0]]), np.array([[1.0]])

    def forecast(series: SizeSeries) -> Interval | None:
        t = (series.t - series.t[0]) / DAY_S
        level = correct_covariates(series)
        rate = max(LIMIT / 500.0, 1e-9)
        model = Wear()
        start = MultivariateNormalDist(
            ("level", "rate"), np.array([level[0], 0.0]), np.diag([float(series.std[0]) ** 2, (10.0 * rate) ** 2])
        )
        step = float(np.median(np.diff(t)))
        Q = np.diag([1e-8, (0.5 * rate) ** 2 * step / max(t[-1], 1.0)])
        filter_ = KalmanFilter(model, start, t0=0.0, dt=1e9, Q=Q, R=np.array([[float(series.std[0]) ** 2]]))
        for time, value in zip(t[1:], level[1:], strict=True):
            # its clock adds up the steps, and runs ahead by their rounding
            filter_.estimate(
                max(float(time), filter_.t + 1e-9),
                model.InputContainer({}),
                model.OutputContainer({"size": float(value)}),
            )
        mean = np.array([filter_.x.mean["level"], filter_.x.mean["rate"]])
        rng = np.random.default_rng(0)
        draws = rng.multivariate_normal(mean, np.atleast_2d(filter_.x.cov), 2000)
        if mean[1] < 3.0 * math.sqrt(float(np.atleast_2d(filter_.x.cov)[1, 1])):
            return None
        left = np.where(draws[:, 1] > 0.0, (LIMIT - draws[:, 0]) / np.maximum(draws[:, 1], 1e-12), np.inf) * DAY_S
        low, middle, high = np.quantile(left, [0.05, 0.5, 0.95], method="inverted_cdf").tolist()
        return low, middle, high

    return forecast


def surpyval_forecaster(others: Sequence[Course]) -> Forecaster:
    """Return SurPyval's way: lives of like machines by lines through their sizes, and what that leaves of a life."""
    from surpyval import DegradationAnalysis

    columns = [(one.series.t / DAY_S, one.series.value, np.full(one.series.t.size, i)) for i, one in enumerate(others)]
    t, x, unit = (np.concatenate(column) for column in zip(*columns, strict=True))
    model = DegradationAnalysis.fit(t, x, unit, threshold=LIMIT).life_model

    def forecast(series: SizeSeries) -> Interval | None:
        age = float(series.t[-1]) / DAY_S
        alive = float(np.squeeze(model.sf(age)))
        left = [float(np.squeeze(model.qf(1.0 - alive * (1.0 - q)))) - age for q in (0.05, 0.5, 0.95)]
        return left[0] * DAY_S, left[1] * DAY_S, left[2] * DAY_S

    return forecast


def correct_covariates(series: SizeSeries) -> FloatArray:
    """Return the values with what a straight line and the covariates explain of the covariates taken out."""
    if not series.covariates:
        return series.value
    columns = [each - each.mean() for each in series.covariates.values()]
    A = np.stack([np.ones_like(series.t), series.t - series.t[0], *columns], axis=1)
    fit, *_ = np.linalg.lstsq(A, series.value, rcond=None)
    return np.asarray(series.value - A[:, 2:] @ fit[2:])


@functools.cache
def look(one: Course, forecaster: Forecaster) -> list[tuple[float, float, Interval | None]]:
    """Return for each share of the life what remains of it [s], and the forecast."""
    known = [(share, one.until(share)) for share in SHARES]
    return [(share, one.life - float(series.t[-1]), forecaster(series)) for share, series in known]


def score(courses: Sequence[Course], forecaster: Forecaster) -> list[str]:
    """Return the cells of a forecaster: given, interval holds, width at half of the life, alpha-lambda accuracy."""
    given, held, widths, close = 0, 0, [], {share: 0 for share in SHARES}
    for one in courses:
        for share, truth, found in look(one, forecaster):
            width = math.inf
            if found is not None:
                given += 1
                held += found[0] <= truth <= found[2]
                close[share] += abs(found[1] - truth) <= ALPHA * truth
                width = (found[2] - found[0]) / truth
            if share == 0.5:
                widths.append(width)
    total = len(courses) * len(SHARES)
    accuracy = ", ".join(f"{100 * n / len(courses):.0f}" for n in close.values())
    return [
        f"{100 * given / total:.0f}",
        f"{100 * held / max(given, 1):.1f}",
        f"{float(np.median(widths)):.2f}",
        accuracy,
    ]


def is_silent(seed: int, forecaster: Forecaster) -> bool:
    """Return whether nothing is forecast at any look at a history without wear."""
    quiet = course(seed, "none", temperature=bool(seed % 2)).series
    return all(forecaster(cut(quiet, t)) is None for t in np.linspace(0.2, 1.0, LOOKS) * quiet.t[-1])


def main() -> None:
    """Print the tables."""
    command = parser(__doc__)
    command.add_argument("--share", type=float, default=1.0, help="how much of the courses, 0 to 1")
    command.add_argument("--alone", action="store_true", help="without the other libraries")
    given = command.parse_args()
    if missing := [name for name in ("progpy", "surpyval") if find_spec(name) is None and not given.alone]:
        command.error(f"{' and '.join(missing)}: pip install -r benchmarks/requirements-prognosis.txt, or --alone")
    count = round(COURSES * given.share)
    drawn = [course(seed, KINDS[seed % len(KINDS)], temperature=bool(seed // len(KINDS) % 2)) for seed in range(count)]
    drawn = [each for each in drawn if math.isfinite(each.life)]
    groups = {"all": drawn, **{kind: [each for each in drawn if each.kind == kind] for kind in KINDS}}
    groups["with temperature"] = [each for each in drawn if each.series.covariates]
    for kind in OTHERS[1:]:
        groups[kind] = [course(seed, kind, temperature=bool(seed % 2)) for seed in range(round(UNKNOWN * given.share))]
    forecasters = {"servoscope": ours, "straight line": line}
    if not given.alone:
        forecasters["ProgPy"] = progpy_forecaster()
    rows = []
    for name, forecaster in forecasters.items():
        for group, courses in groups.items():
            rows.append((name, group, f"{len(courses)}", *score(courses, forecaster)))
    if not given.alone:
        others = [course(COURSES + seed, "linear", temperature=False) for seed in range(20)]
        of_lives = surpyval_forecaster(others)
        rows.append(("SurPyval", "linear", f"{len(groups['linear'])}", *score(groups["linear"], of_lives)))
    quiet = range(round(QUIET * given.share))
    silent = []
    for name, forecaster in forecasters.items():
        silent.append((name, f"{sum(is_silent(seed, forecaster) for seed in quiet)} of {len(quiet)}"))
    columns = (
        "by",
        "wear",
        "courses",
        "forecasts given (%)",
        "90 % interval holds (%)",
        "median width at half of the life",
    )
    looks = ", ".join(f"{100 * share:.0f}" for share in SHARES)
    note = (
        f"Looked at after {looks} % of the life; widths in shares of what remains. Two rates and slowing are no part "
        "of all: the method does not know such courses."
    )
    show(
        [
            Table("Remaining time", note, (*columns, "median within 20 % (%), by look"), tuple(rows)),
            Table(
                "Histories without wear", f"Looked at {LOOKS} times each.", ("by", "no forecast ever"), tuple(silent)
            ),
        ],
        given.json,
    )
