"""Names and probabilities against the truth: confusion, accuracy, proper scores, calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import FloatArray, IntArray
from servoscope.scoring.intervals import Measured, share


def confusion(truth: Sequence[str], said: Sequence[str], labels: Sequence[str]) -> IntArray:
    """Count what was said (columns) for what was true (rows), shape (L, L).

    Parameters
    ----------
    truth, said
        One label per case.
    labels
        All L labels, in the order of rows and columns.

    Raises
    ------
    ValueError
        If a label of a case is none of `labels`, or there are more cases in one list than in the other.
    """
    counts = np.zeros((len(labels), len(labels)), dtype=np.int64)
    order = list(labels)
    for is_so, says in zip(truth, said, strict=True):
        counts[order.index(is_so), order.index(says)] += 1
    return counts


def accuracy(confused: IntArray) -> Measured:
    """Return the share of right labels of a confusion matrix (L, L), with Wilson's interval."""
    return share(int(np.trace(confused)), int(confused.sum()))


def log_score(probability: FloatArray, truth: IntArray) -> float:
    """Return the mean of -log of the probability that the truth was given [nat]; 0 is perfect (Good, 1952).

    Parameters
    ----------
    probability
        Of the L labels, each row with sum 1, shape (M, L).
    truth
        Index of the true label, shape (M,).
    """
    given = probability[np.arange(truth.size), truth]
    with np.errstate(divide="ignore"):
        return float(-np.log(given).mean())


def brier_score(probability: FloatArray, truth: IntArray) -> float:
    """Return the mean squared distance of the probabilities from the truth (Brier, 1950): 0 perfect, 2 worst.

    Parameters as for `log_score`. It is the sum over all labels; half of it is the two-label form.
    """
    return float(((probability - np.eye(probability.shape[1])[truth]) ** 2).sum(axis=1).mean())


@dataclass(frozen=True, eq=False)
class Reliability:
    """What was claimed and what came true, bin by bin (Murphy and Winkler, 1977).

    Parameters
    ----------
    claimed
        Mean probability in each of the B bins, shape (B,); NaN in an empty one.
    observed
        Share that was right, shape (B,); NaN in an empty bin.
    count
        Cases per bin, shape (B,).
    """

    claimed: FloatArray
    observed: FloatArray
    count: IntArray

    @property
    def calibration_error(self) -> float:
        """Expected calibration error: mean of abs(claimed - observed) over all cases (Naeini and others, 2015)."""
        used = self.count > 0
        return float(np.average(np.abs(self.claimed - self.observed)[used], weights=self.count[used]))


def reliability(probability: FloatArray, right: npt.ArrayLike, bins: int = 10) -> Reliability:
    """Sort claims into bins of equal width and compare them with what came true.

    Parameters
    ----------
    probability
        What was claimed, 0 to 1, shape (M,); usually of the best candidate.
    right
        Whether it was so, shape (M,).
    bins
        Number B of bins; a probability on an edge belongs to the upper one, 1 to the last.
    """
    p, hit = np.asarray(probability, dtype=np.float64), np.asarray(right, dtype=np.float64)
    which = np.minimum((p * bins).astype(np.int64), bins - 1)
    count = np.bincount(which, minlength=bins)
    with np.errstate(invalid="ignore"):
        claimed = np.bincount(which, p, bins) / count
        observed = np.bincount(which, hit, bins) / count
    return Reliability(claimed, observed, count)
