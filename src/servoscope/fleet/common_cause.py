"""Common causes against individual faults: one change that a group shares, or changes of its members, with odds.

Each member a of a group has evidence on the sizes of its faults, score y_a and information J_a (`Evidence`): a
change s of the logarithm of parameter f is exp(s y_af - s^2 J_aff / 2) times as likely as none. Two hypotheses:

    common            one f and one s ~ N(0, tau^2) for all; the size of a member is N(s, (kappa s)^2); besides that
                      each has a fault of its own with probability pi, of any f and s ~ N(0, tau^2)
    each for itself   the same with s ~ N(0, delta^2) and delta small: baselines that were learned together err
                      together, and a warm day moves all; a change as small as that is no cause

Their marginal likelihoods are integrals over one s, done by quadrature: no optimum, no asymptotics. A group whose
common cause is accepted is explained; its members do not count for another group, such as the site they belong to.
Hierarchical mixtures of this kind: Gelman et al., 2013, Bayesian Data Analysis, chapters 5 and 22.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.plant_fit import fault_directions
from servoscope.core.arrays import FloatArray
from servoscope.detection.statistic import whiten
from servoscope.detection.trace import Trace

ACCEPTANCE_PROBABILITY = 0.95  # probability from which a common cause is named and its members are explained
MIN_MEMBERS = 3  # members of a group: two may coincide
HALF = np.geomspace(1e-5, 2.5, 700)
SIZES = np.concatenate([-HALF[::-1], [0.0], HALF])  # of logarithms of ratios, for quadrature


@dataclass(frozen=True)
class Prior:
    """What is assumed of faults in advance.

    Parameters
    ----------
    fault
        pi: probability that an asset has a fault of its own on a day.
    common
        Probability that a group has a common cause on a day.
    size
        tau: standard deviation of the logarithm of a parameter's ratio under a fault.
    scatter
        kappa: relative scatter of a common change among members.
    drift
        delta: standard deviation of the logarithm of a ratio that members share without a cause.
    """

    fault: float = 0.02
    common: float = 0.01
    size: float = 0.3
    scatter: float = 0.15
    drift: float = 0.01


PRIOR = Prior()


@dataclass(frozen=True)
class Cause:
    """A group's common cause.

    Parameters
    ----------
    key, group
        Which group, such as ``supply`` and ``S2``.
    members
        Assets that the evidence is from.
    own
        Of each, the probability of a fault of its own besides, if there is the common cause.
    probability
        That there is a common cause.
    parameter
        The most probable one.
    parameter_probability
        Its probability, given that there is a common cause.
    ratio, interval
        Its ratio to the healthy value, median and 95 % interval.
    """

    key: str
    group: str
    members: tuple[str, ...]
    own: tuple[float, ...]
    probability: float
    parameter: str
    parameter_probability: float
    ratio: float
    interval: tuple[float, float]


def fault_probability(evidence: Evidence, prior: Prior = PRIOR) -> float:
    """Return the probability that an asset has a fault, without regard to its groups."""
    with_fault = np.log(prior.fault) + log_fault_evidence(evidence, prior)
    return float(1.0 / (1.0 + np.exp(min(np.log1p(-prior.fault) - with_fault, 700.0))))


def log_fault_evidence(evidence: Evidence, prior: Prior = PRIOR) -> float:
    """Return the logarithm of how much likelier the evidence is under a fault of any parameter than under none."""
    return float(_log_mean(_log_bayes_factor(*_evidence_arrays(evidence), prior.size)))


def causes(
    evidence: Mapping[str, Evidence], groups: Mapping[str, Mapping[str, str]], prior: Prior = PRIOR
) -> list[Cause]:
    """Return the probability of a common cause for each group of at least three members, the most probable first.

    Parameters
    ----------
    evidence
        Of each asset, on one day.
    groups
        By asset: key -> group.
    prior
        What is assumed in advance.
    """
    members: dict[tuple[str, str], list[str]] = {}
    for asset in sorted(evidence):
        for pair in sorted(groups.get(asset, {}).items()):
            members.setdefault(pair, []).append(asset)
    left = {pair: assets for pair, assets in members.items() if len(assets) >= MIN_MEMBERS}
    accepted: list[Cause] = []
    explained: set[str] = set()
    while left:
        evaluated = []
        for (key, group), assets in left.items():
            free = [asset for asset in assets if asset not in explained]
            if len(free) >= MIN_MEMBERS:
                evaluated.append(_evaluate_group(key, group, free, [evidence[asset] for asset in free], prior))
        if not evaluated:
            break
        best = max(evaluated, key=lambda pair: pair[0])[1]
        if best.probability < ACCEPTANCE_PROBABILITY:
            return accepted + sorted((cause for _, cause in evaluated), key=lambda cause: -cause.probability)
        accepted.append(best)
        explained.update(best.members)
        del left[best.key, best.group]
    return accepted


def _evaluate_group(
    key: str, group: str, assets: list[str], evidence: list[Evidence], prior: Prior
) -> tuple[float, Cause]:
    """Return the logarithm of the odds of a common cause, and the cause."""
    names = evidence[0].names
    alike = [i for i, member in enumerate(evidence) if member.names == names]
    if not names:
        return -np.inf, Cause(key, group, tuple(assets), (0.0,) * len(assets), 0.0, "", 0.0, 1.0, (1.0, 1.0))
    arrays = [_evidence_arrays(evidence[i]) for i in alike]
    likelihoods = [_member_log_likelihoods(*array, prior) for array in arrays]
    # log-likelihood of (f, s), shape (m, sizes)
    together = np.sum([np.logaddexp(*both) for both in likelihoods], axis=0)
    posterior = together + _log_prior(prior.size)
    by_parameter = _log_sum(posterior)
    evident, apart = _log_sum(by_parameter), _log_sum(_log_sum(together + _log_prior(prior.drift)))
    odds = np.log(prior.common) - np.log1p(-prior.common) + evident - apart
    best = int(np.argmax(by_parameter))
    share = np.cumsum(np.exp(posterior[best] - by_parameter[best]))
    low, median, high = (float(np.exp(np.interp(q, share, SIZES))) for q in (0.025, 0.5, 0.975))
    weight = np.exp(posterior - evident)
    own = [float((weight * np.exp(besides - np.logaddexp(shared, besides))).sum()) for shared, besides in likelihoods]
    return float(odds), Cause(
        key=key,
        group=group,
        members=tuple(assets[i] for i in alike),
        own=tuple(own),
        probability=float(1.0 / (1.0 + np.exp(min(-odds, 700.0)))),
        parameter=names[best],
        parameter_probability=float(np.exp(by_parameter[best] - evident)),
        ratio=median,
        interval=(low, high),
    )


def _log_bayes_factor(score: FloatArray, information: FloatArray, size: float) -> FloatArray:
    """Return the log Bayes factor of an individual fault against none, by parameter; score (..., m)."""
    J = np.diagonal(information)
    return np.asarray(-0.5 * np.log1p(size**2 * J) + 0.5 * score**2 * size**2 / (1.0 + size**2 * J))


def _log_prior(size: float) -> FloatArray:
    """Return the log probability of each point of the quadrature under N(0, size^2)."""
    log = np.log(np.gradient(SIZES)) - 0.5 * (SIZES / size) ** 2
    return np.asarray(log - _log_sum(log))


def _member_log_likelihoods(score: FloatArray, information: FloatArray, prior: Prior) -> tuple[FloatArray, FloatArray]:
    """Return log-likelihoods of a member under a common change s of parameter f, without and with its own fault.

    Shape (m, sizes) each, with the prior probabilities of the two in them.
    """
    J, spread = np.diagonal(information)[:, None], (prior.scatter * SIZES) ** 2
    shared = SIZES * score[:, None] - 0.5 * SIZES**2 * J
    remainder = score[:, None] - SIZES * J
    shared = shared - 0.5 * np.log1p(spread * J) + 0.5 * remainder**2 * spread / (1.0 + spread * J)
    # a fault of its own besides: what the common change leaves of the score, shape (m, sizes, m)
    left = score - SIZES[None, :, None] * information[:, None, :]
    besides = SIZES * score[:, None] - 0.5 * SIZES**2 * J + np.log(prior.fault)
    besides = besides + _log_mean(_log_bayes_factor(left, information, prior.size))
    return np.log1p(-prior.fault) + shared, besides


def _evidence_arrays(evidence: Evidence) -> tuple[FloatArray, FloatArray]:
    m = len(evidence.names)
    return np.array(evidence.score), np.array(evidence.information).reshape(m, m)


def _log_sum(x: FloatArray) -> FloatArray:
    top = x.max(axis=-1)
    return np.asarray(top + np.log(np.exp(x - top[..., None]).sum(axis=-1)))


def _log_mean(x: FloatArray) -> FloatArray:
    return _log_sum(x) - np.log(max(x.shape[-1], 1)) if x.shape[-1] else np.full(x.shape[:-1], -np.inf)


@dataclass(frozen=True)
class Evidence:
    """The log-likelihood of small changes s of the logarithms of m parameters: s' score - s' information s / 2.

    With d the deviation of theta from what a healthy loop would show, C its covariance and V the directions
    d theta / d s, the score is V' C^-1 d and the information V' C^-1 V: sufficient for s, whatever it is compared with.

    Parameters
    ----------
    names
        Of the parameters.
    score
        Shape (m,).
    information
        Shape (m, m).
    """

    names: tuple[str, ...]
    score: tuple[float, ...]
    information: tuple[tuple[float, ...], ...]


def trace_evidence(baseline: Baseline, trace: Trace) -> Evidence:
    """Return the evidence at the end of a trace; all zero where there was no estimate yet."""
    directions = fault_directions(baseline.loop, baseline.plant, np.array(baseline.theta))
    names = tuple(
        dict.fromkeys(fault.parameter for fault in baseline.loop.plant.faults if fault.parameter in directions)
    )
    m = len(names)
    if not len(trace.t) or not trace.ready[-1] or not m:
        return Evidence(names, (0.0,) * m, ((0.0,) * m,) * m)
    V = np.array([directions[name] for name in names]).T
    covariance = trace.covariance[-1] + baseline.covariance_array()
    columns = np.column_stack([V, trace.theta[-1] - trace.expected[-1]])
    white = whiten(covariance[None], columns[None])[0]
    score, information = white[:, :m].T @ white[:, m], white[:, :m].T @ white[:, :m]
    return Evidence(names, tuple(score.tolist()), tuple(tuple(row) for row in information.tolist()))
