"""The posterior over the verdicts: multinomial logistic regression on the features of a log."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Literal, get_args

import numpy as np
from scipy import optimize, special

from servoscope.core.arrays import BoolArray, FloatArray

Cause = Literal[
    "stiction",
    "backlash",
    "too tight",
    "too sluggish",
    "oscillation from outside",
    "saturation",
    "quantisation",
    "frozen sensor",
    "manual",
    "good",
]
CAUSES: tuple[Cause, ...] = get_args(Cause)
LIMIT = 3.0  # standard deviations at which a feature is clipped
PENALTY = 1.5e-3  # on squared weights, per record


@dataclass(frozen=True)
class CausePosterior:
    """P(cause | x) is softmax(W z + b), z: features relative to mean and standard deviation, clipped."""

    names: tuple[str, ...]
    mean: FloatArray  # (F,)
    std: FloatArray  # (F,)
    weights: FloatArray  # (F + 1, causes); the last row is b

    def probabilities(self, features: FloatArray) -> FloatArray:
        """Return the probability of each cause, shape (N, causes), for features of shape (N, F)."""
        logits = _expand(features, self.mean, self.std) @ self.weights
        return np.asarray(special.softmax(logits, axis=1))

    def of(self, features: Mapping[str, float]) -> dict[Cause, float]:
        """Return the probability of each cause for one log."""
        row = np.array([[features[name] for name in self.names]])
        return dict(zip(CAUSES, self.probabilities(row)[0].tolist(), strict=True))

    @classmethod
    def fit(
        cls, names: tuple[str, ...], features: FloatArray, possible: BoolArray, weights: FloatArray, penalty: float
    ) -> CausePosterior:
        """Fit to records of which the possible causes are known, (N, causes); weights: of each record, (N,).

        A record with several possible causes counts with the sum of their probabilities.
        """
        mean, std = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-9)
        rows = _expand(features, mean, std)
        shape = rows.shape[1], possible.shape[1]
        excluded = np.where(possible, 0.0, -np.inf)
        scale = penalty * weights.sum()

        def objective(flat: FloatArray) -> tuple[float, FloatArray]:
            w = flat.reshape(shape)
            logits = rows @ w
            all_causes, known = special.logsumexp(logits, axis=1), special.logsumexp(logits + excluded, axis=1)
            share = np.exp(logits - all_causes[:, None]) - np.exp(logits + excluded - known[:, None])
            gradient = rows.T @ (weights[:, None] * share)
            gradient[:-1] += 2.0 * scale * w[:-1]
            return float(weights @ (all_causes - known) + scale * np.square(w[:-1]).sum()), gradient.ravel()

        found = optimize.minimize(
            objective, np.zeros(shape).ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 250}
        )
        return cls(names, mean, std, found.x.reshape(shape))

    def to_json(self) -> str:
        """Return the posterior as JSON; numbers to 6 digits."""
        plain = {
            "names": self.names,
            **{
                name: [float(f"{x:.6g}") for x in values.ravel()]
                for name, values in (("mean", self.mean), ("std", self.std), ("weights", self.weights))
            },
        }
        return json.dumps(plain) + "\n"


def _expand(features: FloatArray, mean: FloatArray, std: FloatArray) -> FloatArray:
    z = np.clip((features - mean) / std, -LIMIT, LIMIT)
    return np.hstack([z, np.ones((len(z), 1))])


@cache
def load_posterior() -> CausePosterior:
    """Return the posterior that comes with servoscope; `benchmarks/assessment/train.py` writes it."""
    plain = json.loads(files("servoscope.assessment").joinpath("posterior.json").read_text(encoding="utf-8"))
    mean, std, weights = (np.array(plain[name]) for name in ("mean", "std", "weights"))
    return CausePosterior(tuple(plain["names"]), mean, std, weights.reshape(-1, len(CAUSES)))
