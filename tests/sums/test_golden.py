"""Numbers of recordings without random numbers, computed by an independent program."""

from __future__ import annotations

import numpy as np
import pytest

from servoscope.core.arrays import FloatArray
from servoscope.sums.evidence import directional_evidence, evidence, posterior
from servoscope.sums.learning import learn
from servoscope.sums.records import FaultDirection, Sums
from servoscope.sums.scatter import block_weights
from servoscope.sums.verdict import judge

M, w, S = np.array([[4.0, 1.0], [1.0, 3.0]]), np.array([2.0, -1.0]), np.diag([0.25, 0.5])
RATE, ROWS, BLOCKS = 100.0, 50, 40


class Friction:
    """Viscous and Coulomb friction, and a constant force."""

    names = ("viscous", "coulomb", "offset")
    free = (2,)

    def causes(self, theta: FloatArray) -> tuple[FaultDirection, ...]:
        single = tuple(FaultDirection(name, theta * row) for name, row in zip(self.names[:2], np.eye(3), strict=False))
        return (*single, FaultDirection("gain", theta.copy(), multiplies_all=True))


def recording(day: int, change: int = BLOCKS) -> Sums:
    """Return the sums of 20 s; from a block on, Coulomb friction is 1.3 times its value."""
    t = (np.arange(ROWS * BLOCKS) + 137 * day) / RATE
    v, s = np.sin(1.3 * t) + 0.5 * np.sin(3.1 * t + 1.0), np.sign(np.sin(0.9 * t + 0.3))
    phi = np.column_stack([v, s, np.ones_like(v)])
    scale = 1.0 + 0.01 * np.cos(2.1 * day)
    coulomb = np.where(np.arange(len(t)) // ROWS >= change, 1.3, 1.0) / scale
    noise = 0.05 * np.sin(37.0 * t + day) + 0.03 * np.cos(11.0 * t * (1.0 + 0.1 * np.sin(t)))
    eta = 2.0 * scale * v + coulomb * s + 0.2 + noise
    phi, eta = phi.reshape(BLOCKS, ROWS, 3), eta.reshape(BLOCKS, ROWS)
    return Sums.of_rows(phi, eta, 0.5 * np.arange(BLOCKS), 0.5, (1.0,))


def test_evidence() -> None:
    assert evidence(M, w, S) == pytest.approx(-0.38180364196849503, abs=1e-12)
    assert evidence(0.0 * M, 0.0 * w, S) == 0.0
    plain, single = directional_evidence(M, w, S, 0.5 * np.eye(2))
    assert plain == pytest.approx(-0.38180364196849503, abs=1e-12)
    assert single == pytest.approx([-0.47325936, -0.48562233], abs=1e-8)


def test_posterior() -> None:
    mean, P = posterior(M, w, S)
    assert mean == pytest.approx([0.28205128205128205, -0.2564102564102564], abs=1e-12)
    assert P.ravel() == pytest.approx([0.1282051282, -0.0256410256, -0.0256410256, 0.2051282051], abs=1e-9)


def test_a_block_that_agrees_with_no_neighbour_hardly_counts() -> None:
    """Of a change every block counts in full, wherever it comes; of one alone, as Student's t says."""
    blocks, unit = np.array([M] * 12), np.eye(2)
    step = np.array([[0.0, 0.0]] * 5 + [[3.0, -3.0]] * 7)
    assert block_weights(blocks, np.einsum("kij,kj->ki", blocks, step), 100.0 * unit, 4).min() > 0.99
    alone = np.einsum("kij,kj->ki", blocks, step * (np.arange(12) == 7)[:, None])
    counts = block_weights(blocks, alone, 100.0 * unit, 4)
    square = 0.8 * step[7] @ M @ step[7]  # four neighbours share the error with one block
    assert counts[7] == pytest.approx((4.0 + 2.0) / (4.0 + square), rel=0.01)
    assert block_weights(0.0 * blocks, 0.0 * alone, unit, 4) == pytest.approx(1.0)


def test_learned_and_judged() -> None:
    healthy = learn(Friction(), [recording(day) for day in range(5)])
    # the program has an effect of each block, in place of blocks of Student's t
    assert healthy.theta[:, 0] == pytest.approx([2.002846035572909, 0.9990284793376678, 0.20006171924929186], rel=3e-3)
    assert healthy.limit == pytest.approx(4.605170185988092)
    assert judge(healthy, recording(7)).evidence == pytest.approx(-6.764174509379325, rel=0.03)
    changed = judge(healthy, recording(8, 22))
    # the program's 3391.57 are against one healthy stretch; here several are allowed, which may change for two blocks
    assert changed.evidence == pytest.approx(61.8, rel=0.01)
    assert [(s.begin_s[1], s.end_s[1], s.changed) for s in changed.segments] == [(0.0, 11.0, False), (11.0, 20.0, True)]
    segment, explanation = changed.segments[1], changed.segments[1].explanations[0]
    low, likely, high = explanation.ratios["coulomb"]
    assert explanation.causes == ("coulomb",)
    assert likely == pytest.approx(1.3, abs=2e-3)  # to what this recording was before
    # the program's ratio is to the mean of recordings
    coulomb = healthy.theta[1, 0]
    before = (coulomb + segment.deviation[1]) / likely
    told = [1.0 + (x - 1.0) * before / coulomb for x in (likely, low, high)]
    assert told == pytest.approx([1.30305, 1.29273, 1.31338], abs=1e-3)
