"""The sequential test's design: which changes it listens for, from which size on, and where each of them alarms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from servoscope.cusum import LAGS, Watch, columns, whitening
from servoscope.detection import SECONDS_PER_YEAR
from servoscope.errors import LoopError, SimulationError
from servoscope.inverse import closed_loop, nominal_theta
from servoscope.noise import Noise
from servoscope.pipeline import Pipeline
from servoscope.plants import FloatArray, Plant
from servoscope.signatures import Expectation, colour_of

FACTOR = 4.0  # in information from one size to the next: in between, a CUSUM is at most a fifth slower than the best
FASTEST = 2000.0  # 1/s; a change with more information shows within a few samples anyway
OVERSHOOT = 1.166  # twice Siegmund's 0.583: by how much a random walk passes its limit, in its own steps
SLOWEST = 0.05  # 1/s; with less, a change would take a quarter of an hour
TRIED = 8  # sizes per direction at which the information is computed
STEP = 1e-3  # of the logarithm of a parameter, for derivatives
FEWEST = 500  # updates with less of which a reference says nothing
LONGEST = 60.0  # s of a healthy recording by which the test is designed
HARDEST = 1.3  # a limit raised by more than this for the baseline's own uncertainty is not worth having


@dataclass(frozen=True)
class Member:
    """One expected change, and what its CUSUM would do to a healthy loop.

    Parameters
    ----------
    parameter, ratio
        What changes, and to how many times its healthy value.
    change
        Weights of the shadow's columns (see `servoscope.cusum.columns`) that it looks like.
    rate
        False alarms per year at a limit of zero, to be divided by exp(limit).
    drift
        Variance of the drift that an error of the baseline causes, in units of the drift under the change.
    """

    parameter: str
    ratio: float
    change: tuple[float, ...]
    rate: float
    drift: float

    def limit(self, false_alarms_per_year: float) -> float:
        """Return where the CUSUM alarms; infinity where the baseline is too uncertain for so small a change.

        The limit solves rate exp(-h + 2 h^2 drift) = budget: averaged over the baseline's error, which is Gaussian,
        false alarms grow by the second term.
        """
        level = float(np.log(max(self.rate / false_alarms_per_year, np.e)))
        if 8.0 * self.drift * level >= 1.0:
            return np.inf
        h = 2.0 * level / (1.0 + float(np.sqrt(1.0 - 8.0 * self.drift * level)))
        return h if h <= HARDEST * level else np.inf


def members(expectation: Expectation, plant: Plant, noise: Noise, covariance: FloatArray) -> tuple[Member, ...]:
    """Choose the changes to listen for.

    A CUSUM whose steps shift by m(k) standard deviations under its change raises m^2/2 exp(-h - 1.166 m) false alarms
    per step at a limit h (Siegmund, 1985, chapter 10).

    Parameters
    ----------
    expectation
        Of a healthy recording.
    plant
        The healthy plant.
    noise
        Of the loop.
    covariance
        Of the logarithms of the plant's parameters, shape (m, m).
    """
    bench = _Bench(_first(expectation), plant, noise)
    if len(bench.phi) < FEWEST:
        return ()
    size = np.sqrt((bench.phi**2).mean(axis=0))
    found = []
    for fault in plant.faults:
        for bound in np.log(fault.ratio_range):
            for x in _sizes(partial(bench.shift, fault.parameter), float(bound), bench.rate):
                try:
                    d = bench.shift(fault.parameter, x)
                except SimulationError:
                    continue
                change = np.linalg.lstsq(bench.phi / size, d, rcond=None)[0] / size
                found.append(Member(fault.parameter, float(np.exp(x)), tuple(change.tolist()), 0.0, 0.0))
    return bench.rated(found, covariance)


def rated(
    expectation: Expectation, plant: Plant, noise: Noise, covariance: FloatArray, chosen: Sequence[Member]
) -> tuple[Member, ...]:
    """Return the same changes with rate and drift under another reference where those are worse; see `members`."""
    return _Bench(_first(expectation), plant, noise).rated(chosen, covariance)


def _first(expectation: Expectation) -> Expectation:
    return expectation.first(span(expectation.pipeline))


def span(pipeline: Pipeline) -> float:
    """Return how much of a reference the design needs [s]."""
    return max(LONGEST, 10.0 * FEWEST * pipeline.stride / pipeline.loop.sample_rate)


class _Bench:
    """The whitened residual of the simulated loop under one reference, and how changes of the plant shift it."""

    def __init__(self, expectation: Expectation, plant: Plant, noise: Noise) -> None:
        pipeline = expectation.pipeline
        self.expectation, self.plant = expectation, plant
        self.rate = pipeline.loop.sample_rate / pipeline.stride
        self.white = colour_of(pipeline, plant, noise)
        self.theta, self.warm = nominal_theta(pipeline.loop, plant), whitening(self.white)[3]
        g = expectation.regression(plant)
        self.phi = columns(self.white.whiten(g.phi[g.ok]))[self.warm :]
        self.healthy = self.white.whiten((g.eta - g.phi @ self.theta)[g.ok])

    def shift(self, parameter: str, x: float) -> FloatArray:
        """Return what moving the logarithm of a parameter by x adds to the residual, update by update."""
        ill = self.plant.with_ratios({parameter: float(np.exp(x))})
        return (self.white.whiten(self.expectation.residual(ill, self.theta)) - self.healthy)[self.warm :]

    def rated(self, chosen: Sequence[Member], covariance: FloatArray) -> tuple[Member, ...]:
        """Return the members with rate and drift under this reference where they are worse than those that stand."""
        if len(self.phi) < FEWEST:
            return tuple(chosen)
        drift = np.array([self.shift(parameter, STEP) / STEP for parameter in self.plant.parameters])
        found = []
        for member in chosen:
            d = self.phi @ np.array(member.change)
            m = np.abs(d)
            false = self.rate * float((0.5 * m**2 * np.exp(-OVERSHOOT * m)).mean()) * SECONDS_PER_YEAR
            q = drift @ d / max(float(d @ d), 1e-300)
            worst = max(member.rate, false), max(member.drift, float(q @ covariance @ q))
            found.append(replace(member, rate=worst[0], drift=worst[1]))
        return tuple(found)


def _sizes(shift: Callable[[float], FloatArray], bound: float, rate: float) -> list[float]:
    """Return sizes between nothing and a bound, `FACTOR` apart in information per second, largest first.

    The information is computed at a few sizes and read off in between on logarithmic scales.
    """
    tried, information = [], []
    for x in np.geomspace(abs(bound), 1e-3, TRIED) * np.sign(bound):
        try:
            d = shift(float(x))
        except SimulationError:  # nobody could have recorded it
            continue
        tried.append(float(np.log(abs(x))))
        information.append(float(np.log(max(rate * float(d @ d) / len(d), 1e-300))))
    if not tried:
        return []
    logs = np.minimum.accumulate(np.array(information))[::-1]  # a larger change may tell less: the smaller one counts
    target, sizes = min(np.log(FASTEST), logs[-1]), []
    while target >= max(np.log(SLOWEST), logs[0]):
        sizes.append(float(np.sign(bound) * np.exp(np.interp(target, logs, np.array(tried)[::-1]))))
        target -= np.log(FACTOR)
    return sizes


def watch(
    pipeline: Pipeline,
    plant: Plant,
    noise: Noise,
    scale: FloatArray,
    chosen: Sequence[Member],
    false_alarms_per_year: float,
) -> Watch | None:
    """Turn the design into what the compiled test takes; None where there is nothing to listen for.

    Parameters
    ----------
    pipeline
        The recursion beside which it runs.
    plant
        The healthy plant, which the shadow simulates.
    noise
        Of the loop; louder noise makes it deafer.
    scale
        Of phi, shape (n,).
    chosen
        As `members` returned them.
    false_alarms_per_year
        Budget of all of them together.
    """
    share = false_alarms_per_year / max(len(chosen), 1)
    heard = [member for member in chosen if np.isfinite(member.limit(share))]
    if not heard:
        return None
    limits = np.array([member.limit(false_alarms_per_year / len(heard)) for member in heard])
    try:
        quiet = closed_loop(pipeline.loop, plant).input(np.eye(3, 1))
    except LoopError as error:
        raise SimulationError(str(error)) from None
    shadow = quiet.then(pipeline.bank.linear)
    numerator, denominator, gain, warm = whitening(colour_of(pipeline, plant, noise))
    rows = np.concatenate([[1.0], 1.0 / scale])[:, None]
    return Watch(
        A=shadow.A,
        B=shadow.B,
        C=np.ascontiguousarray(rows * shadow.C),
        D=np.ascontiguousarray(rows * shadow.D),
        X0=shadow.steady,
        theta=nominal_theta(pipeline.loop, plant) * scale,
        numerator=numerator,
        denominator=denominator,
        gain=gain,
        warm=warm,
        changes=np.ascontiguousarray(
            np.array([member.change for member in heard]) * np.pad(scale, (0, LAGS), mode="edge")
        ),
        limits=limits,
    )
