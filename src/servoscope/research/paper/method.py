"""The paper's three steps: residual generator, evaluator with prescribed thresholds, fault manager."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from servoscope.core.arrays import ComplexArray, FloatArray
from servoscope.estimation import two_stage
from servoscope.estimation.filter_bank import nominal_theta
from servoscope.estimation.pipeline import Pipeline, Tuning
from servoscope.fit.tuning import fit_tuning
from servoscope.models.loop import Loop
from servoscope.research.paper.conditions import FREQUENCIES, SIZES, TABLE_2
from servoscope.signals import Recording

INITIAL_COVARIANCE_FACTOR = 100.0  # P(0)/P_d: where the recursion starts from zero it must not believe it
MARGIN = 1.5  # prescribed thresholds, relative to the largest healthy residual
MIN_EXCEEDANCE_S = 1.0  # s that a residual has to stay beyond its threshold
SETTLING_S = 20.0  # s after which the evaluator listens
GRID = 121  # sizes along a signature
RATIO_RANGES = {parameter: (min(sizes) / 2.0, max(sizes) * 2.0) for parameter, sizes in SIZES.items()}


@dataclass(frozen=True, eq=False)
class ResidualTrace:
    """What the residual generator says over time."""

    t: FloatArray  # times [s], shape (K,)
    theta: FloatArray  # estimates, shape (K, n)
    H: ComplexArray  # H, gamma: iFRF of eq. (13) and Gamma of eq. (14) at 1, 10 and 20 Hz [A/m], shape (K, 3).
    gamma: ComplexArray

    def between(self, from_s: float, to_s: float) -> Self:
        """Return the part of it in from_s < t <= to_s."""
        kept = (self.t > from_s) & (self.t <= to_s + 1e-9)
        return replace(self, t=self.t[kept], theta=self.theta[kept], H=self.H[kept], gamma=self.gamma[kept])


@dataclass(frozen=True, eq=False)
class ResidualGenerator:
    """Step 1: r, u, y to Gamma(k), the iFRF estimated less the nominal one; build it with `of`."""

    # pipeline, tuning: the recursion; its filter bank, stage 1 and estimator are settings of the loop
    pipeline: Pipeline
    tuning: Tuning
    nominal: ComplexArray  # H(f_d; kappa_o) from the plant's parameters, shape (3,)
    # stage 1 for y: then phi holds y_a, what the estimated map makes of r, in the place of the raw y; None: raw
    output_stage: two_stage.StageOneTuning | None = None

    @classmethod
    def from_loop(cls, loop: Loop, healthy: Recording, *, filtered_y: bool = False) -> Self:
        """Tune on a healthy recording, P_d = (R/N) R_phi^-1; the nominal iFRF needs none.

        With `filtered_y`, phi holds y filtered by a stage 1 of its own, as eta holds u_a.
        """
        pipeline = Pipeline.of(loop, two_stage.tune_stage_one(loop, [healthy]))
        output_stage = two_stage.tune_stage_one(loop, [replace(healthy, u=healthy.y)]) if filtered_y else None
        generator = cls(pipeline, pipeline.blank(), pipeline.bank.E(FREQUENCIES) @ nominal_theta(loop), output_stage)
        regression = pipeline.regression(healthy.r, healthy.u, generator.output(healthy), healthy.restart)
        return replace(generator, tuning=fit_tuning(pipeline, [regression]).tuning)

    def output(self, recording: Recording) -> FloatArray:
        """Return what phi is formed from, y or y_a, shape (N,)."""
        if self.output_stage is None:
            return recording.y
        stage = two_stage.StageOneRunner(self.pipeline.loop, self.output_stage)
        return stage.run(stage.start(), recording.r, recording.y, recording.restart)

    def run(self, recording: Recording, *, from_zero: bool = False) -> ResidualTrace:
        """Return the residuals of a recording.

        With `from_zero` it starts at theta = 0 and P = 100 P_d, to see it converge.
        """
        from servoscope.estimation.recursion import Recursion

        pipeline = self.pipeline
        c = pipeline.constants(self.tuning, steady=False)
        recursion = Recursion([c])
        state = recursion.start()
        if from_zero:
            recursion.named(state)["theta"] = -c.theta
            recursion.named(state)["P"] *= INITIAL_COVARIANCE_FACTOR
        r, restart = recording.r, recording.restart
        u, y = pipeline.input(r, recording.u, recording.y, restart), self.output(recording)
        _, out = recursion.run(state, r[None], u[None], y[None], restart[None])
        index = recursion.rows(state, recording.samples)
        theta = pipeline.unpack(c, out[0], index).theta
        H = theta @ pipeline.bank.E(FREQUENCIES).T
        return ResidualTrace(recording.t[index], theta, H, H - self.nominal)


@dataclass(frozen=True, eq=False)
class EvaluatorResult:
    """What the evaluator says: when, which fault, its size; None: nothing."""

    detected_at_s: float | None
    fault: str | None
    ratio: float | None


@dataclass(frozen=True, eq=False)
class Evaluator:
    """Step 2: residuals against prescribed thresholds, and the nearest signature."""

    thresholds: FloatArray  # of the magnitudes of Gamma [A/m], shape (3,)
    # name of the fault -> sizes (M,) and Gamma (M, 3) along them
    signatures: Mapping[str, tuple[FloatArray, ComplexArray]]

    @classmethod
    def from_healthy(cls, loop: Loop, healthy: ResidualTrace) -> Self:
        """Prescribe 1.5 times the largest healthy residual, and take signatures from the plant's parameters."""
        largest = np.abs(healthy.between(SETTLING_S, np.inf).gamma).max(axis=0)
        return cls(MARGIN * largest, nominal_signatures(loop))

    def evaluate(self, course: ResidualTrace) -> EvaluatorResult:
        """Detect: one residual beyond its threshold for a second. Isolate at the end of the course."""
        beyond = (np.abs(course.gamma) > self.thresholds).any(axis=1) & (course.t > SETTLING_S)
        hold = round(MIN_EXCEEDANCE_S / float(course.t[1] - course.t[0]))
        lasting = np.convolve(beyond, np.ones(hold), mode="full")[: len(beyond)] >= hold - 0.5
        if not lasting.any():
            return EvaluatorResult(None, None, None)
        Gamma = course.between(float(course.t[-1]) - MIN_EXCEEDANCE_S, np.inf).gamma.mean(axis=0)
        fault, ratio = self.nearest_signature(Gamma)
        return EvaluatorResult(float(course.t[int(np.argmax(lasting))]), fault, ratio)

    def nearest_signature(self, Gamma: ComplexArray) -> tuple[str, float]:
        """Return the fault whose signature passes closest, distances in units of the thresholds, and the size."""
        best: tuple[float, str, float] = (np.inf, "", np.nan)
        for name, (sizes, curve) in self.signatures.items():
            distance = (np.abs((Gamma - curve) / self.thresholds) ** 2).sum(axis=1)
            i = int(np.argmin(distance))
            best = min(best, (float(distance[i]), name, float(sizes[i])))
        return best[1], best[2]


def nominal_signatures(loop: Loop) -> dict[str, tuple[FloatArray, ComplexArray]]:
    """Return Gamma as each fault of Table 2 grows, by the plant's parameters alone."""
    single = loop.monitor.model_copy(update={"two_stage": "none"})
    E = Pipeline.of(loop.model_copy(update={"monitor": single})).bank.E(FREQUENCIES)
    healthy = nominal_theta(loop)
    signatures = {}
    for fault in loop.plant.faults:
        low, high = np.log(RATIO_RANGES[fault.parameter])
        sizes = np.exp(np.linspace(low, high, GRID))
        faulty = [loop.plant.with_ratios({fault.parameter: float(size)}) for size in sizes]
        theta = np.array([nominal_theta(loop, plant) for plant in faulty])
        signatures[fault.name] = (sizes, (theta - healthy) @ E.T)
    return signatures


def labelled_signatures(courses: Sequence[ResidualTrace]) -> dict[str, tuple[FloatArray, ComplexArray]]:
    """Return what labelled recordings of all cases of Table 2, in its order, show at their end: no physics needed."""
    points: dict[str, tuple[list[float], list[ComplexArray]]] = {}
    for case, course in zip(TABLE_2, courses, strict=True):
        sizes, curve = points.setdefault(case.fault, ([], []))
        sizes.append(case.ratio)
        curve.append(course.between(50.0, np.inf).gamma.mean(axis=0))
    return {name: (np.array(sizes), np.array(curve)) for name, (sizes, curve) in points.items()}


@dataclass(frozen=True, eq=False)
class FaultManager:
    """Step 3: what is done about a finding."""

    # faults that a change of the controller's gains can make up for
    reconfigurable: tuple[str, ...] = ("pump", "contamination")

    def decide(self, finding: EvaluatorResult) -> str:
        """Return ``run on``, ``alarm`` or ``reconfigure``."""
        if finding.detected_at_s is None:
            return "run on"
        return "reconfigure" if finding.fault in self.reconfigurable else "alarm"
