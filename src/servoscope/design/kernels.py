"""The sequential test on drawn noise, compiled: when each of many realisations would alarm."""

from __future__ import annotations

import numpy as np

from servoscope.compiled import kernel
from servoscope.cusum import CLIP
from servoscope.plants import FloatArray


@kernel
def crossings(shift: FloatArray, noise: FloatArray, heard: FloatArray, limits: FloatArray, since: int) -> FloatArray:
    """Return how many updates after `since` the first CUSUM reaches its limit, shape (M,); infinity if none does.

    Parameters
    ----------
    shift
        What the change adds to the whitened residual, shape (K,).
    noise
        Realisations of the residual of a healthy loop, shape (M, K).
    heard
        Shifts that the members listen for, shape (q, K).
    limits
        Shape (q,).
    """
    M, K = noise.shape
    q = len(limits)
    found = np.full(M, np.inf)
    g = np.zeros(q)
    for i in range(M):
        g[:] = 0.0
        for k in range(K):
            e = min(max(noise[i, k] + shift[k], -CLIP), CLIP)
            over = False
            for j in range(q):
                s = heard[j, k]
                g[j] = max(g[j] + s * (e - 0.5 * s), 0.0)
                if g[j] >= limits[j]:
                    over = True
                    g[j] = limits[j]
            if over and k >= since:
                found[i] = k - since + 1.0
                break
    return found
