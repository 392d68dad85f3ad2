"""When a size will reach a limit: first passage, drawn from the posterior of its wear, and what can be said of it."""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, computed_field

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import PrognosisError
from servoscope.core.messages import Message, MessageField, message, render
from servoscope.prognosis.series import SizeSeries
from servoscope.prognosis.wear import WearPosterior, fit_wear

Outlook = Literal["forecast", "reached", "none"]
POINTS = 120  # values that are fitted; longer series are thinned to that
MIN_POINTS = 8
# A history without wear exceeds these odds at any of its looks with a probability of 1 / 20 at most (Ville 1939: odds
# are a martingale there).
MIN_ODDS = 20.0
MAX_ODDS_SHOWN = 1000.0  # odds beyond which their number says nothing more
MIN_DIRECTION_PROBABILITY = 0.95
DRAWS, STEPS = 2000, 200
HORIZON = 10.0  # how far is looked ahead, in lengths of the history
DAY_S = 86400.0
UNITS = (("hours", 3600.0, 48.0), ("days", DAY_S, 21.0), ("weeks", 7 * DAY_S, 26.0), ("months", 30.44 * DAY_S, 24.0))
YEAR_S = 365.25 * DAY_S


class Prognosis(BaseModel):
    """How a size grows, and when it reaches a limit.

    Parameters
    ----------
    name, limit, coverage
        What was asked: of which size, until which value, for intervals of which probability.
    points, from_t, to_t
        How many values there were, from when until when [UTC s].
    outlook
        ``none``: nothing can be said, and the headline says why.
    value, rate_per_day
        Level at the last time and its rate, covariates at their means: lower end, median, upper end.
    remaining_s
        From the last value until the limit is reached [s]: the shortest interval of that probability, around the
        median; None for an end that lies beyond ten times the history.
    odds
        How many times better wear explains the values than no wear.
    effects
        By covariate: what one unit of it adds to the value: lower end, median, upper end.
    reasons
        What the outlook rests on, sentence by sentence; as text: `explanation`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    limit: float
    coverage: float
    points: int
    from_t: float
    to_t: float
    outlook: Outlook
    value: tuple[float, ...] | None = None
    rate_per_day: tuple[float, ...] | None = None
    remaining_s: tuple[float | None, ...] | None = None
    odds: float | None = None
    effects: dict[str, tuple[float, float, float]] = {}
    headline: MessageField
    reasons: tuple[MessageField, ...] = ()

    @computed_field  # type: ignore[prop-decorator]
    @property
    def summary(self) -> str:
        """The outlook in one sentence."""
        return render(self.headline)

    @computed_field  # type: ignore[prop-decorator]
    @property
    def explanation(self) -> tuple[str, ...]:
        """The reasons as text."""
        return tuple(map(render, self.reasons))


def prognose(series: SizeSeries, limit: float, coverage: float = 0.9) -> Prognosis:
    """Return how a size grows and when it reaches `limit`.

    Parameters
    ----------
    series
        The values; what was before a repair is left out by `SizeSeries.after`.
    limit
        The value at which the machine is to be stopped: above the values or below them.
    coverage
        Probability of the intervals.

    Raises
    ------
    PrognosisError
        If limit or coverage are no numbers that have a meaning.
    """
    if not math.isfinite(limit) or not 0.0 < coverage < 1.0:
        raise PrognosisError(f"limit {limit:g}, coverage {coverage:g}: a number, and one between 0 and 1, are needed")
    first, last = float(series.t[0]), float(series.t[-1])
    asked: dict[str, Any] = {
        "name": series.name,
        "limit": limit,
        "coverage": coverage,
        "points": series.t.size,
        "from_t": first,
        "to_t": last,
    }
    about = {"name": series.name, "limit": limit}
    if len(np.unique(series.t)) < MIN_POINTS:
        headline = message("prognosis.few", **about, points=series.t.size, least=MIN_POINTS)
        return Prognosis(**asked, outlook="none", headline=headline)
    # The same values always lead to the same sentence.
    rng = np.random.default_rng(0)
    thinned = series.thinned(POINTS)
    posterior = fit_wear(thinned, rng)
    drawn = draw_passages(posterior, limit, rng)
    ends = (0.5 - coverage / 2.0, 0.5, 0.5 + coverage / 2.0)
    towards = float(np.mean(drawn.rate * np.sign(limit - posterior.origin) > 0.0))
    odds = math.exp(min(posterior.log_odds, 700.0))
    rate = _quantiles(drawn.rate * DAY_S / posterior.length_s, ends)
    effects = {
        name: _quantiles(drawn.effects[:, k] * posterior.range / float(column.std()), ends)
        for k, (name, column) in enumerate(thinned.covariates.items())
        if column.std() > 0.0
    }
    value = _quantiles(drawn.level, ends)
    history = message("prognosis.history", points=series.t.size, span=_span(last - first))
    reasons = [
        message("prognosis.level", name=series.name, level=_estimate(value), rate=_estimate(rate)),
        message("prognosis.odds" if odds < MAX_ODDS_SHOWN else "prognosis.certain", history=history, odds=odds),
        *(
            message("prognosis.effect", name=series.name, covariate=effect, size=_estimate(effects[effect]))
            for effect in effects
        ),
    ]
    asked |= {"value": value, "rate_per_day": rate, "odds": odds, "effects": effects, "reasons": reasons}
    if float(np.mean(drawn.passage == 0.0)) > 0.5:
        return Prognosis(**asked, outlook="reached", headline=message("prognosis.reached", **about, value=value[1]))
    if odds < MIN_ODDS or towards < MIN_DIRECTION_PROBABILITY:
        key = "receding" if odds >= MIN_ODDS and towards < 1.0 - MIN_DIRECTION_PROBABILITY else "steady"
        return Prognosis(**asked, outlook="none", headline=message(f"prognosis.{key}", **about, history=history))
    passage = shortest_interval(drawn.passage * posterior.length_s, coverage)
    remaining = tuple(time if math.isfinite(time) else None for time in passage)
    asked["remaining_s"] = remaining
    if remaining[0] is None:
        horizon = _span(HORIZON * posterior.length_s)
        headline = message("prognosis.far", **about, history=history, span=horizon)
        return Prognosis(**asked, outlook="none", headline=headline)
    return Prognosis(**asked, outlook="forecast", headline=_headline(about, passage))


class Draws(NamedTuple):
    """Draws from the posterior, at the last value.

    `rate`: per history; `effects`: of the covariates, in ranges of the values per standard deviation, shape
    (draws, covariates); `passage`: time until the limit [histories], inf where it is beyond the horizon.
    """

    level: FloatArray
    rate: FloatArray
    effects: FloatArray
    passage: FloatArray


def draw_passages(posterior: WearPosterior, limit: float, rng: np.random.Generator) -> Draws:
    """Draw courses from the posterior, and follow each until it reaches the limit."""
    index = rng.choice(posterior.weight.size, DRAWS, p=posterior.weight)
    courses, mean = posterior.courses.take(index), posterior.mean[index]
    root = np.linalg.cholesky(posterior.covariance[index] + 1e-15 * np.eye(mean.shape[1]))
    state = mean + (root @ rng.standard_normal((*mean.shape, 1)))[:, :, 0]
    x, c = state[:, 0], state[:, 1]
    goal = (limit - posterior.origin) / posterior.range
    sign = 1.0 if goal >= 0.0 else -1.0
    slope = c * courses.slope()
    level, passage = x, np.where(sign * x >= sign * goal, 0.0, np.inf)
    before, before_t = courses.clock(1.0), 0.0
    for t in np.geomspace(1e-3, HORIZON, STEPS):
        clock, dt = courses.clock(1.0 + t), float(t - before_t)
        old, step = x, clock - before
        x = x + c * step + courses.diffusion * np.sqrt(step) * rng.standard_normal(DRAWS)
        c = c + courses.walk * math.sqrt(dt) * rng.standard_normal(DRAWS)
        new = (sign * x >= sign * goal) & np.isinf(passage)
        passage[new] = before_t + dt * ((goal - old[new]) / (x[new] - old[new]))
        before, before_t = clock, float(t)
    return Draws(posterior.origin + posterior.range * level, posterior.range * slope, state[:, 2:], passage)


def _quantiles(draws: FloatArray, ends: tuple[float, float, float]) -> tuple[float, float, float]:
    low, middle, high = np.quantile(draws, ends, method="inverted_cdf").tolist()
    return low, middle, high


def shortest_interval(draws: FloatArray, coverage: float) -> tuple[float, float, float]:
    """Return the ends of the shortest interval that holds a share of the draws, around their median.

    Times to a limit have a long tail: equal shares on both sides would tell more of it, and less of what may come soon.
    Where too many draws have no end, there is only an earliest.
    """
    ordered, held = np.sort(draws), math.ceil(coverage * draws.size)
    low, high = ordered[: draws.size - held + 1], ordered[held - 1 :]
    finite = int(np.isfinite(high).sum())
    first = int(np.argmin(high[:finite] - low[:finite])) if finite else low.size - 1
    return float(low[first]), float(ordered[(draws.size - 1) // 2]), float(high[first])


def _estimate(interval: tuple[float, float, float]) -> Message:
    low, value, high = interval
    return message("prognosis.estimate", value=value, low=low, high=high)


def _headline(about: dict[str, Any], passage: tuple[float, float, float]) -> Message:
    low, middle, high = passage
    if not math.isfinite(high):
        return message("prognosis.from", **about, low=_span(low))
    unit, size = _unit(high)
    span = message(f"prognosis.{unit}", value=f"{_round(low / size)} to {_round(high / size)}")
    return message("prognosis.within", **about, span=span, likely=message("prognosis.likely", span=_span(middle)))


def _span(seconds: float) -> Message:
    unit, size = _unit(seconds)
    return message(f"prognosis.{unit}", value=_round(seconds / size))


def _unit(seconds: float) -> tuple[str, float]:
    for name, size, most in UNITS:
        if seconds < most * size:
            return name, size
    return "years", YEAR_S


def _round(value: float) -> str:
    return f"{value:.2g}" if value < 10.0 else f"{value:.0f}"
