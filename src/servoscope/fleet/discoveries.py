"""Which assets of a fleet have changed, so that few of those that are named are named in error."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from servoscope.fleet.common_cause import PRIOR, Evidence, Prior, log_fault_evidence

RATE = 0.05  # share of the named assets that is named in error, on average


def discover(evidence: Mapping[str, Evidence], prior: Prior = PRIOR, rate: float = RATE) -> tuple[str, ...]:
    """Return the assets that have changed at a false discovery rate, the surest first.

    The Bayes factor of a fault against none is an e-value: of a healthy asset it is 1 on average. With e-values of N
    assets those k are named whose smallest is at least N/(k rate), for the largest such k. That holds whatever the
    assets have in common: warm days, or one baseline (Wang and Ramdas, 2022, Journal of the Royal Statistical Society
    B, 84(3), proposition 2).
    """
    logs = {asset: log_fault_evidence(one, prior) for asset, one in evidence.items()}
    order = sorted(logs, key=lambda asset: (-logs[asset], asset))
    N = len(order)
    enough = [k for k, asset in enumerate(order, 1) if logs[asset] >= np.log(N / (k * rate))]
    return tuple(order[: max(enough, default=0)])
