"""Fit the posterior of `servoscope assess` to simulated loops of the training family and to process loops.

python benchmarks assessment/train [--data ../shared/data]
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from assessment.records import Records, measured, servos, simulated
from scipy import optimize, special
from tables import parse_with_data, parser

from servoscope.assessment import posterior
from servoscope.assessment.posterior import CausePosterior, StictionDiscriminant, expand_features

SIMULATED, SEED = 1200, 2
LOOP_WEIGHT = 8.0  # what one measured loop counts, in simulated ones; its logs share it
BACKLASH_WEIGHT = 0.5  # valves stick more often than they have play
SERVO_WEIGHT = 20.0  # the same of all servo recordings in a folder
PENALTY = 5e-4  # on squared weights, per record
DISCRIMINANT_FEATURES = 6  # that tell stiction best in the measured loops, by rank
DISCRIMINANT_SHRINKAGE = 0.3  # of the covariance towards its diagonal: 34 loops were measured

Floats = npt.NDArray[np.float64]


def fit_posterior(
    names: tuple[str, ...],
    features: Floats,
    possible: npt.NDArray[np.bool_],
    weights: Floats,
    discriminant: StictionDiscriminant,
) -> CausePosterior:
    """Fit to records of which the possible causes are known, (N, causes); weights: of each record, (N,).

    A record with several possible causes counts with the sum of their probabilities.
    """
    mean, std = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-9)
    rows = expand_features(features, mean, std)
    shape = rows.shape[1], possible.shape[1]
    excluded = np.where(possible, 0.0, -np.inf)
    scale = PENALTY * weights.sum()

    def objective(flat: Floats) -> tuple[float, Floats]:
        w = flat.reshape(shape)
        logits = rows @ w
        all_causes, known = special.logsumexp(logits, axis=1), special.logsumexp(logits + excluded, axis=1)
        share = np.exp(logits - all_causes[:, None]) - np.exp(logits + excluded - known[:, None])
        gradient = rows.T @ (weights[:, None] * share)
        gradient[:-1] += 2.0 * scale * w[:-1]
        return float(weights @ (all_causes - known) + scale * np.square(w[:-1]).sum()), gradient.ravel()

    found = optimize.minimize(objective, np.zeros(shape).ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 250})
    return CausePosterior(names, mean, std, found.x.reshape(shape), discriminant)


def fit_discriminant(real: Records, left_out: str = "") -> StictionDiscriminant:
    """Fit the discriminant of stiction to means over the logs of each measured loop, without one of them."""
    names = [str(name) for name in np.unique(real.loops) if name != left_out]
    means = np.array([real.features[real.loops == name].mean(axis=0) for name in names])
    sticks = np.array([real.possible[real.loops == name][0, 0] for name in names])
    above = np.sign(means[sticks][:, None, :] - means[~sticks][None]).mean(axis=(0, 1))
    own = [i for i, name in enumerate(real.names) if ":" not in name]  # at the log's own time scale
    best = sorted(own, key=lambda i: -abs(float(above[i])))[:DISCRIMINANT_FEATURES]
    ill, well = means[sticks][:, best], means[~sticks][:, best]
    covariance = np.cov(np.vstack([ill - ill.mean(axis=0), well - well.mean(axis=0)]).T)
    covariance += DISCRIMINANT_SHRINKAGE * np.diag(np.diag(covariance))
    centre = (ill.mean(axis=0) + well.mean(axis=0)) / 2.0
    weights = np.linalg.solve(covariance, ill.mean(axis=0) - well.mean(axis=0))
    return StictionDiscriminant(tuple(real.names[i] for i in best), centre, weights)


def to_json(fitted: CausePosterior) -> str:
    """Return a posterior as JSON; numbers to 6 digits."""
    plain: dict[str, Any] = {"names": fitted.names}
    for name in ("mean", "std", "weights"):
        plain[name] = [float(f"{x:.6g}") for x in getattr(fitted, name).ravel()]
    told = {name: [float(f"{x:.6g}") for x in getattr(fitted.discriminant, name)] for name in ("centre", "weights")}
    plain["discriminant"] = {"names": fitted.discriminant.names, **told}
    return json.dumps(plain) + "\n"


def fit(training: Records, real: Records, servo: Records, left_out: str = "") -> CausePosterior:
    """Fit the posterior to simulated and measured loops, without one of the latter or one folder."""
    features, possible, weights = (
        [training.features],
        [training.possible],
        [np.where(training.possible[:, 1], BACKLASH_WEIGHT, 1.0)],
    )
    for records, weight in ((real, LOOP_WEIGHT), (servo, SERVO_WEIGHT)):
        kept = records.loops != left_out
        names, counts = np.unique(records.loops, return_counts=True)
        share = dict(zip(names.tolist(), (weight / counts).tolist(), strict=True))
        features.append(records.features[kept])
        possible.append(records.possible[kept])
        weights.append(np.array([share[str(loop)] for loop in records.loops[kept]]))
    stacked = np.vstack(features), np.vstack(possible), np.concatenate(weights)
    return fit_posterior(training.names, *stacked, fit_discriminant(real, left_out))


def main() -> None:
    """Fit, and write `posterior.json`."""
    given = parse_with_data(parser(__doc__), "real/process_loops")
    real, servo = measured(given.data / "real" / "process_loops"), servos(given.data / "real")
    target = Path(posterior.__file__).with_name("posterior.json")
    target.write_text(to_json(fit(simulated(SIMULATED, SEED, "training"), real, servo)), encoding="utf-8")
