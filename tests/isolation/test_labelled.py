"""Faults learned from labelled recordings: directions, shares, rivals, "unknown", refusals, files, a real machine."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import one_line, run

import servoscope as ss
from servoscope.baseline.baseline import VERSION
from servoscope.baseline.learned_fault import LearnedFault
from servoscope.core.errors import BaselineError, NotEnoughError
from servoscope.diagnosis.learn_faults import fit_learned_fault
from servoscope.isolation.candidate import UNKNOWN, Candidate
from servoscope.isolation.isolate import isolate, misfit_limit
from servoscope.isolation.signature import coefficient_signature
from servoscope.isolation.signatures import learned_signature
from servoscope.models.plants import Fault
from servoscope.signals import writers
from servoscope.simulation import FaultEvent, reference, simulate

PROJECT = Path(__file__).parents[2]
RIG = PROJECT / "src/servoscope/simulation/reference-rig.toml"
LOOP = ss.Loop.load(RIG)
UNITS = np.array([1.0, 1e3, 1e-6, 1e-2])  # units differ, as those of theta do
HEALTHY = np.diag((0.01 * UNITS) ** 2)
NOISE = np.diag((0.05 * UNITS) ** 2)
WEAR, CRACK = UNITS * [1.0, 2.0, 0.0, -1.0], UNITS * [1.0, -1.0, 2.0, 0.0]


def taught(direction: np.ndarray[Any, Any], severities: list[float], seed: int, name: str = "wear") -> LearnedFault:
    """Learn from recordings of some severities with the noise of `NOISE` and the healthy scatter."""
    m = len(severities)
    noise = np.random.default_rng(seed).standard_normal((m, 4)) * np.sqrt(np.diag(NOISE + HEALTHY))
    d = np.outer(severities, direction) + noise
    return fit_learned_fault(name, [f"{name}-{j}" for j in range(m)], d, np.tile(NOISE, (m, 1, 1)), HEALTHY)


def compared(*faults: LearnedFault, deviation: np.ndarray[Any, Any], seed: int = 0) -> dict[str, Candidate]:
    """Isolate a deviation with fresh noise among learned faults and two coefficients; best first."""
    noisy = deviation + np.random.default_rng(1000 + seed).standard_normal(4) * np.sqrt(np.diag(NOISE + HEALTHY))
    coefficients = [
        coefficient_signature(Fault(f"theta_{i}", f"theta_{i}", (0.1, 10.0), ""), e)
        for i, e in enumerate(np.diag(UNITS))
    ]
    rays = [learned_signature(fault, np.eye(4)) for fault in faults]
    return {c.name: c for c in isolate(coefficients[:2] + rays, noisy, NOISE + HEALTHY)}


class TestDirection:
    def test_recordings_of_different_severity_teach_one_direction(self) -> None:
        found = taught(WEAR, [0.5, 1.0, 1.5, 3.0], seed=1)
        assert np.mean(found.shares) == pytest.approx(1.0)
        assert np.array(found.shares) == pytest.approx(np.array([0.5, 1.0, 1.5, 3.0]) / 1.5, abs=0.08)
        assert np.array(found.deviation) / UNITS == pytest.approx(1.5 * WEAR / UNITS, abs=0.1)
        # severities are no scatter: beside the direction there is noise alone
        assert np.sqrt(np.diag(found.covariance)) / UNITS == pytest.approx(np.full(4, 0.05), abs=0.05)

    def test_of_one_recording_its_own_noise_and_the_healthy_scatter_are_all_that_is_known(self) -> None:
        found = taught(WEAR, [1.0], seed=2)
        assert np.array(found.covariance) == pytest.approx(NOISE + HEALTHY)
        assert found.shares == (1.0,)

    def test_a_share_and_its_interval(self) -> None:
        hits, wear = 0, WEAR  # severity 1 by definition: the mean of the labelled recordings
        for seed in range(200):
            found = taught(wear, [1.0, 1.0, 1.0, 1.0], seed)
            c = compared(found, deviation=0.6 * wear, seed=seed)["wear"]
            low, high = c.faults[0].interval
            hits += low <= 0.6 <= high
        assert 180 <= hits <= 200, hits  # a little cautious: the scatter of four recordings counts more than it is


class TestIsolation:
    @pytest.mark.parametrize("share", [0.3, 1.0, 4.0])
    def test_the_same_way_at_another_size_is_the_fault(self, share: float) -> None:
        best = next(iter(compared(taught(WEAR, [0.9, 1.1], 3), deviation=share * WEAR).values()))
        assert best.name == "wear" and best.probability > 0.95
        assert best.cosine is not None and best.cosine > 0.98
        (found,) = best.faults
        assert found.learned and found.change == found.ratio == pytest.approx(share, rel=0.15)

    @pytest.mark.parametrize("deviation", [CRACK, -WEAR, 3.0 * CRACK + WEAR])
    def test_elsewhere_is_unknown(self, deviation: np.ndarray[Any, Any]) -> None:
        candidates = compared(taught(WEAR, [0.9, 1.1], 3), deviation=deviation)
        assert next(iter(candidates)) == UNKNOWN and candidates[UNKNOWN].probability > 0.999
        cosine = candidates["wear"].cosine
        assert cosine is not None and cosine < 0.5

    def test_two_labels_and_the_coefficients_compete(self) -> None:
        wear, crack = taught(WEAR, [0.9, 1.1], 3), taught(CRACK, [1.0, 1.0], 4, "crack")
        assert next(iter(compared(wear, crack, deviation=0.7 * CRACK))) == "crack"
        alone = compared(wear, crack, deviation=UNITS * [0.0, 1.0, 0.0, 0.0])
        assert next(iter(alone)) == "theta_1" and alone["theta_1"].cosine is None

    def test_labels_that_point_the_same_way_share(self) -> None:
        twins = compared(taught(WEAR, [1.0, 1.0], 3), taught(0.5 * WEAR, [1.0, 1.0], 5, "other"), deviation=0.8 * WEAR)
        assert min(twins["wear"].probability, twins["other"].probability) > 0.05

    def test_a_direction_that_is_clear_enough_to_be_learned_is_not_near_everything(self) -> None:
        rough = taught(WEAR, [1.0], 3)
        worse = tuple(map(tuple, NOISE * rough.distinctness / (2.5 * misfit_limit(4))))
        rough = rough.model_copy(update={"covariance": worse})
        assert 2.0 * misfit_limit(4) < rough.distinctness < 3.0 * misfit_limit(4)
        assert next(iter(compared(rough, deviation=5.0 * CRACK))) == UNKNOWN
        assert next(iter(compared(rough, deviation=2.0 * WEAR))) == "wear"


Record = Callable[..., ss.Recording]


def record(seed: int, kind: str = "profile", at: float = 0.0, **ratios: float) -> ss.Recording:
    events = [FaultEvent(parameter, ratio, at) for parameter, ratio in ratios.items()]
    made, _ = simulate(LOOP, reference(kind, 40.0, LOOP.sample_rate), seed=seed, faults=events)
    return replace(made, name=f"{kind}-{seed}")


@pytest.fixture(scope="module")
def worn() -> ss.Baseline:
    """A worn pump loses pressure and leaks: two parameters at once, which no single fault of the plant explains."""
    labelled = [record(3, p_s=0.9, C_ie=1.3), record(4, "multisine", 10.0, p_s=0.92, C_ie=1.24)]
    return ss.learn(LOOP, [record(1), record(2, "multisine")], faults={"worn_pump": labelled})


class TestBesidePhysics:
    def test_labels_join_the_faults_of_the_plant(self, worn: ss.Baseline) -> None:
        """Four cases: the label at half and twice its severity, a fault of the plant, and neither."""
        for seed, share, ratios in ((5, 0.55, (0.95, 1.15)), (6, 2.3, (0.8, 1.6))):
            said = ss.diagnose(worn, record(seed, at=15.0, p_s=ratios[0], C_ie=ratios[1]))
            assert [fault.name for fault in said.faults] == ["worn_pump"]
            assert said.faults[0].ratio == pytest.approx(share, rel=0.1)
            assert "as labelled recordings show it" in said.summary and "times the labelled severity" in said.summary
            assert "healthy value" not in said.summary
        leak = ss.diagnose(worn, record(8, C_ie=1.2))
        assert [fault.name for fault in leak.faults] == ["leakage"]
        assert leak.faults[0].ratio == pytest.approx(1.2, rel=0.01)
        other = ss.diagnose(worn, record(10, p_s=1.1, C_ie=1.3))
        assert [fault.name for fault in other.faults] == ["pump", "leakage"], "another pair keeps its own names"
        assert ss.diagnose(worn, record(13)).verdict == "healthy"

    def test_only_what_follows_the_onset_teaches(self, worn: ss.Baseline) -> None:
        (fault,) = worn.learned
        assert fault.shares == pytest.approx((1.1, 0.9), abs=0.05)  # diluted by its healthy 10 s, the second had 0.7

    def test_a_label_that_is_a_fault_of_the_plant_is_told(self) -> None:
        twin = ss.learn(LOOP, [record(1)], faults={"seal": [record(7, C_ie=1.3)]})
        assert "seal may be mistaken for leakage (in 1 of 1 recordings)" in map(str, twin.notes)


class TestRefusals:
    @pytest.mark.parametrize("name", ["leakage", UNKNOWN])
    def test_names_of_the_plants_own_faults_are_taken(self, name: str) -> None:
        with pytest.raises(BaselineError, match=f"fault {name}: the name is taken"):
            ss.learn(LOOP, [record(1)], faults={name: [record(3, C_ie=1.3)]})

    def test_what_is_not_seen_cannot_be_learned(self) -> None:
        with pytest.raises(NotEnoughError, match=r"seal: profile-5 does not differ from healthy \(T² reaches \d+%"):
            ss.learn(LOOP, [record(1)], faults={"seal": [record(5)]})
        some = ss.learn(LOOP, [record(1)], faults={"seal": [record(3, C_ie=1.3), record(5)]})
        assert some.learned[0].recordings == ("profile-3",)
        assert "profile-5 is left out of seal: it does not differ from healthy" in map(str, some.notes)

    def test_opposite_changes_are_not_one_fault(self) -> None:
        with pytest.raises(NotEnoughError, match="the other way than the other recordings of seal"):
            ss.learn(LOOP, [record(1)], faults={"seal": [record(3, C_ie=1.3), record(5, C_ie=0.9)]})

    def test_recordings_that_do_not_agree_are_not_one_fault(self) -> None:
        with pytest.raises(NotEnoughError, match="the 3 recordings of wear differ from each other"):
            ss.learn(
                LOOP, [record(1)], faults={"wear": [record(20, C_ie=1.3), record(21, p_s=0.8), record(22, b_p=20.0)]}
            )

    def test_points_and_faults_go_together(self) -> None:
        seal = [record(3, C_ie=1.3)]
        with pytest.raises(BaselineError, match="give them by operating point"):
            ss.learn(LOOP, {"cold": [record(1)]}, faults={"seal": seal})
        with pytest.raises(BaselineError, match="faults at warm: there are no healthy recordings"):
            ss.learn(LOOP, {"cold": [record(1)]}, faults={"warm": {"seal": seal}})
        cold = ss.learn(LOOP, {"cold": [record(1)]}, faults={"cold": {"seal": seal}})
        assert [fault.name for fault in cold.at("cold").learned] == ["seal"]


class TestFiles:
    def test_a_baseline_keeps_its_labels(self, worn: ss.Baseline, tmp_path: Path) -> None:
        path = tmp_path / "b.json"
        worn.save(path)
        assert ss.Baseline.load(path).model_dump_json() == worn.model_dump_json()
        content = json.loads(path.read_text())
        plain = ss.learn(LOOP, [record(1), record(2, "multisine")])
        assert content["hash"] != plain.hash and content["version"] == VERSION
        del content["learned"]  # as written by a program that knows no labels
        path.write_text(json.dumps(content))
        assert ss.Baseline.load(path).learned == ()

    @pytest.mark.parametrize(
        ("key", "value", "words"),
        [
            ("deviation", [1.0], "covariance must be 1 by 1"),
            ("deviation", [0.0] * 4, "must not be zero"),
            ("covariance", [[1.0, 2.0, 0.0, 0.0], *([0.0] * 4 for _ in range(3))], "symmetric and positive"),
            ("shares", [], "one value per recording"),
            ("name", 3, "valid string"),
        ],
    )
    def test_damaged_labels_are_refused(
        self, worn: ss.Baseline, tmp_path: Path, key: str, value: object, words: str
    ) -> None:
        path = tmp_path / "b.json"
        worn.save(path)
        content = json.loads(path.read_text())
        content["learned"][0][key] = value
        path.write_text(json.dumps(content))
        with pytest.raises(BaselineError, match=f"damaged baseline, .*{words}"):
            ss.Baseline.load(path)

    def test_from_the_command_line(self, tmp_path: Path) -> None:
        loop = tmp_path / "loop.toml"
        loop.write_bytes(RIG.read_bytes())
        for name, made in (
            ("healthy", record(1)),
            ("worn", record(3, p_s=0.9, C_ie=1.3)),
            ("today", record(5, p_s=0.95, C_ie=1.15)),
        ):
            writers.write_recording(tmp_path / f"{name}.csv", made, LOOP.columns)
        healthy, ill, out = (tmp_path / name for name in ("healthy.csv", "worn.csv", "b.json"))
        done = run("learn", loop, healthy, "-o", out, "--fault", f"worn_pump={ill}", "--json")
        assert done.code == 0, done.err
        assert json.loads(done.out)["learned"] == [{"name": "worn_pump", "recordings": ["worn.csv"], "shares": [1.0]}]
        page = tmp_path / "page.html"
        said = run("diagnose", out, tmp_path / "today.csv", "--details", "--report", page)
        assert said.code == 3 and "cosine" in said.out and "labelled" in said.out
        assert "severity ×\N{NO-BREAK SPACE}0.475" in page.read_text(encoding="utf-8")
        one_line(run("learn", loop, healthy, "-o", out, "--fault", f"leakage={ill}"), "fault leakage", "taken")
        for word, why in ((str(ill), "NAME=FILE"), ("=x.csv", "NAME=FILE"), (f"seal@warm={ill}", "at no point")):
            refused = run("learn", loop, healthy, "-o", out, "--fault", word)
            assert refused.code == 2 and why in " ".join(refused.err.replace("│", " ").split())
        assert run("learn", loop, "--nominal", "-o", out, "--fault", f"seal={ill}").code == 2


class TestCranfield:
    @pytest.mark.slow
    def test_names_are_right_or_left_open(self, shared_data: Path) -> None:
        """Half of the runs after learning from the other; the whole study does both, at all loads."""
        folder, loop = shared_data / "real" / "cranfield", ss.Loop.load(PROJECT / "examples" / "cranfield.toml")

        def runs(file: str, load: str, which: str) -> list[ss.Recording]:
            where = {"load": load, "run": which}
            return ss.read_parts(folder / f"{file}.csv", loop, where=where, by="run")

        files = {"40": {"backlash": "backlash2", "dry": "lackLubrication1"}, "-40": {"backlash": "backlash2"}}
        halves = {"40": ("6-10", "1-5"), "-40": ("1-5", "6-10")}
        named = dict.fromkeys(files, 0)
        for load, kinds in files.items():
            known, judged = halves[load]
            faults = {kind: runs(file, load, known) for kind, file in kinds.items()}
            baseline = ss.learn(loop, runs("normal", load, "1-5"), faults=faults)
            assert all(ss.diagnose(baseline, one).verdict == "healthy" for one in runs("normal", load, "6-10"))
            for kind, file in kinds.items():
                for one in runs(file, load, judged):
                    said = ss.diagnose(baseline, one)
                    assert {fault.name for fault in said.faults} <= {kind}, one.name
                    named[load] += bool(said.faults)
                    assert said.verdict == "healthy" or said.candidates[0].name != UNKNOWN
        # at 40 kgf backlash and dryness look alike: most runs are found and left open between the two
        assert named["40"] >= 2 and named["-40"] >= 4
