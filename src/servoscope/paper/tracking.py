"""Figs. 5, 6 and 8 in numbers: scatter, speed and bias of the paper's method and of this project's default."""

from __future__ import annotations

import functools

import numpy as np

from servoscope.inverse import ComplexArray, nominal_theta
from servoscope.loop import Loop
from servoscope.paper import metrics
from servoscope.paper.conditions import FAULT_AT, FREQUENCIES, PAPER, TRACKED, default_loop, paper_loop, rig
from servoscope.paper.method import Course, ResidualGenerator
from servoscope.pipeline import Pipeline
from servoscope.signatures import solve_scaled
from servoscope.simulation import response

COMMISSIONING = 1000  # added to a seed: the healthy recording that tunes is never one that is judged
FILTERED = "akf-filtered"  # the AKF with y_a, filtered by a stage 1 of its own, in phi
METHODS = ("akf", "dfrls", "default", FILTERED)


def loop_of(method: str) -> Loop:
    """Return the paper's settings with an estimator, or this project's ("default")."""
    return default_loop() if method == "default" else paper_loop(method.removesuffix("-filtered"))


def generator(method: str, seed: int) -> ResidualGenerator:
    """Return a residual generator that was tuned on another healthy recording."""
    loop = loop_of(method)
    return ResidualGenerator.of(loop, PAPER.record(loop, seed + COMMISSIONING), filtered_y=method == FILTERED)


@functools.lru_cache(maxsize=8)
def courses(method: str, seed: int) -> tuple[Course, Course]:
    """Return what it says of a healthy recording and of one with the fault of Fig. 6, both started from zero."""
    made = generator(method, seed)
    loop = loop_of(method)
    return (
        made.run(PAPER.record(loop, seed), from_zero=True),
        made.run(PAPER.record(loop, seed, TRACKED), from_zero=True),
    )


def targets(method: str) -> tuple[ComplexArray, ComplexArray]:
    """Return the nominal iFRF and that of the fault of Fig. 6 at the monitored frequencies, each (3,)."""
    loop = loop_of(method)
    plant = loop.plant.with_ratios({TRACKED.parameter: TRACKED.ratio})
    E = Pipeline.of(rig(structure=loop.monitor.structure)).bank.E(FREQUENCIES)
    return E @ nominal_theta(loop), E @ nominal_theta(loop, plant)


def measure(seed: int) -> dict[str, float]:
    """Return CVs over the last 10 s, rise times after the fault, and biases, per method."""
    found: dict[str, float] = {}
    for method in METHODS:
        healthy, faulty = courses(method, seed)
        nominal, ill = targets(method)
        late, before = healthy.between(50.0, 60.0), faulty.between(25.0, FAULT_AT)
        after = faulty.between(50.0, 60.0)
        found[f"{method}.cv_theta"] = metrics.cv_theta(late.theta)
        for i, f in enumerate(FREQUENCIES):
            found[f"{method}.cv_H.{f:g}"] = metrics.cv_H(late.H[:, i])
            found[f"{method}.bias.{f:g}"] = float(np.abs(late.gamma[:, i].mean()) / np.abs(nominal[i]))
        error = late.gamma[:, 0].mean() / np.abs(nominal[0])
        found[f"{method}.bias_real"], found[f"{method}.bias_imag"] = float(error.real), float(error.imag)
        relative = (late.gamma[:, 0].mean().real / nominal[0].real, late.gamma[:, 0].mean().imag / nominal[0].imag)
        found[f"{method}.own_bias_real"], found[f"{method}.own_bias_imag"] = (float(x) for x in relative)
        level = complex(before.H[:, 0].mean())
        for share in (0.5, 0.9):
            # the bias scales with H: measured from the level that it has reached, by the ratio that is true
            found[f"{method}.rise.{share:g}"] = metrics.rise(
                faulty.t, faulty.H[:, 0], FAULT_AT, level, level * ill[0] / nominal[0], share
            )
        found[f"{method}.before"] = float(np.abs(before.H[:, 0].mean() - nominal[0]) / np.abs(nominal[0]))
        found[f"{method}.after"] = float(np.abs(after.H[:, 0].mean() - ill[0]) / np.abs(ill[0]))
    return found


def bias_causes() -> dict[str, float]:
    """Return the error of the iFRF without any noise, by least squares over the profile without its first 10 s.

    Regressions of the simulated u and y: Tustin as printed, with (u(k) + u(k-1))/2 for the held input, and the
    state-variable filter, which holds u exactly; and Tustin once more on a loop whose u runs in straight lines between
    the samples, as Tustin takes it ("tustin-straight"). What that removes is due to the hold.
    """
    found: dict[str, float] = {}
    restart = np.arange(len(PAPER.r())) == 0
    straight = Loop.from_dict({**rig(structure="tustin").to_dict(), "hold": "foh"})
    loops = {structure: rig(structure=structure) for structure in ("tustin", "tustin-held", "svf")}
    for name, loop in {**loops, "tustin-straight": straight}.items():
        u, y = response(loop, PAPER.r())
        pipeline = Pipeline.of(loop)
        g = pipeline.regression(PAPER.r(), u, y, restart)
        phi, eta = g.phi[1000:], g.eta[1000:]
        E = pipeline.bank.E(FREQUENCIES)
        nominal = E @ nominal_theta(loop)
        error = E @ solve_scaled(phi.T @ phi, phi.T @ eta) - nominal
        for i, f in enumerate(FREQUENCIES):
            found[f"noise_free.{name}.{f:g}"] = float(np.abs(error[i] / nominal[i]))
        found[f"noise_free.{name}.imag"] = float(error[0].imag / nominal[0].imag)
    return found
