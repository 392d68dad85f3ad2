"""Like machines as a prior: how healthy ones differ from each other, and how the recordings of each scatter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.feature_model import shrink
from servoscope.baseline.plant_fit import PRIOR_STD
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import BaselineError
from servoscope.core.messages import Message, message
from servoscope.detection.homogeneity import prediction_factor

MIN_MACHINES = 5  # machines: of fewer, the scatter between them is mostly chance
FLOOR = 0.01  # of the uncertainty of a coefficient: less scatter than that is none
MIN_MEMBER_PROBABILITY = 1e-3  # probability below which a machine is none of the population


@dataclass(frozen=True, eq=False)
class NormalPrior:
    """Where values of a further machine are expected: mean (n,) and covariance (n, n), as k machines tell."""

    names: tuple[str, ...]
    mean: FloatArray
    covariance: FloatArray

    @classmethod
    def from_machines(cls, names: tuple[str, ...], values: FloatArray, covariances: FloatArray) -> Self:
        """Estimate it from the values of k machines (k, n), each with the covariance (n, n) of its own estimate.

        The covariance between machines is that of the values less the mean of their own (DerSimonian and Laird, 1986,
        for vectors), and as wide as that of a further draw (Student's t), with no negative variance in any direction.
        """
        k = len(values)
        size = np.maximum(np.sqrt(np.diagonal(covariances, axis1=1, axis2=2).mean(axis=0)), values.std(axis=0, ddof=1))
        between = (np.cov(values.T, ddof=1).reshape(len(names), -1) - covariances.mean(axis=0)) / np.outer(size, size)
        variances, directions = np.linalg.eigh(between)
        widened = np.maximum(variances, 0.0) * (k - 1.0) / (k - 3.0) * (1.0 + 1.0 / k)
        own = covariances.mean(axis=0) / np.outer(size, size) / k  # of the mean, where machines do not differ
        covariance = (directions * widened) @ directions.T + own
        return cls(names, values.mean(axis=0), covariance * np.outer(size, size))

    def combine(
        self, values: FloatArray, covariance: FloatArray, earlier_std: float | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of values (n,) that a machine's own recordings know with a covariance (n, n).

        `earlier_std`: standard deviation of a prior around zero that they were found with, whose place this one takes.
        """
        own, prior = np.linalg.inv(covariance), np.linalg.inv(self.covariance)
        fresh = own - (np.eye(len(values)) / earlier_std**2 if earlier_std is not None else 0.0)
        C = np.linalg.inv(fresh + prior)
        return C @ (own @ values + prior @ self.mean), C

    def distance(self, values: FloatArray, covariance: FloatArray) -> float:
        """Return the squared Mahalanobis distance of values from the population."""
        off = values - self.mean
        return float(off @ np.linalg.solve(self.covariance + covariance, off))


@dataclass(frozen=True, eq=False)
class Population:
    """Healthy machines of one kind."""

    machines: int
    theta: NormalPrior  # coefficients
    ratios: NormalPrior | None  # logarithms of the plant's parameters relative to the loop file's
    scatter: FloatArray  # covariance of the coefficients between recordings of one machine, shape (n, n)
    degrees: float  # what it is worth for a further machine, in degrees of freedom
    sequential: bool  # whether most machines have a sequential test: recordings that scatter leave none

    @classmethod
    def from_baselines(cls, baselines: Mapping[str, Baseline]) -> Self:
        """Describe a population by the baselines of its machines, by name.

        Raises
        ------
        BaselineError
            If there are fewer than five, or one has other coefficients or another plant than the first.
        """
        if len(baselines) < MIN_MACHINES:
            raise BaselineError(
                f"a population needs the baselines of at least {MIN_MACHINES} like machines, {len(baselines)} given"
            )
        first_name, first = next(iter(baselines.items()))
        for name, other in baselines.items():
            if (other.names, type(other.loop.plant)) != (first.names, type(first.loop.plant)):
                raise BaselineError(
                    f"{name}: its coefficients ({', '.join(other.names)}; plant {other.loop.plant.kind}) are not those "
                    f"of {first_name} ({', '.join(first.names)}; plant {first.loop.plant.kind}): no like machine"
                )
        machines = list(baselines.values())
        scatter, degrees = _common_scatter(machines, len(first.names))
        theta = np.array([baseline.theta for baseline in machines])
        errors = np.array([_estimation_error(baseline, scatter) for baseline in machines])
        return cls(
            len(machines),
            NormalPrior.from_machines(first.names, theta, errors),
            _ratios(machines),
            scatter,
            degrees,
            2 * sum(bool(baseline.thresholds.hypotheses) for baseline in machines) > len(machines),
        )

    def pooled_scatter(self, own: FloatArray, recordings: int) -> FloatArray:
        """Return the covariance between recordings (n, n) of a machine whose own m of them say `own` (n, n).

        Both weigh by their degrees of freedom (Smyth, 2004, eq. 3, for a covariance). With v of them in all, a further
        recording has the covariance v S/(v - n - 1): a multivariate Student's t (Gelman et al., 2013, section 3.6).
        """
        weight, n = max(recordings - 1, 0), len(own)
        total = weight + self.degrees
        if not self.degrees or total <= n + 2.0:
            return np.diag(np.maximum(np.diag(own), 0.0))
        S = (weight * own + self.degrees * self.scatter) / (total - n - 1.0)
        return _without_negative(S, np.sqrt(np.diag(self.scatter)))

    def describe(self, theta: FloatArray, covariance: FloatArray) -> tuple[bool, Message]:
        """Return whether a machine is one of the population, and a note that says so.

        The squared distance of a further draw from k of them is Hotelling's T^2 (Anderson, 2003, section 5.3.5), in
        units of a covariance that `NormalPrior.from_machines` has widened already.
        """
        from scipy import special

        n, k = len(theta), self.machines
        left = max(k - n, 1)
        distance = self.theta.distance(theta, covariance)
        limit = n * (k - 3.0) / left * float(special.fdtri(n, left, 1.0 - MIN_MEMBER_PROBABILITY))
        if distance <= limit:
            return True, message("learning.population", machines=self.machines)
        off = (theta - self.theta.mean) / np.sqrt(np.diag(self.theta.covariance + covariance))
        most = int(np.argmax(np.abs(off)))
        return False, message(
            "learning.no_population",
            machines=self.machines,
            coefficient=self.theta.names[most],
            deviations=abs(float(off[most])),
        )

    def combine_ratios(
        self, names: Sequence[str], x: FloatArray, C: FloatArray
    ) -> tuple[tuple[str, ...], FloatArray, FloatArray] | None:
        """Return names, logarithms and covariance of parameters with the population's; None where it has others."""
        if self.ratios is None or self.ratios.names != tuple(names):
            return None
        return self.ratios.names, *self.ratios.combine(x, C, PRIOR_STD)


def _common_scatter(baselines: Sequence[Baseline], n: int) -> tuple[FloatArray, float]:
    """Return the covariance between recordings that machines have in common, (n, n), and its degrees of freedom.

    These are what is left of all of theirs where machines scatter by different amounts: variances that scatter among
    machines with a coefficient of variation c come from an inverse gamma law of 4 + 2/c^2 degrees (by moments). The
    correlations between coefficients are shrunk towards none (oracle approximating shrinkage).
    """
    known = [baseline for baseline in baselines if baseline.scatter.between]
    if len(known) < MIN_MACHINES:
        return np.zeros((n, n)), 0.0
    degrees = np.array([len(baseline.sources) - 1.0 for baseline in known])
    covariances = np.array([baseline.scatter.between for baseline in known])
    S = np.einsum("k,kij->ij", degrees, covariances) / degrees.sum()
    least = FLOOR * np.mean([np.diag(baseline.covariance_array()) for baseline in known], axis=0)
    variances = np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0)
    seen = np.diag(S) > least
    chance = 2.0 / degrees.mean()
    variation = variances[:, seen].var(axis=0, ddof=1) / variances[:, seen].mean(axis=0) ** 2
    between = max(float(np.median((variation - chance) / (1.0 + chance))) if seen.any() else 0.0, 1e-9)
    size = np.sqrt(np.maximum(np.diag(S), least))
    correlations = shrink(_without_negative(S, size) / np.outer(size, size), int(degrees.sum()))
    return correlations * np.outer(size, size), float(min(4.0 + 2.0 / between, degrees.sum()))


def _without_negative(S: FloatArray, size: FloatArray) -> FloatArray:
    """Return a symmetric matrix without its negative directions, as seen in units of `size` (n,)."""
    units = np.outer(*(np.where(size > 0.0, size, 1.0),) * 2)
    values, directions = np.linalg.eigh(S / units)
    return np.asarray((directions * np.maximum(values, 0.0)) @ directions.T * units)


def _estimation_error(baseline: Baseline, scatter: FloatArray) -> FloatArray:
    """Return the covariance of a baseline's own coefficients: noise, and its recordings' share of the scatter."""
    m, between = len(baseline.sources), baseline.scatter.between
    own = np.maximum(np.diag(np.array(between)), 0.0) if between else np.zeros(len(scatter))
    noise = baseline.covariance_array() - np.diag(own * prediction_factor(m))
    lowest = 1e-3 * np.diag(baseline.covariance_array())  # a scatter that was widened is more than what it adds
    noise[np.diag_indices_from(noise)] = np.maximum(np.diag(noise), lowest)
    return np.asarray(noise + scatter / m)


def _ratios(baselines: Sequence[Baseline]) -> NormalPrior | None:
    names = tuple(baselines[0].healthy.ratios)
    if not names or any(
        tuple(baseline.healthy.ratios) != names or len(baseline.healthy.covariance) != len(names)
        for baseline in baselines
    ):
        return None
    values = np.log([[baseline.healthy.ratios[name] for name in names] for baseline in baselines])
    return NormalPrior.from_machines(names, values, np.array([baseline.healthy.covariance for baseline in baselines]))
