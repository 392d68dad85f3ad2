"""The posterior over the verdicts: multinomial logistic regression on the features of a log."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from scipy import special

from servoscope.assessment.causes import CAUSES, Cause
from servoscope.core.arrays import FloatArray

LIMIT = 3.0  # standard deviations at which a feature is clipped


@dataclass(frozen=True)
class CausePosterior:
    """P(cause | x) is softmax(W z + b), z: features relative to mean and standard deviation, clipped."""

    names: tuple[str, ...]
    mean: FloatArray  # (F,)
    std: FloatArray  # (F,)
    weights: FloatArray  # (F + 1, causes); the last row is b

    def probabilities(self, features: FloatArray) -> FloatArray:
        """Return the probability of each cause, shape (N, causes), for features of shape (N, F)."""
        logits = expand_features(features, self.mean, self.std) @ self.weights
        return np.asarray(special.softmax(logits, axis=1))

    def of(self, features: Mapping[str, float]) -> dict[Cause, float]:
        """Return the probability of each cause for one log."""
        row = np.array([[features[name] for name in self.names]])
        return dict(zip(CAUSES, self.probabilities(row)[0].tolist(), strict=True))


def expand_features(features: FloatArray, mean: FloatArray, std: FloatArray) -> FloatArray:
    """Return clipped relative features (N, F) and a column of ones, shape (N, F + 1)."""
    z = np.clip((features - mean) / std, -LIMIT, LIMIT)
    return np.hstack([z, np.ones((len(z), 1))])


@cache
def load_posterior() -> CausePosterior:
    """Return the posterior that comes with servoscope; `benchmarks/assessment/train.py` writes it."""
    plain = json.loads(files("servoscope.assessment").joinpath("posterior.json").read_text(encoding="utf-8"))
    mean, std, weights = (np.array(plain[name]) for name in ("mean", "std", "weights"))
    return CausePosterior(tuple(plain["names"]), mean, std, weights.reshape(-1, len(CAUSES)))
