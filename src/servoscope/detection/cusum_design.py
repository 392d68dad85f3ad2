"""The sequential test's design: which changes it listens for, from which size on, and where each of them alarms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from servoscope.baseline.expectation import Expectation, residual_noise_model
from servoscope.baseline.hypothesis import CusumHypothesis
from servoscope.baseline.threshold import SECONDS_PER_YEAR
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import LoopError, SimulationError
from servoscope.estimation.filter_bank import closed_loop_system, nominal_theta
from servoscope.estimation.kernel.cusum import (
    LAGS,
    CusumConstants,
    direction_shares,
    lagged_columns,
    lagged_directions,
    whitening_filter,
)
from servoscope.estimation.noise_model import WhiteNoise
from servoscope.estimation.pipeline import Pipeline
from servoscope.models.lti import (
    LinearSystem,
    block_diagonal,
    output_deviations,
    stretched_filter,
    truncate_states,
    unit_states,
)
from servoscope.models.plants import Plant

# in information from one size to the next: in between, a CUSUM is at most a fifth slower than the best
INFORMATION_FACTOR = 4.0
MAX_INFORMATION_RATE = 2000.0  # 1/s; a change with more information shows within a few samples anyway
# information of one step of the test: a change with more has no CUSUM of its own, and is found one step later at most
MAX_STEP_INFORMATION = 20.0
OVERSHOOT = 1.166  # twice Siegmund's 0.583: by how much a random walk passes its limit, in its own steps
MIN_INFORMATION_RATE = 0.05  # 1/s; with less, a change would take a quarter of an hour
# of a change's information at most, where changes are made of few directions: its CUSUM is a ninth slower
MAX_LOST_SHARE = 0.1
MAX_ROUNDS = 200  # in which directions are sought
SIZE_COUNT = 8  # sizes per direction at which the information is computed
SHADOW_TOLERANCE = 0.02  # of a change's size: by how much the shadow may err that serves steps once per evaluation
MOTION_TIME_S = 1.0  # s, below which a reference moves the less the faster
RANK_TOLERANCE = 1e-9  # of the largest singular value: smaller ones are rounding
STEP = 1e-3  # of the logarithm of a parameter, for derivatives
MIN_UPDATES = 500  # updates with less of which a reference says nothing
MAX_DESIGN_S = 60.0  # s of a healthy recording by which the test is designed
LEVEL_TOLERANCE = 1e-6  # of a level, by which limits that stand in its weights may change it


def sure_level(members: Sequence[CusumHypothesis], false_alarms_per_year: float) -> float:
    """Return up to which level of the test none alarms whose limits were fitted to another reference.

    Fitted limits are those of larger rates and drifts, hence higher; but where others fall away, the whole budget may
    be that of one.
    """
    limits = [member.limit(false_alarms_per_year / max(len(members), 1)) for member in members]
    kept = [member for member, limit in zip(members, limits, strict=True) if np.isfinite(limit)]
    alone = [m.limit(false_alarms_per_year) / m.limit(false_alarms_per_year / len(kept)) for m in kept]
    return (1.0 - LEVEL_TOLERANCE) * min(alone, default=1.0)


def choose_cusum_hypotheses(
    expectation: Expectation, plant: Plant, noise: WhiteNoise, covariance: FloatArray
) -> tuple[CusumHypothesis, ...]:
    """Choose the changes to listen for.

    A CUSUM whose steps shift by m(k) standard deviations under its change raises m^2/2 exp(-h - 1.166 m) false alarms
    per step at a limit h (Siegmund, 1985, chapter 10).

    `covariance`: of the logarithms of the plant's parameters, shape (m, m).
    """
    whitened = _WhitenedResidual(expectation, plant, noise)
    if len(whitened.phi) < MIN_UPDATES:
        return ()
    size = np.sqrt((whitened.phi**2).mean(axis=0))
    hypotheses = []
    for fault in plant.faults:
        for bound in np.log(fault.ratio_range):
            for x in whitened.sizes(fault.parameter, float(bound)):
                try:
                    d = whitened.shift(fault.parameter, x)
                except SimulationError:
                    continue
                change = np.linalg.lstsq(whitened.phi / size, d, rcond=None)[0] / size
                hypotheses.append(CusumHypothesis(fault.parameter, float(np.exp(x)), tuple(change.tolist()), 0.0, 0.0))
    if hypotheses and expectation.pipeline.loop.monitor.sequential_step == "evaluation":
        hypotheses = whitened.combine(hypotheses)
    return whitened.worst_case(hypotheses, covariance)


def worst_case_hypotheses(
    expectation: Expectation, plant: Plant, noise: WhiteNoise, covariance: FloatArray, chosen: Sequence[CusumHypothesis]
) -> tuple[CusumHypothesis, ...]:
    """Return the same changes with rate and drift under another reference where those are worse."""
    return _WhitenedResidual(expectation, plant, noise).worst_case(chosen, covariance)


def design_duration_s(pipeline: Pipeline) -> float:
    """Return how much of a reference the design needs [s]."""
    return max(MAX_DESIGN_S, 10.0 * MIN_UPDATES * pipeline.stride / pipeline.loop.sample_rate)


class _WhitenedResidual:
    """The whitened residual of the simulated loop under one reference, and how changes of the plant shift it."""

    def __init__(self, expectation: Expectation, plant: Plant, noise: WhiteNoise) -> None:
        pipeline = expectation.pipeline
        self.expectation, self.plant = expectation.truncate(design_duration_s(pipeline)), plant
        self.rate, self.together = pipeline.loop.sample_rate / pipeline.stride, pipeline.cusum_updates
        self.noise_model = residual_noise_model(pipeline, plant, noise)
        self.theta, self.warm_up = nominal_theta(pipeline.loop, plant), whitening_filter(self.noise_model)[3]
        g = self.expectation.regression(plant)
        self.phi = lagged_columns(self.noise_model.whiten(g.phi[g.ok]))[self.warm_up :]
        self.healthy = self.noise_model.whiten((g.eta - g.phi @ self.theta)[g.ok])

    def shift(self, parameter: str, x: float) -> FloatArray:
        """Return what moving the logarithm of a parameter by x adds to the residual, update by update."""
        faulty = self.plant.scaled({parameter: float(np.exp(x))})
        return (self.noise_model.whiten(self.expectation.mean_residual(faulty, self.theta)) - self.healthy)[
            self.warm_up :
        ]

    def sizes(self, parameter: str, bound: float) -> list[float]:
        """Return sizes between nothing and a bound, the largest first.

        They are `INFORMATION_FACTOR` apart in information per second.

        The information is computed at a few sizes and read off in between on logarithmic scales.
        """
        tried, information = [], []
        for x in np.geomspace(abs(bound), 1e-3, SIZE_COUNT) * np.sign(bound):
            try:
                d = self.shift(parameter, float(x))
            except SimulationError:  # nobody could have recorded it
                continue
            tried.append(float(np.log(abs(x))))
            information.append(float(np.log(max(self.rate * float(d @ d) / len(d), 1e-300))))
        if not tried:
            return []
        logs = np.minimum.accumulate(np.array(information))[::-1]  # a larger change may tell less: the smaller counts
        largest = np.log(MAX_STEP_INFORMATION * self.rate / self.together) if self.together > 1 else np.inf
        target, sizes = (
            min(np.log(MAX_INFORMATION_RATE), logs[-1]),
            [],
        )  # the same sizes for both steps, but for the largest
        while target >= max(np.log(MIN_INFORMATION_RATE), logs[0]):
            if target <= largest:
                sizes.append(float(np.sign(bound) * np.exp(np.interp(target, logs, np.array(tried)[::-1]))))
            target -= np.log(INFORMATION_FACTOR)
        return sizes

    def combine(self, chosen: Sequence[CusumHypothesis]) -> list[CusumHypothesis]:
        """Return the members with changes that are combinations of few, which lose at most `MAX_LOST_SHARE`."""
        R = np.linalg.qr(self.phi, mode="r")  # |R change| is the size of a change's shift
        shifts = R @ np.array([member.change for member in chosen]).T
        unit = shifts / np.linalg.norm(shifts, axis=0)
        for count in range(1, len(R) + 1):
            left, lost = _fairest_directions(unit, count)
            if lost <= MAX_LOST_SHARE:
                break
        kept = np.linalg.solve(R, left @ (left.T @ shifts))
        return [replace(member, change=tuple(change.tolist())) for member, change in zip(chosen, kept.T, strict=True)]

    def worst_case(self, chosen: Sequence[CusumHypothesis], covariance: FloatArray) -> tuple[CusumHypothesis, ...]:
        """Return the members with rate and drift under this reference where they are worse than those that stand."""
        if len(self.phi) < MIN_UPDATES:
            return tuple(chosen)
        names = self.plant.physical_parameters[: len(covariance)]
        drift = np.array([self.shift(parameter, STEP) / STEP for parameter in names])
        combined = []
        for member in chosen:
            d = self.phi @ np.array(member.change)
            # information of the updates that a step takes together
            square = d[: len(d) // self.together * self.together].reshape(-1, self.together) ** 2
            square = square.sum(axis=1)
            steps = 0.5 * square * np.exp(-OVERSHOOT * np.sqrt(square))
            false = self.rate / self.together * float(steps.mean()) * SECONDS_PER_YEAR
            q = drift @ d / max(float(d @ d), 1e-300)
            worst = max(member.rate, false), max(member.drift, float(q @ covariance @ q))
            combined.append(replace(member, rate=worst[0], drift=worst[1]))
        return tuple(combined)


def _fairest_directions(unit: FloatArray, count: int) -> tuple[FloatArray, float]:
    """Return orthonormal directions (n, count) of unit vectors (n, m), and the share that the worst of these loses.

    The worst ones get more weight in a singular value decomposition, round by round (Arora, Hazan and Kale, 2012).
    """
    weights, least = np.ones(unit.shape[1]), np.inf
    for _ in range(MAX_ROUNDS):
        left = np.linalg.svd(unit * np.sqrt(weights))[0][:, :count]
        lost = np.maximum(1.0 - ((left.T @ unit) ** 2).sum(axis=0), 0.0)
        if lost.max() < least:
            best, least = left, float(lost.max())
        weights = weights * np.exp(0.5 * lost / max(float(lost.max()), RANK_TOLERANCE))
        weights /= weights.mean()
    return best, least


def build_cusum_constants(
    pipeline: Pipeline,
    plant: Plant,
    noise: WhiteNoise,
    scale: FloatArray,
    chosen: Sequence[CusumHypothesis],
    false_alarms_per_year: float,
) -> CusumConstants | None:
    """Turn the design into what the compiled test takes; None where there is nothing to listen for.

    The plant is the healthy one, which the test simulates beside the recursion; the budget is that of all CUSUMs.
    """
    share = false_alarms_per_year / max(len(chosen), 1)
    hypotheses = [member for member in chosen if np.isfinite(member.limit(share))]
    if not hypotheses:
        return None
    limits = np.array([member.limit(false_alarms_per_year / len(hypotheses)) for member in hypotheses])
    try:
        quiet = closed_loop_system(pipeline.loop, plant).input(np.eye(3, 1))
    except LoopError as error:
        raise SimulationError(str(error)) from None
    numerator, denominator, gain, warm = whitening_filter(residual_noise_model(pipeline, plant, noise))
    theta, n = nominal_theta(pipeline.loop, plant) * scale, len(scale)
    regressors = quiet.then(pipeline.bank.linear).output(np.diag(np.concatenate([[1.0], 1.0 / scale])))
    residual = regressors.output(np.concatenate([[1.0], -theta])[None, :])
    columns = regressors.output(np.eye(n, n + 1, 1))
    changes = np.array([member.change for member in hypotheses]) * np.pad(scale, (0, LAGS), mode="edge")
    if pipeline.loop.monitor.sequential_step == "evaluation":
        _, singular, vectors = np.linalg.svd(changes / np.linalg.norm(changes, axis=1)[:, None], full_matrices=False)
        directions = vectors[singular > RANK_TOLERANCE * singular[0]]
        white = stretched_filter(numerator * gain, denominator, pipeline.stride)
        columns = white.then(columns).then(lagged_directions(directions, pipeline.stride))
        shadow = _truncate_shadow(pipeline, residual, columns, direction_shares(changes, directions), gain)
    else:
        directions = np.zeros((0, 0))
        shadow = replace(columns, C=np.vstack([residual.C, columns.C]), D=np.vstack([residual.D, columns.D]))
    return CusumConstants(
        shadow=shadow,
        theta=theta,
        numerator=numerator,
        denominator=denominator,
        gain=gain,
        warm=warm,
        changes=np.ascontiguousarray(changes),
        limits=limits,
        directions=directions,
    )


def _truncate_shadow(
    pipeline: Pipeline, residual: LinearSystem, columns: LinearSystem, shares: FloatArray, gain: float
) -> LinearSystem:
    """Return r -> [residual of the healthy loop, white columns], in few states.

    Columns only weigh the measured residual: theirs may err by `SHADOW_TOLERANCE` of each change without more false
    alarms. What is subtracted from it errs by as much of the smallest change.
    """
    pole = float(np.exp(-1.0 / (MOTION_TIME_S * pipeline.loop.sample_rate)))
    both = unit_states(block_diagonal([residual, columns]).input(np.ones((2, 1))), pole)
    rows = np.zeros((len(shares) + 1, 1 + shares.shape[1]))
    rows[0, 0], rows[1:, 1:] = gain, shares
    size = output_deviations(both.output(rows), pole)
    size[0] = size[1:].min()
    rows /= size[:, None]
    return truncate_states(both, rows, pole, SHADOW_TOLERANCE)
