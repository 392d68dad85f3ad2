"""The posterior over the verdicts: multinomial logistic regression on the features of a log.

Simulated loops, of which most of it was learned, stick otherwise than measured ones. Of a process loop, stiction is
therefore weighed by what tells it in measured process loops: Fisher's linear discriminant (Fisher, 1936, eq. 4).
"""

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
MAX_PROCESS_RATE_HZ = 1.0  # sample rate up to which a log is of a process loop
MAX_DISCRIMINANT_LOG_ODDS = 3.0  # few loops were measured
MAX_SIMULATED_LOG_ODDS = 1.0  # of stiction, beside the discriminant


@dataclass(frozen=True)
class StictionDiscriminant:
    """Log odds of stiction in a process loop, at equal odds before: w'(x - c)."""

    names: tuple[str, ...]
    centre: FloatArray  # c, (D,)
    weights: FloatArray  # w, (D,)


@dataclass(frozen=True)
class CausePosterior:
    """P(cause | x) is softmax(W z + b), z: features relative to mean and standard deviation, clipped."""

    names: tuple[str, ...]
    mean: FloatArray  # (F,)
    std: FloatArray  # (F,)
    weights: FloatArray  # (F + 1, causes); the last row is b
    discriminant: StictionDiscriminant

    def probabilities(self, features: FloatArray, *, process: bool = False) -> FloatArray:
        """Return the probability of each cause, shape (N, causes), for features of shape (N, F).

        `process`: whether the logs are of process loops.
        """
        logits = expand_features(features, self.mean, self.std) @ self.weights
        if process:
            others, d = special.logsumexp(logits[:, 1:], axis=1), self.discriminant  # stiction is the first cause
            told = (features[:, [self.names.index(name) for name in d.names]] - d.centre) @ d.weights
            simulated = np.clip(logits[:, 0] - others, -MAX_SIMULATED_LOG_ODDS, MAX_SIMULATED_LOG_ODDS)
            logits[:, 0] = others + simulated + np.clip(told, -MAX_DISCRIMINANT_LOG_ODDS, MAX_DISCRIMINANT_LOG_ODDS)
        return np.asarray(special.softmax(logits, axis=1))

    def of(self, features: Mapping[str, float], sample_rate: float) -> dict[Cause, float]:
        """Return the probability of each cause for one log with a sample rate [Hz]."""
        row = np.array([[features[name] for name in self.names]])
        posterior = self.probabilities(row, process=sample_rate <= MAX_PROCESS_RATE_HZ)
        return dict(zip(CAUSES, posterior[0].tolist(), strict=True))


def expand_features(features: FloatArray, mean: FloatArray, std: FloatArray) -> FloatArray:
    """Return clipped relative features (N, F) and a column of ones, shape (N, F + 1)."""
    z = np.clip((features - mean) / std, -LIMIT, LIMIT)
    return np.hstack([z, np.ones((len(z), 1))])


@cache
def load_posterior() -> CausePosterior:
    """Return the posterior that comes with servoscope; `benchmarks/assessment/train.py` writes it."""
    plain = json.loads(files("servoscope.assessment").joinpath("posterior.json").read_text(encoding="utf-8"))
    mean, std, weights = (np.array(plain[name]) for name in ("mean", "std", "weights"))
    told = plain["discriminant"]
    discriminant = StictionDiscriminant(tuple(told["names"]), np.array(told["centre"]), np.array(told["weights"]))
    return CausePosterior(tuple(plain["names"]), mean, std, weights.reshape(-1, len(CAUSES)), discriminant)
