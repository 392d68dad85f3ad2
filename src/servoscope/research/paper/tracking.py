"""Figs. 5, 6 and 8 in numbers: scatter, speed and bias of the paper's method and of this project's default."""

from __future__ import annotations

import functools

import numpy as np

from servoscope.core.arrays import ComplexArray
from servoscope.estimation.filter_bank import nominal_theta
from servoscope.estimation.pipeline import Pipeline
from servoscope.models.loop import Loop
from servoscope.models.lti import solve_scaled
from servoscope.research.paper import metrics
from servoscope.research.paper.conditions import (
    FAULT_AT,
    FREQUENCIES,
    PAPER,
    TRACKING_CASE,
    OperatingConditions,
    default_loop,
    paper_loop,
    rig_loop,
)
from servoscope.research.paper.method import ResidualGenerator, ResidualTrace
from servoscope.simulation import simulate_response

TUNING_SEED_OFFSET = 1000  # added to a seed: the healthy recording that tunes is never one that is judged
FILTERED_METHOD = "akf-filtered"  # the AKF with y_a, filtered by a stage 1 of its own, in phi
METHODS = ("akf", "dfrls", "default", FILTERED_METHOD)


def method_loop(method: str) -> Loop:
    """Return the paper's settings with an estimator, or this project's ("default")."""
    return default_loop() if method == "default" else paper_loop(method.removesuffix("-filtered"))


def tune_generator(method: str, seed: int) -> ResidualGenerator:
    """Return a residual generator that was tuned on another healthy recording."""
    loop = method_loop(method)
    return ResidualGenerator.from_loop(
        loop, PAPER.simulate(loop, seed + TUNING_SEED_OFFSET), filtered_y=method == FILTERED_METHOD
    )


@functools.lru_cache(maxsize=8)
def tracking_traces(method: str, seed: int) -> tuple[ResidualTrace, ResidualTrace]:
    """Return what it says of a healthy recording and of one with the fault of Fig. 6, both started from zero."""
    generator = tune_generator(method, seed)
    loop = method_loop(method)
    return (
        generator.run(PAPER.simulate(loop, seed), from_zero=True),
        generator.run(PAPER.simulate(loop, seed, TRACKING_CASE), from_zero=True),
    )


def ifrf_targets(method: str) -> tuple[ComplexArray, ComplexArray]:
    """Return the nominal iFRF and that of the fault of Fig. 6 at the monitored frequencies, each (3,)."""
    loop = method_loop(method)
    plant = loop.plant.with_ratios({TRACKING_CASE.parameter: TRACKING_CASE.ratio})
    E = Pipeline.of(rig_loop(structure=loop.monitor.structure)).bank.E(FREQUENCIES)
    return E @ nominal_theta(loop), E @ nominal_theta(loop, plant)


def tracking_metrics(seed: int) -> dict[str, float]:
    """Return CVs over the last 10 s, rise times after the fault, and biases, per method."""
    values: dict[str, float] = {}
    for method in METHODS:
        healthy, faulty = tracking_traces(method, seed)
        nominal, target = ifrf_targets(method)
        late, before = healthy.between(50.0, 60.0), faulty.between(25.0, FAULT_AT)
        after = faulty.between(50.0, 60.0)
        values[f"{method}.cv_theta"] = metrics.cv_theta(late.theta)
        for i, f in enumerate(FREQUENCIES):
            values[f"{method}.cv_H.{f:g}"] = metrics.cv_H(late.H[:, i])
            values[f"{method}.bias.{f:g}"] = float(np.abs(late.gamma[:, i].mean()) / np.abs(nominal[i]))
        bias = complex(late.gamma[:, 0].mean())
        values[f"{method}.own_bias_real"] = float(bias.real / nominal[0].real)
        values[f"{method}.own_bias_imag"] = float(bias.imag / nominal[0].imag)
        level = complex(before.H[:, 0].mean())
        for share in (0.5, 0.9):
            # the bias scales with H: measured from the level that it has reached, by the ratio that is true
            values[f"{method}.rise.{share:g}"] = metrics.rise_time(
                faulty.t, faulty.H[:, 0], FAULT_AT, level, level * target[0] / nominal[0], share
            )
        values[f"{method}.before"] = float(np.abs(before.H[:, 0].mean() - nominal[0]) / np.abs(nominal[0]))
        values[f"{method}.after"] = float(np.abs(after.H[:, 0].mean() - target[0]) / np.abs(target[0]))
    return values


def bias_metrics(conditions: OperatingConditions = PAPER) -> dict[str, float]:
    """Return the error of the iFRF without any noise, by least squares over a reference without its first 10 s.

    Regressions of the simulated u and y: Tustin as printed, with (u(k) + u(k-1))/2 for the held input, and the
    state-variable filter, which holds u exactly; and Tustin once more on a loop whose u runs in straight lines between
    the samples, as Tustin takes it ("tustin-straight"). What that removes is due to the hold.
    """
    values: dict[str, float] = {}
    r = conditions.reference_signal()
    restart = np.arange(len(r)) == 0
    straight = Loop.from_dict({**rig_loop(structure="tustin").to_dict(), "hold": "foh"})
    loops = {structure: rig_loop(structure=structure) for structure in ("tustin", "tustin-held", "svf")}
    for name, loop in {**loops, "tustin-straight": straight}.items():
        u, y = simulate_response(loop, r)
        pipeline = Pipeline.of(loop)
        g = pipeline.regression(r, u, y, restart)
        phi, eta = g.phi[1000:], g.eta[1000:]
        E = pipeline.bank.E(FREQUENCIES)
        nominal = E @ nominal_theta(loop)
        error = E @ solve_scaled(phi.T @ phi, phi.T @ eta) - nominal
        for i, f in enumerate(FREQUENCIES):
            values[f"noise_free.{name}.{f:g}"] = float(np.abs(error[i] / nominal[i]))
        values[f"noise_free.{name}.imag"] = float(error[0].imag / nominal[0].imag)
    return values
