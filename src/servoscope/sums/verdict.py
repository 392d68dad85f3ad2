"""A recording against healthy: the best account with changes of its coefficients, compared with the best without."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.verdict import Explanation, JudgeEvidence, Segment, Verdict, decide
from servoscope.sums.evidence import ChangePrior, evidence, posterior, running_sums
from servoscope.sums.explanation import explanations
from servoscope.sums.healthy import CHANGE_COST, Healthy
from servoscope.sums.partition import Stretch, partition
from servoscope.sums.records import Sums

Times = tuple[float, float, float]
"""Lower limit, likeliest value and upper limit of a time [s]."""

CUT_COST = 8.0  # nats that a time of change has to gain
MIN_S = 3.0  # shortest stretch [s]
ROUNDS = 2  # in which stretches and the recording's effect are found in turn
TAIL = 0.025  # of a time, on each side of its interval


class _Account(NamedTuple):
    """Stretches of a recording and its own effect, and the evidence of both."""

    evidence: float
    stretches: tuple[Stretch, ...]


class _Judgement:
    """Running sums of one recording, and the scatter that it may have."""

    def __init__(self, healthy: Healthy, sums: Sums) -> None:
        self.healthy, self.sums = healthy, sums
        self.mean = healthy.mean(sums.x)
        M, w = healthy.information(sums, self.mean)
        self.M, self.w, self.blocks = running_sums(M), running_sums(w), len(w)
        self.scatter = healthy.scatter(sums.x)
        self.prior: ChangePrior = healthy.change_prior(sums.x)
        self.shortest = max(round(MIN_S / sums.block_s), 2)
        self.cut_cost = CUT_COST + healthy.excess

    def of(self, begin: int, end: int) -> tuple[FloatArray, FloatArray]:
        """Return information and score of some blocks."""
        return self.M[end] - self.M[begin], self.w[end] - self.w[begin]

    def of_healthy(self, stretches: tuple[Stretch, ...]) -> tuple[FloatArray, FloatArray]:
        """Return information and score of all stretches that are not changed."""
        M, w = np.zeros_like(self.M[0]), np.zeros_like(self.w[0])
        for part in stretches:
            if not part.changed:
                of_part = self.of(part.inside, part.end)
                M, w = M + of_part[0], w + of_part[1]
        return M, w

    def gain(self, B: FloatArray) -> float:
        """Return the evidence of the recording's effect (p,)."""
        M, w = self.M[-1], self.w[-1]
        return float(w @ B - 0.5 * B @ M @ B) - self.healthy.effect_cost(B, self.scatter)

    def effect(self, M: FloatArray, w: FloatArray) -> FloatArray:
        """Return the likeliest effect of the recording, of information and score of its healthy stretches."""
        return self.healthy.effect(M, w, self.scatter)

    def without_change(self) -> float:
        """Return the evidence of the best account without a change."""
        M, w = self.M[-1], self.w[-1]
        return max(
            self.gain(B) + float(evidence(M, w - M @ B, self.healthy.within))
            for B in (np.zeros(len(w)), self.effect(M, w))
        )

    def with_healthy_cuts(self) -> float:
        """Return the evidence of the best account whose stretches all are healthy, each with its own coefficients."""
        M, w = self.M, self.w
        return max(
            self.gain(B) + partition(M, w - M @ B, self.prior, self.cut_cost, self.shortest, changes=False).evidence
            for B in (np.zeros_like(w[-1]), self.effect(M[-1], w[-1]))
        )

    def with_changes(self) -> _Account:
        """Return the best account with a change; where no time of change pays, the whole recording is changed."""
        whole, begin = self.of(0, self.blocks), self.of(0, max(self.blocks // 4, 1))
        prior = self.prior._replace(inside=self.healthy.within + self.scatter)
        best = _Account(float(prior.evidence(*whole)[1]), (Stretch(0, self.blocks, True),))
        for B in (np.zeros(len(whole[1])), self.effect(*whole), self.effect(*begin)):
            for _ in range(ROUNDS):
                cut = partition(self.M, self.w - self.M @ B, self.prior, self.cut_cost, self.shortest)
                total = self.gain(B) + cut.evidence
                if total > best.evidence and any(part.changed for part in cut.stretches):
                    best = _Account(total, cut.stretches)
                # a recording begins healthy rather than not
                healthy = any(not part.changed for part in cut.stretches)
                first = (cut.stretches[0]._replace(changed=False),)
                B = self.effect(*self.of_healthy(cut.stretches if healthy else first))
        return best

    def states(self, stretches: tuple[Stretch, ...]) -> tuple[Stretch, ...]:
        """Return stretches with those joined that differ by no more than healthy ones of one recording do."""
        B = self.effect(*self.of_healthy(stretches))
        states = list(stretches)
        k = 0
        while k + 1 < len(states):
            before, after = states[k], states[k + 1]
            if before.changed == after.changed and (not after.changed or self._is_one_change(before, after, B)):
                states[k : k + 2] = [Stretch(before.begin, after.end, after.changed)]
                k = max(k - 1, 0)
            else:
                k += 1
        return tuple(states)

    def _is_one_change(self, before: Stretch, after: Stretch, B: FloatArray) -> bool:
        """Return whether two changed stretches are rather one, with the scatter of healthy stretches between them."""
        S, prior, p = self.healthy.within, self.prior, len(B)
        M_all, w_all, joint, apart = np.zeros((p, p)), np.zeros(p), 0.0, -self.cut_cost
        for part in (before, after):
            M, w = self.of(part.inside, part.end)
            w = w - M @ B
            healthy, changed = prior.evidence(M, w)
            joint, apart = joint + float(healthy), apart + float(changed)
            softer = np.linalg.solve(np.eye(p) + M @ S, np.column_stack([M, w]))
            M_all, w_all = M_all + softer[:, :-1], w_all + softer[:, -1]
        none = prior._replace(inside=np.zeros((p, p)))
        return joint + float(none.evidence(M_all, w_all)[1]) >= apart

    def segments(self, stretches: tuple[Stretch, ...]) -> tuple[Segment, ...]:
        """Return what each stretch shows."""
        M, w = self.of_healthy(stretches)
        B, P = posterior(M, w, self.scatter)
        alone = all(part.changed for part in stretches)
        dates = self._dates(stretches, B)
        segments = []
        for part, begin, end in zip(stretches, dates[:-1], dates[1:], strict=True):
            M, w = self.of(part.inside, part.end)
            w, S = w - M @ B, P + self.healthy.within
            moved, covariance = posterior(M, w, S + self.healthy.wide * part.changed)
            causes: tuple[Explanation, ...] = ()
            if part.changed:
                degrees = self.healthy.degrees if alone else np.inf
                causes = explanations(self.healthy, self.mean + B, M, w, S, degrees)
            segments.append(Segment(begin, end, part.changed, B + moved, covariance, causes))
        return tuple(segments)

    def _dates(self, stretches: tuple[Stretch, ...], B: FloatArray) -> list[Times]:
        """Return when each stretch begins, and the end; the interval is by the evidence of times between neighbours."""
        t, block_s = self.sums.begin_s, self.sums.block_s
        begin, end = float(t[0]), float(t[-1]) + block_s
        dates = [(begin, begin, begin)]
        for before, after in pairwise(stretches):
            at = np.arange(before.begin + 1, after.end)
            at = at[np.abs(at - after.begin) <= 4 * self.shortest]
            total = np.zeros(len(at))
            for kind, M, w in (
                (before.changed, self.M[at] - self.M[before.begin], self.w[at] - self.w[before.begin]),
                (after.changed, self.M[after.end] - self.M[at], self.w[after.end] - self.w[at]),
            ):
                total += self.prior.evidence(M, w - M @ B)[int(kind)]
            share = np.cumsum(np.exp(total - total.max()))
            low, high = at[np.searchsorted(share / share[-1], (TAIL, 1.0 - TAIL))]
            low, high = min(low, after.begin), max(high, after.begin)
            dates.append(
                (max(float(t[low]) - block_s, begin), float(t[after.begin]), min(float(t[high]) + block_s, end))
            )
        return [*dates, (end, end, end)]


def judge(healthy: Healthy, sums: Sums) -> Verdict:
    """Return whether a recording is healthy; if not, which coefficients changed, when, by how much, and why."""
    return decide(sums_evidence(healthy, sums), healthy.limit, len(healthy.left_out))


def sums_evidence(healthy: Healthy, sums: Sums) -> JudgeEvidence:
    """Return the evidence of a recording; one above the limit has segments of its changes, another one as a whole."""
    judgement = _Judgement(healthy, sums)
    account = judgement.with_changes()
    # the limit stands for the odds of a change; of those of its time, only the choice among blocks is paid for
    odds = CHANGE_COST + (judgement.cut_cost - float(np.log(judgement.blocks)) if len(account.stretches) > 1 else 0.0)
    nats = account.evidence - judgement.without_change() + odds
    if nats > healthy.limit:
        nats = min(nats, account.evidence - judgement.with_healthy_cuts() + CHANGE_COST)
    stretches = judgement.states(account.stretches) if nats > healthy.limit else (Stretch(0, judgement.blocks, False),)
    return JudgeEvidence("sums", nats, judgement.segments(stretches), len(stretches) > 1)


def detection_s(healthy: Healthy, sums: Sums, segments: Sequence[Segment]) -> float:
    """Return when what had been measured by then was enough for the first change within a recording [s].

    Of a repair, whose beginning is known afterwards, that is the latest time at which it may have come.
    """
    judgement, begins = _Judgement(healthy, sums), [segment.begin_s[1] for segment in segments]
    first, second = segments[:2]
    if not second.changed:
        return second.begin_s[2]
    begin, end = [*np.searchsorted(sums.begin_s, begins[1:3]).tolist(), judgement.blocks][:2]
    B = judgement.effect(*judgement.of(0, begin)) if not first.changed else np.zeros(len(judgement.mean))
    at = np.arange(begin + 1, end + 1)
    M, w = judgement.M[at] - judgement.M[begin], judgement.w[at] - judgement.w[begin]
    kept, changed = judgement.prior.evidence(M, w - M @ B)
    enough = np.flatnonzero(changed - kept - judgement.cut_cost > 0.0)
    return float(sums.begin_s[at[enough[0] if len(enough) else -1] - 1]) + sums.block_s
