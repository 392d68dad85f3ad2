"""Changes of a simulated axis: found, dated, named and sized, whatever the units, the cuts and the place."""

from __future__ import annotations

import functools
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from accuracy.axis import AXES, LIMIT, RATE, moves, record_course

import servoscope as ss
from servoscope.core.arrays import FloatArray
from servoscope.core.verdict import Verdict
from servoscope.sums.axis import AxisEquations, SumsRunner, response
from servoscope.sums.healthy import Healthy
from servoscope.sums.learning import learn
from servoscope.sums.records import Sums
from servoscope.sums.verdict import judge

DAYS, DAY_S, SECONDS = 5, 40.0, 100.0
HEAVY, RUB = {"mass": 1.25}, {"coulomb": 1.5, "static": 1.5}


@functools.cache
def loop() -> ss.Loop:
    return ss.Loop.from_dict(
        {
            "name": "slide",
            "sample_rate": RATE,
            "input_limits": [-LIMIT, LIMIT],
            "plant": {"kind": "axis", "terms": ["viscous", "coulomb", "offset"]},
            "monitor": {"cutoff": 10.0},
        }
    )


def recorded(seed: int, *course: tuple[float, dict[str, float]], seconds: float = SECONDS) -> ss.Recording:
    """Return a slide with cogging, whose ratios change at times."""
    rng, axis = np.random.default_rng(seed), AXES["cogging"]
    day = replace(axis, coulomb=axis.coulomb * np.exp(0.02 * rng.standard_normal()))

    def changed(ratios: dict[str, float]) -> object:
        return replace(day, **{name: ratio * getattr(day, name) for name, ratio in ratios.items()})

    states = [(0.0, day), *((at, changed(ratios)) for at, ratios in course)]
    return record_course(states, moves(1000 + seed, seconds=seconds), seed)


@functools.cache
def days() -> tuple[ss.Recording, ...]:
    return tuple(recorded(seed, seconds=DAY_S) for seed in range(DAYS))


@functools.cache
def equations() -> AxisEquations:
    return AxisEquations.of_healthy(loop(), days())


@functools.cache
def healthy() -> Healthy:
    return learn(equations(), [equations().sums(day) for day in days()])


@functools.cache
def changed() -> ss.Recording:
    return recorded(20, (30.0, HEAVY), (60.0, HEAVY | RUB), (80.0, {}))


def states(verdict: Verdict) -> list[dict[str, float]]:
    return [
        {cause: ratio for cause, (_, ratio, _) in segment.explanations[0].ratios.items()} if segment.changed else {}
        for segment in verdict.segments
    ]


def test_several_changes_and_the_repair_are_named_dated_and_sized() -> None:
    verdict = judge(healthy(), equations().sums(changed()))
    truth = [{}, {"payload": 1.25}, {"payload": 1.25, "dry_friction": 1.5}, {}]
    assert states(verdict) == [pytest.approx(state, rel=0.03) for state in truth]
    assert verdict.kind == "fault"
    for segment, begin, state in zip(verdict.segments, (0.0, 30.0, 60.0, 80.0), truth, strict=True):
        low, likely, high = segment.begin_s
        assert low <= begin <= high
        assert abs(likely - begin) <= 1.5
        if state:
            assert segment.explanations[0].probability > 0.9


def test_the_response_of_a_stretch_is_that_of_the_changed_axis() -> None:
    segment = judge(healthy(), equations().sums(changed())).segments[2]
    found = response(healthy(), segment, [0.5, 2.0, 5.0])
    s = 2j * np.pi * np.array([0.5, 2.0, 5.0])
    std = np.sqrt(found.covariance[:, [0, 1], [0, 1]])
    off = found.H - (25.0 * s**2 + 80.0 * s)
    assert np.abs(off.real / std[:, 0]).max() < 3.0
    assert np.abs(off.imag / std[:, 1]).max() < 3.0
    assert std.max() < 0.05 * np.abs(found.H).max()


def test_a_healthy_recording_is_healthy_and_its_coefficients_are_told() -> None:
    verdict = judge(healthy(), equations().sums(recorded(21)))
    (segment,) = verdict.segments
    assert verdict.kind == "healthy"
    assert not segment.changed
    assert healthy().theta[:3, 0] + segment.deviation[:3] == pytest.approx([80.0, 20.0, 12.0], rel=0.1)


@pytest.mark.parametrize("begin", [12.0, 50.0, 88.0])
def test_a_change_is_found_wherever_it_is(begin: float) -> None:
    verdict = judge(healthy(), equations().sums(recorded(22, (begin, HEAVY))))
    assert [set(state) for state in states(verdict)] == [set(), {"payload"}]
    assert abs(verdict.segments[1].begin_s[1] - begin) <= 1.5


@pytest.mark.parametrize("after", [1.0, 1.5, 2.0])
def test_a_change_at_the_end_has_no_name_that_its_few_blocks_do_not_show(after: float) -> None:
    sums = equations().sums(recorded(22, (50.0, HEAVY)))
    K = round((50.0 + after) / sums.block_s)
    *healthy_before, last = judge(healthy(), sums.part(0, K)).segments
    assert not any(segment.changed for segment in healthy_before)
    if last.changed:
        assert abs(last.begin_s[1] - 50.0) <= 1.0
        best = last.explanations[0]
        assert best.causes == ("payload",) or best.probability < 0.8


def test_a_recording_that_is_changed_from_its_start_on_is_changed_as_a_whole() -> None:
    verdict = judge(healthy(), equations().sums(recorded(23, (0.0, HEAVY))))
    assert states(verdict) == [{"payload": pytest.approx(1.25, rel=0.03)}]


def test_sums_are_the_same_wherever_a_recording_is_cut() -> None:
    whole = equations().sums(changed())
    rng, runner = np.random.default_rng(0), SumsRunner(equations())
    at = [0, *sorted(rng.integers(0, changed().samples, 7).tolist()), changed().samples]
    parts = [runner.advance(changed()[a:b]) for a, b in pairwise(at) if b > a]
    joined = functools.reduce(Sums.followed_by, parts)
    for one, other in zip(whole, joined, strict=True):
        assert np.array_equal(one, other)


def scaled(recording: ss.Recording, u: float, y: float) -> ss.Recording:
    return replace(recording, r=y * recording.r, u=u * recording.u, y=y * recording.y)


@pytest.mark.parametrize(("u", "y"), [(1e-3, 1e3), (-50.0, -1.0)])
def test_units_and_signs_change_no_verdict(u: float, y: float) -> None:
    known = judge(healthy(), equations().sums(changed()))
    loop_there = loop().model_copy(update={"input_limits": (-abs(u) * LIMIT, abs(u) * LIMIT)})
    there = [scaled(day, u, y) for day in days()]
    moved = AxisEquations.of_healthy(loop_there, there)
    found = judge(learn(moved, [moved.sums(day) for day in there]), moved.sums(scaled(changed(), u, y)))
    assert found.evidence == pytest.approx(known.evidence, rel=1e-3)
    assert [s.begin_s for s in found.segments] == [s.begin_s for s in known.segments]
    assert states(found) == [pytest.approx(state, rel=1e-3) for state in states(known)]


def test_the_order_of_healthy_recordings_does_not_matter() -> None:
    sums = [equations().sums(day) for day in days()]
    turned = learn(equations(), sums[::-1])
    assert turned.theta == pytest.approx(healthy().theta, rel=1e-9)
    assert turned.limit == pytest.approx(healthy().limit, rel=1e-6)


def test_a_stretch_without_motion_adds_nothing() -> None:
    sums = equations().sums(recorded(24))
    rest: FloatArray = np.zeros((60, 10, len(equations().names)))
    begin_s = sums.begin_s[-1] + sums.block_s * np.arange(1.0, 61.0)
    still = Sums.of_rows(rest, rest[..., 0], begin_s, sums.block_s, (1.0,))
    alone, followed = judge(healthy(), sums), judge(healthy(), sums.followed_by(still))
    assert followed.kind == "healthy"
    assert followed.segments[0].deviation == pytest.approx(alone.segments[0].deviation, rel=1e-3)
    assert judge(healthy(), still).kind == "healthy"


def test_hours_find_what_minutes_do() -> None:
    # the sums of an hour out of those of minutes: what is tested is how times are sought among 7 200 blocks
    quiet, changes = equations().sums(recorded(25)), equations().sums(recorded(25, (50.0, HEAVY), (62.0, {})))
    parts = [quiet] * 20 + [changes] + [quiet] * 15
    joined = functools.reduce(Sums.followed_by, parts)
    hour = joined._replace(begin_s=quiet.block_s * np.arange(len(joined.c)))
    verdict = judge(healthy(), hour)
    assert [set(state) for state in states(verdict)] == [set(), {"payload"}, set()]
    assert [s.begin_s[1] for s in verdict.segments[1:]] == pytest.approx([2050.0, 2062.0], abs=1.0)


def test_louder_noise_from_some_time_on_changes_no_coefficient() -> None:
    calm, rng = recorded(26), np.random.default_rng(0)
    noise = np.where(calm.t < 50.0, 0.0, 20.0) * rng.standard_normal(calm.samples)
    assert judge(healthy(), equations().sums(replace(calm, u=calm.u + noise))).kind == "healthy"
