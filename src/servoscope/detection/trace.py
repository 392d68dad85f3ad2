"""A monitor's output over time, and the statistics that raise its alarm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.short_repr import ShortRepr
from servoscope.estimation.frequency_response import FrequencyResponse

UNSEEN_EXCESS = 0.1  # relative, by which a motion is outside of the baseline's from which on it counts as never seen


@dataclass(frozen=True, eq=False)
class Statistic:
    """One of the statistics that raise the alarm, over K evaluations."""

    name: str  # ``t2``; ``cusum``, the sequential test; ``features``, what the loop shows besides its coefficients
    value: FloatArray  # shape (K,)
    limit: float | FloatArray
    exceeded: BoolArray  # shape (K,)


def detection_statistics(
    t2: FloatArray,
    limit: float | FloatArray,
    cusum: FloatArray,
    ready: BoolArray,
    features: FloatArray | None = None,
    motion: FloatArray | None = None,
) -> tuple[Statistic, ...]:
    """Return the statistics that raise the alarm, each with where it is above its limit.

    `motion`: how far the motion is outside of the baseline's; the sequential test, which knows no model error, is
    silent from `UNSEEN_EXCESS` on.
    """
    known = ready if motion is None else ready & (motion < UNSEEN_EXCESS)
    statistics = (
        Statistic("t2", t2, limit, ready & (t2 > limit)),
        Statistic("cusum", cusum, 1.0, known & (cusum >= 1.0)),
    )
    return statistics if features is None else (*statistics, Statistic("features", features, 1.0, features > 1.0))


def any_exceeded(statistics: tuple[Statistic, ...]) -> BoolArray:
    """Return where one of the statistics is above its limit, shape (K,)."""
    return np.logical_or.reduce([statistic.exceeded for statistic in statistics])  # type: ignore[no-any-return]


COMPARED_COLUMNS = "covariance", "expected", "statistic", "ready"
ASSET_COLUMNS = "theta", "covariance", "expected", "statistic", "level", "crossed", "ready"


@dataclass(frozen=True, eq=False, repr=False)
class Trace(ShortRepr):
    """The output of a monitor over time, K evaluations; for a fleet all shapes begin with the assets.

    Examples
    --------
    >>> monitor, recording = ss.Monitor("baseline.json"), ss.read("friday.csv", "loop.toml")
    >>> _, trace = monitor.run(monitor.init(), recording.r, recording.u, recording.y)
    >>> trace.theta.shape
    (600, 4)
    """

    t: FloatArray  # in s, shape (K,)
    names: tuple[str, ...]  # of the n coefficients
    # theta, covariance: the estimate, shapes (K, n) and (K, n, n); where the loop can be simulated, without the biases
    # of the regression by intersample behaviour and by noise in the regressors
    theta: FloatArray
    covariance: FloatArray
    expected: FloatArray  # what a healthy loop would show under the same reference, shape (K, n)
    statistic: FloatArray  # T^2, shape (K,)
    threshold: float | FloatArray  # of the statistic; for a fleet one per asset, shape (assets, 1)
    level: FloatArray  # largest CUSUM since the evaluation before, as a multiple of its limit, shape (K,); 0: no CUSUM
    crossed: FloatArray  # when a CUSUM passed its limit [s], NaN where none is above it, shape (K,)
    ifrf: FrequencyResponse  # at the monitored frequencies, of `theta`
    ifrf_expected: FrequencyResponse  # and of `expected`
    ready: BoolArray  # whether the estimator had learned anything by then, shape (K,)
    # score of the features of the spans so far, as a multiple of its limit, shape (K,); None where none were learned
    features: FloatArray | None = None
    # how far the motion is outside of the baseline's, relative, shape (K,), with `Monitor(motion_check=True)`; T^2 then
    # knows the model's error there
    motion: FloatArray | None = None

    def _shown_facts(self) -> dict[str, object]:
        span = f"{self.t[0]:.4g} to {self.t[-1]:.4g} s" if self.t.size else "none"
        return {"evaluations": self.t.size, "span": span, "coefficients": ", ".join(self.names)}

    def lane(self, asset: int) -> Trace:
        """Return that of one asset of a fleet."""
        part = {name: getattr(self, name)[asset] for name in ASSET_COLUMNS}
        responses = {name: getattr(self, name) for name in ("ifrf", "ifrf_expected")}
        for name, response in responses.items():
            part[name] = FrequencyResponse(response.frequencies, response.H[asset], response.covariance[asset])
        for name in ("features", "motion"):
            part[name] = None if getattr(self, name) is None else getattr(self, name)[asset]
        return Trace(self.t, self.names, threshold=float(np.asarray(self.threshold)[asset, 0]), **part)

    def with_lanes(self, lanes: Sequence[Trace]) -> Trace:
        """Return that of a fleet whose assets were compared by themselves; a motion not checked has no excess."""
        healthy = [lane.ifrf_expected for lane in lanes]
        checked = any(lane.motion is not None for lane in lanes)
        motion = [np.zeros(len(self.t)) if lane.motion is None else lane.motion for lane in lanes]
        compared: dict[str, Any] = {
            name: np.array([getattr(lane, name) for lane in lanes]) for name in COMPARED_COLUMNS
        }
        return replace(
            self,
            **compared,
            ifrf_expected=FrequencyResponse(
                healthy[0].frequencies,
                np.array([response.H for response in healthy]),
                np.array([response.covariance for response in healthy]),
            ),
            motion=np.array(motion) if checked else None,
        )

    @cached_property
    def statistics(self) -> tuple[Statistic, ...]:
        """The statistics that raise the alarm: T^2, the sequential test and, where they were learned, the features."""
        return detection_statistics(self.statistic, self.threshold, self.level, self.ready, self.features, self.motion)

    @cached_property
    def exceeded(self) -> BoolArray:
        """Whether any of the statistics is above its limit, without on-delay and off-delay, shape (K,)."""
        return any_exceeded(self.statistics)

    def table(self) -> dict[str, FloatArray]:
        """Return the columns of ``diagnose --trace``: t, theta_0 ..., ifrf_1Hz_real ..., statistic, threshold, level.

        Level and features are the sequential test's and the features', which alarm at 1.
        """
        columns = {"t": self.t}
        for i in range(self.theta.shape[1]):
            columns[f"theta_{i}"] = self.theta[:, i]
        for i, f in enumerate(self.ifrf.frequencies):
            columns[f"ifrf_{f:g}Hz_real"] = self.ifrf.H[:, i].real
            columns[f"ifrf_{f:g}Hz_imag"] = self.ifrf.H[:, i].imag
        columns["statistic"] = self.statistic
        columns["threshold"] = np.full(len(self.t), self.threshold)
        columns["level"] = self.level
        if self.features is not None:
            columns["features"] = self.features
        if self.motion is not None:
            columns["motion"] = self.motion
        return columns
