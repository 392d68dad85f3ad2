"""Several recordings and operating points: homogeneity, baselines of several points, changes refused or accepted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import one_line, run

import servoscope as ss
from servoscope.core.errors import BaselineError, NotEnoughError
from servoscope.detection.homogeneity import (
    cover_transients,
    describe_outliers,
    find_outliers,
    leave_one_out,
    scatter,
    scatter_of_others,
)
from servoscope.signals import writers
from servoscope.simulation import FaultEvent, reference, simulate

LOOP = ss.Loop.load(Path(__file__).parents[2] / "src/servoscope/simulation/reference-rig.toml")
WARM = 1.3  # times the leakage of the cold oil

Record = Callable[..., ss.Recording]


def record(seed: int, leak: float = 1.0, kind: str = "profile", seconds: float = 40.0, **options: Any) -> ss.Recording:
    loop = LOOP.model_copy(update={"plant": LOOP.plant.with_ratios({"C_ie": leak})})
    made, _ = simulate(loop, reference(kind, seconds, loop.sample_rate), seed=seed, **options)
    return replace(made, name=f"{kind}-{seed}")


def differing(baseline: ss.Baseline) -> list[str]:
    return [text for text in map(str, baseline.notes) if "differ" in text]


@pytest.fixture(scope="module")
def plain() -> ss.Baseline:
    return ss.learn(LOOP, [record(1)])


@pytest.fixture(scope="module")
def points() -> ss.Baseline:
    return ss.learn(LOOP, {"cold": [record(1), record(2, kind="multisine")], "warm": [record(3, WARM)]})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("points")
    (made / "loop.toml").write_bytes(
        (Path(__file__).parents[2] / "src/servoscope/simulation/reference-rig.toml").read_bytes()
    )
    for name, seed, leak in (("a", 11, 1.0), ("b", 12, 1.0), ("leaky", 13, 1.1), ("warm", 14, WARM)):
        writers.write_recording(made / f"{name}.csv", record(seed, leak), LOOP.columns)
    assert run("learn", made / "loop.toml", made / "a.csv", "-o", made / "old.json").code == 0
    return made


def test_the_statistic_is_chi_square_for_one_plant_and_finds_the_odd_one() -> None:
    rng = np.random.default_rng(0)
    shape = np.array([[1.0, 0.9], [0.9, 1.0]]) * np.outer([1.0, 1e6], [1.0, 1e6])  # units differ, as those of theta do
    covariances = shape * np.array([1.0, 2.0, 0.5])[:, None, None]
    L = np.linalg.cholesky(covariances)
    draws = [np.einsum("kab,kb->ka", L, rng.standard_normal((3, 2))) for _ in range(2000)]
    assert sum(bool(find_outliers(x, covariances)) for x in draws) <= 8  # one in a thousand expected
    assert np.mean([scatter(x, covariances).any() for x in draws]) == pytest.approx(0.01, abs=0.007)
    four = np.concatenate([draws[0], draws[1][:1]])
    assert scatter(four, shape * np.full((4, 1, 1), 0.01)).any()  # of four and more it always counts
    moved = draws[0] + np.array([0.0, 0.0, 1.0])[:, None] * np.array([10.0, 0.0])
    (odd,) = find_outliers(moved, covariances)
    assert (odd.recording, odd.coefficient) == (2, 0) and odd.statistic > odd.limit
    assert scatter(moved, covariances)[0, 0] > 10.0
    (sentence,) = map(str, describe_outliers([odd], ["a", "b", "c"], ["theta_0", "theta_1"]))
    assert sentence.startswith("c differs from the other healthy recordings") and "theta_0" in sentence


def test_recordings_of_one_plant_do_not_differ_whatever_their_reference() -> None:
    pairs = [("profile", "profile"), ("profile", "multisine"), ("steps", "trapezoid")]
    for i, (one, other) in enumerate(pairs):
        learned = ss.learn(LOOP, [record(20 + 2 * i, kind=one), record(21 + 2 * i, kind=other)])
        assert not differing(learned), (one, other)


def test_a_healthy_recording_that_differs_is_noticed() -> None:
    same, other = record(30), record(31, kind="multisine")
    (note,) = differing(ss.learn(LOOP, [same, record(32, 1.05)]))
    assert "profile-30 and profile-32 differ" in note and "operating point" in note
    (note,) = differing(ss.learn(LOOP, [same, record(32, 1.05), other]))
    assert "profile-32 differs from the other healthy recordings" in note and "theta_" in note


def test_two_recordings_of_one_plant_promise_no_less_than_one(plain: ss.Baseline) -> None:
    two = ss.learn(LOOP, [record(1), record(33)])
    for few, many in zip(plain.detectability.changes, two.detectability.changes, strict=True):
        assert few.change is not None and many.change is not None and many.change < 1.1 * few.change


def test_one_that_differs_where_the_others_agree_hides_no_fault() -> None:
    """Three recordings of one plant scatter by chance alone: no multiple of that reaches the fourth."""
    n, S = 2, np.eye(2)
    apart = np.array([[0.5, -0.4], [-0.6, 0.3], [0.2, 0.1], [9.0, 0.0]])
    C = np.tile(S, (4, 1, 1))
    paths = [((x - apart.mean(axis=0))[None], S[None]) for x in apart]
    told = scatter_of_others(apart, C, [np.zeros((1, n, n))] * 4)
    factor, ratios = leave_one_out(paths, apart, told, 0.25 * S, limit=20.0)
    assert not told[3].any() and ratios[3] > 1.0 and factor == 1.0
    # the scatter of all four lets such a recording pass
    deviation = (apart - apart.mean(axis=0))[3]
    assert deviation @ np.linalg.solve(1.25 * S + scatter(apart, C), deviation) < 20.0


def test_recordings_that_scatter_have_no_sequential_test_which_takes_the_plant_for_constant(plain: ss.Baseline) -> None:
    """A further recording of that scatter raises no alarm, from the first evaluation on."""
    learned = ss.learn(LOOP, [record(1), record(2, 1.004)])
    assert plain.thresholds.hypotheses and not learned.thresholds.hypotheses
    monitor = ss.Monitor(learned)
    for leak in (0.997, 1.007):
        further = record(34, leak)
        assert not monitor.run(monitor.init(), further.r, further.u, further.y)[1].exceeded.any(), leak


def test_scatter_covers_what_it_does_while_the_start_is_not_forgotten() -> None:
    """By brute force: theta_hat of further machines, which start where the mean of the others is."""
    rng, between = np.random.default_rng(2), np.diag([1.0, 0.01])
    Psi = np.array([np.eye(2), [[0.5, 2.0], [3.0, 0.5]], np.zeros((2, 2))])  # what is left of the start, by evaluation
    off = rng.standard_normal((20_000, 2)) * np.sqrt(np.diag(between))
    spread = np.array([((np.eye(2) - left) @ off.T).var(axis=1) for left in Psi])
    covered = cover_transients(between, [Psi[:2], Psi[2:]])
    assert np.diag(covered) == pytest.approx(spread.max(axis=0), rel=0.05)
    assert covered[1, 1] > 500.0 * between[1, 1]  # what is known badly moves by far more than it scatters
    assert not cover_transients(np.zeros((2, 2)), [Psi]).any()


def test_points_round_trip_through_one_file(points: ss.Baseline, plain: ss.Baseline, tmp_path: Path) -> None:
    points.save(tmp_path / "b.json")
    loaded = ss.Baseline.load(tmp_path / "b.json")
    assert loaded.model_dump_json() == points.model_dump_json()
    assert loaded.points == ("cold", "warm")
    assert loaded.at("warm").points == ("warm",) and not loaded.at("cold").others
    assert [source.name for source in loaded.at("warm").sources] == ["profile-3"]
    with pytest.raises(BaselineError, match="'hot': choose from cold, warm"):
        loaded.at("hot")
    with pytest.raises(BaselineError, match="the baseline has none"):
        plain.at("cold")
    text = (tmp_path / "b.json").read_text().replace('"point": "warm"', '"point": "cold"')
    (tmp_path / "b.json").write_text(text)
    with pytest.raises(BaselineError, match="a name of its own"):
        ss.Baseline.load(tmp_path / "b.json")


def test_learning_says_which_fault_hides_between_two_points(points: ss.Baseline) -> None:
    (note,) = differing(points.at("warm"))
    assert "warm differs from cold as leakage (C_ie x 1.3" in note
    hidden = ss.diagnose(points, record(40, WARM))
    assert (hidden.verdict, hidden.point) == ("healthy", "warm")
    told = ss.diagnose(points, record(40, WARM), point="cold")
    assert [fault.name for fault in told.faults] == ["leakage"]
    twice = ss.learn(LOOP, {"summer": [record(41)], "winter": [record(42)]})
    assert any("may be one operating point" in str(note) for note in twice.at("winter").notes)


def test_a_recording_is_healthy_at_its_own_point(points: ss.Baseline, plain: ss.Baseline) -> None:
    for point, leak, kind in (("cold", 1.0, "profile"), ("warm", WARM, "multisine"), ("cold", 1.0, "trapezoid")):
        said = ss.diagnose(points, record(50, leak, kind))
        assert (said.verdict, said.point) == ("healthy", point)
        assert said.summary.startswith(f"Healthy at {point}: ")
    assert ss.diagnose(plain, record(51)).point is None


@pytest.mark.parametrize(("point", "leak"), [("cold", 1.0), ("warm", WARM)])
@pytest.mark.parametrize(("parameter", "ratio", "at_s"), [("C_ie", 1.15, 20.0), ("p_s", 0.9, 0.0)])
def test_a_fault_is_found_and_sized_at_every_point(
    points: ss.Baseline, point: str, leak: float, parameter: str, ratio: float, at_s: float
) -> None:
    said = ss.diagnose(points, record(60, leak, faults=[FaultEvent(parameter, ratio, at_s)]))
    assert said.point == point
    (fault,) = said.faults
    assert fault.parameter == parameter and fault.ratio == pytest.approx(ratio, rel=0.01)


def test_a_change_that_two_points_explain_is_told_with_both(points: ss.Baseline) -> None:
    said = ss.diagnose(points, record(70, 1.5))
    (warning,) = [w for w in said.warnings if w.kind == "point"]
    assert said.point == "warm" and "Fault at cold: leakage has risen by half" in warning.message


def test_a_monitor_follows_one_point(points: ss.Baseline) -> None:
    with pytest.raises(BaselineError, match=r"has cold, warm: give baseline\.at\('cold'\)"):
        ss.Monitor(points)
    monitor, rec = ss.Monitor(points.at("warm")), record(80, WARM)
    _, trace = monitor.run(monitor.init(), rec.r, rec.u, rec.y)
    assert trace.ready.any() and not np.any(trace.statistic[trace.ready] > trace.threshold)


def test_each_of_many_assets_has_its_share_of_the_budget(points: ss.Baseline) -> None:
    one = points.at("warm")
    shared = one.shared(10)
    assert shared.thresholds.statistic > one.thresholds.statistic
    assert shared.loop.monitor.false_alarms_per_year == pytest.approx(one.loop.monitor.false_alarms_per_year / 10.0)


def test_points_need_names_and_recordings() -> None:
    with pytest.raises(NotEnoughError, match="operating point warm: no recording"):
        ss.learn(LOOP, {"cold": [record(1)], "warm": []})
    with pytest.raises(NotEnoughError, match="no recording to learn from"):
        ss.learn(LOOP, {})
    with pytest.raises(BaselineError, match="needs a name"):
        ss.learn(LOOP, {"": [record(1)]})


def test_the_command_line_learns_points_and_judges_at_one(folder: Path, tmp_path: Path) -> None:
    at = tmp_path / "points.json"
    odd = tmp_path / "x=1.csv"  # a file whose whole name exists is no operating point
    odd.write_bytes((folder / "a.csv").read_bytes())
    made = run("learn", folder / "loop.toml", f"cold={folder / 'a.csv'}", f"warm={folder / 'warm.csv'}", "-o", at)
    assert made.code == 0 and "at cold" in made.out and "at warm" in made.out
    assert run("learn", folder / "loop.toml", odd, "-o", tmp_path / "plain.json").code == 0
    assert ss.Baseline.load(tmp_path / "plain.json").points == ()
    assert "Healthy at warm" in run("diagnose", at, folder / "warm.csv").out
    judged = run("diagnose", at, folder / "warm.csv", "--point", "cold")
    assert judged.code == 3 and "Fault at cold: leakage" in judged.out
    one_line(run("diagnose", at, folder / "a.csv", "--point", "hot"), "'hot'", "cold, warm")
    mixed = run("learn", folder / "loop.toml", folder / "a.csv", f"warm={folder / 'warm.csv'}", "-o", at)
    assert mixed.code == 2 and "operating point" in mixed.err


def test_a_change_is_refused_unless_accepted(folder: Path, tmp_path: Path) -> None:
    new = tmp_path / "new.json"
    compare = ("--compare", folder / "old.json", "-o", new)
    refused = run("learn", folder / "loop.toml", folder / "b.csv", folder / "leaky.csv", *compare)
    one_line(refused, "leaky.csv", "leakage", "--accept-change")
    assert not refused.out and not new.exists()
    assert run("learn", folder / "loop.toml", folder / "b.csv", *compare).code == 0
    assert not any("accepted" in str(note) for note in ss.Baseline.load(new).notes)
    assert run("learn", folder / "loop.toml", folder / "leaky.csv", *compare, "--accept-change").code == 0
    (note,) = [str(note) for note in ss.Baseline.load(new).notes if "accepted as healthy" in str(note)]
    assert (
        "leaky.csv" in note
        and "leakage has risen by a tenth" in note
        and ss.Baseline.load(folder / "old.json").hash in note
    )
    assert run("learn", folder / "loop.toml", folder / "b.csv", "-o", new, "--accept-change").code == 2
