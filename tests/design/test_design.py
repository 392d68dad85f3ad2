"""Studies before deployment: information against oracles and golden numbers, radii against simulated recordings."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import one_line, run
from rich.console import Console
from scipy import linalg

import servoscope as ss
from golden.results import FOLDER
from servoscope.baseline.baseline import Baseline
from servoscope.baseline.records import ExactPredictorFit
from servoscope.cli.render.design import print_study
from servoscope.core.errors import LoopError, SimulationError
from servoscope.core.messages import speak
from servoscope.design import BaselineStudy, DesignStudy, study, study_baseline
from servoscope.design.detectability import AlarmPower, detectable_size
from servoscope.design.fisher_information import (
    MISNAMED,
    fisher_matrix,
    linear_isolability_radius,
    misnaming_probability,
)
from servoscope.design.isolability import ambiguous_sizes, hypothesis_distances
from servoscope.design.mimics import match_mimic, mimic_causes
from servoscope.design.operating_limits import operating_limits
from servoscope.design.scenario import Scenario
from servoscope.estimation.noise_model import WhiteNoise
from servoscope.evidence.examination import Examination
from servoscope.isolation.ml.hypothesis import fit_hypothesis
from servoscope.isolation.ml.window import RefitWindow
from servoscope.learning.learn import nominal_baseline
from servoscope.models.loop import Loop
from servoscope.report import design_page
from servoscope.simulation import FaultEvent, reference, simulate

AXIS = """
name = "axis"
sample_rate = 100.0

[plant]
kind = "polynomial"
order = 2
coefficients = { viscous_friction = 20.0, inertia = 2.0 }

[controller]
kind = "pi"
k_p = 150.0
k_i = 10.0
"""
NOISE = ("--noise-u", "0.01", "--noise-y", "1e-5")


@pytest.fixture(scope="module")
def learned() -> Baseline:
    from importlib.resources import files

    loop = Loop.load(Path(str(files("servoscope").joinpath("simulation", "reference-rig.toml"))))
    return ss.learn(loop, [simulate(loop, reference("profile", 60.0, 100.0), seed=1)[0]])


@pytest.fixture(scope="module")
def scene(learned: Baseline) -> Scenario:
    return Scenario.from_baseline(learned, reference("profile", 90.0, 100.0), 30.0)


@pytest.fixture(scope="module")
def alarms(scene: Scenario) -> AlarmPower:
    return AlarmPower(scene)


def recorded(scene: Scenario, parameter: str, x: float, seed: int) -> ss.Recording:
    """Simulate one of the loops that the baseline may have been learned from, with a fault."""
    b = scene.baseline
    off = np.random.default_rng(seed).multivariate_normal(
        np.zeros(len(b.healthy.ratios)), np.array(b.healthy.covariance)
    )
    true = b.plant.with_ratios(dict(zip(b.plant.parameters, np.exp(off).tolist(), strict=True)))
    return simulate(
        b.loop.model_copy(update={"plant": true}),
        scene.r,
        faults=[FaultEvent(parameter, float(np.exp(x)), scene.onset / b.loop.sample_rate)],
        noise_u_std=scene.noise.u_std,
        noise_y_std=scene.noise.y_std,
        seed=seed,
    )[0]


class TestInformation:
    def test_golden_bounds(self, rig: dict[str, Any]) -> None:
        """Relative standard deviations for 10 s of the profile at the paper's noise, computed elsewhere."""
        baseline = nominal_baseline(Loop.from_dict(rig))
        baseline = baseline.model_copy(
            update={"exact": ExactPredictorFit(noise=WhiteNoise(1e-4, float(np.sqrt(1e-7))), misfit=0.0)}
        )
        F = fisher_matrix(Scenario.from_baseline(baseline, reference("profile", 20.0, 100.0), 10.0))
        assert 1.0 / np.sqrt(np.diag(F)) == pytest.approx([0.0007, 0.0006, 0.059, 0.022], rel=0.12)
        together = np.sqrt(np.diag(np.linalg.inv(F)))  # with all others free
        assert together == pytest.approx([0.0065, 0.0033, 0.41, 0.027], rel=0.05)

    def test_against_a_kalman_filter_and_differences(self, scene: Scenario) -> None:
        b, window, rate = scene.baseline, scene.healthy, scene.loop.sample_rate
        scale = np.array([1e-2, 1.0, 1e6])  # m, m/s, Pa

        def innovations(ratios: dict[str, float]) -> np.ndarray:
            models = []
            for plant in (b.plant, b.plant.with_ratios(ratios)):
                A, B, C = plant.state_space()
                both = linalg.expm(
                    np.block([[A * scale / scale[:, None], B / scale[:, None]], [np.zeros((1, 4))]]) / rate
                )
                Ad, Bd, Cd = both[:3, :3], both[:3, 3:], C * scale
                Q = scene.noise.u_std**2 * Bd @ Bd.T
                P = linalg.solve_discrete_are(Ad.T, Cd.T, Q, [[scene.noise.y_std**2]])
                S = float((Cd @ P @ Cd.T)[0, 0]) + scene.noise.y_std**2
                models.append((Ad, Bd[:, 0], Cd[0], (Ad @ P @ Cd.T)[:, 0] / S, S))
            x, e = np.zeros(3), []
            for k in range(window.samples):
                Ad, Bd, c, K, S = models[int(k >= scene.lead_samples)]
                e.append((window.y[k] - c @ x) / np.sqrt(S))
                x = Ad @ x + Bd * window.u[k] + K * (window.y[k] - c @ x)
            return np.array(e[scene.lead_samples :])

        h = 1e-4
        slow = np.array(
            [(innovations({p: np.exp(h)}) - innovations({p: np.exp(-h)})) / (2.0 * h) for p in ("C_ie", "beta")]
        )
        assert fisher_matrix(scene)[np.ix_([1, 3], [1, 3])] == pytest.approx(slow @ slow.T, rel=2e-3, abs=20.0)

    def test_what_is_not_known_beforehand_costs(self, scene: Scenario) -> None:
        exact, uncertain = fisher_matrix(scene), fisher_matrix(scene, exact=False)
        assert np.linalg.eigvalsh(exact - uncertain)[0] > 0.0
        assert fisher_matrix(scene, 10.0)[0, 0] < exact[0, 0]

    def test_two_changes_that_are_one_are_never_told_apart(self) -> None:
        F = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 4.0]])
        assert linear_isolability_radius(F, 0) == np.inf


def known_exactly(scene: Scenario) -> Scenario:
    """Return the same with healthy parameters that hardly have an error."""
    return replace(scene, prior=1e6 * np.eye(len(scene.prior)))


class TestIsolability:
    def test_small_changes_are_as_far_apart_as_information_says(self, scene: Scenario) -> None:
        F, x = fisher_matrix(scene), 2e-3
        found = hypothesis_distances(scene, scene.loop.plant.faults[1], x)
        linear = x**2 * (F[1, 1] - F[1, [0, 2, 3]] ** 2 / np.diag(F)[[0, 2, 3]])
        exact = hypothesis_distances(known_exactly(scene), scene.loop.plant.faults[1], x)
        assert exact.squared == pytest.approx(linear, rel=0.03)
        assert np.all(found.squared < exact.squared)

    def test_radius_is_close_to_the_bound(self, scene: Scenario) -> None:
        fault = scene.loop.plant.faults[1]
        ((begin, end),) = ambiguous_sizes(scene, fault, up=True)
        assert begin == 0.0
        assert (
            linear_isolability_radius(fisher_matrix(scene), 1)
            < end
            < 1.3 * linear_isolability_radius(fisher_matrix(scene), 1)
        )
        exact = hypothesis_distances(known_exactly(scene), fault, end)
        assert misnaming_probability(exact.squared) < 0.5 * MISNAMED
        assert misnaming_probability(hypothesis_distances(scene, fault, end).squared) == pytest.approx(
            MISNAMED, rel=0.2
        )

    def test_wrong_names_are_as_frequent_as_predicted(self, scene: Scenario) -> None:
        """Thirty recordings of a pump fault: which of the two closest hypotheses fits better."""
        faults, x, runs, wrong = scene.loop.plant.faults, 1.5e-3, 30, 0
        predicted = hypothesis_distances(scene, faults[0], x)
        expected = misnaming_probability(predicted.squared[1:2])
        assert predicted.others[1].name == "friction"
        assert 0.1 < expected < 0.25
        size = float(predicted.sizes[1])
        for seed in range(runs):
            recording = recorded(scene, "p_s", x, seed)
            window = RefitWindow.from_recording(
                scene.baseline, recording, scene.onset - scene.lead_samples, recording.samples
            )
            window = replace(window, prior=scene.prior)
            nothing = np.zeros(window.nuisance_count)
            J = [
                fit_hypothesis(window, [fault], scene.profile, nothing, [np.array([start])], free=True).cost
                for fault, start in ((faults[0], x), (faults[2], size))
            ]
            wrong += J[1] < J[0]
        assert abs(wrong / runs - expected) < 3.0 * np.sqrt(expected * (1.0 - expected) / runs)


class TestDetectability:
    def test_nine_of_ten_are_announced_at_the_smallest_detectable_size(
        self, scene: Scenario, alarms: AlarmPower
    ) -> None:
        fault, runs, seen = scene.loop.plant.faults[0], 30, 0
        x = detectable_size(alarms, fault, up=True)
        assert 0.9 <= alarms.probability(fault, x) < 0.96
        for seed in range(runs):
            exam = Examination.from_recording(scene.baseline, recorded(scene, fault.parameter, x, seed))
            seen += bool(np.any(exam.alarm & (exam.t(slice(None)) >= 60.0)))
        assert seen / runs > 0.9 - 3.0 * np.sqrt(0.09 / runs)

    def test_larger_changes_are_announced_more_surely(self, scene: Scenario, alarms: AlarmPower) -> None:
        fault = scene.loop.plant.faults[1]
        probabilities = [alarms.probability(fault, x) for x in (0.0, 0.002, 0.004, 0.006, 0.01)]
        assert probabilities == sorted(probabilities)
        assert probabilities[0] < 1e-3 and probabilities[-1] > 0.999


class TestBaselineAlone:
    def test_one_that_can_be_simulated_is_studied_as_with_its_recordings(self, learned: Baseline) -> None:
        alone = study_baseline(learned, after_s=10.0)
        assert isinstance(alone, DesignStudy)
        assert alone == study(learned, reference("profile", 70.0, 100.0), 10.0, reference="profile")

    def test_another_says_its_promises_and_what_is_alike(self, learned: Baseline, tmp_path: Path) -> None:
        settings = {key: value for key, value in learned.loop_settings.items() if key != "controller"}
        hidden = learned.model_copy(update={"loop_settings": settings})
        said = study_baseline(hidden)
        assert isinstance(said, BaselineStudy) and "[controller]" in said.missing
        for promise in learned.detectability.changes:
            assert said.faults[promise.name].detectable == promise.change
        assert said.cosines["pump"]["pump"] == pytest.approx(1.0)
        hidden.save(tmp_path / "baseline.json")
        printed = run("design", tmp_path / "baseline.json")
        assert printed.code == 0, printed.err
        assert "pump" in printed.out and "[controller]" in printed.out
        assert BaselineStudy.model_validate_json(run("design", tmp_path / "baseline.json", "--json").out) == said
        one_line(run("design", tmp_path / "baseline.json", "--report", tmp_path / "page.html"), "no page")
        one_line(run("design", tmp_path / "baseline.json", tmp_path / "baseline.json"), "leave out")

    def test_a_learned_axis_needs_no_nominal_values(self) -> None:
        said = study_baseline(Baseline.load(FOLDER / "axis.json"))
        assert isinstance(said, BaselineStudy) and "linear plant" in said.missing
        inertia = said.faults["inertia"]
        assert inertia.detectable == pytest.approx(0.318, rel=0.01)
        assert inertia.isolable is not None and inertia.isolable < 2.0 * inertia.detectable


class TestMimics:
    def test_what_is_known_to_look_alike(self, scene: Scenario) -> None:
        found = {cause.name: match_mimic(scene, cause) for cause in mimic_causes(scene)}
        gain = found["gain of u"]  # K_q goes with the root of p_s
        assert (gain.imitates, gain.told_apart) == ("pump", None)
        assert np.log(gain.looks_like) / gain.amount == pytest.approx(2.0, rel=1e-6)
        assert found["gain of y"].imitates == "pump"
        spring = found["k_p"]  # theta_0 = C_ie k_p
        assert spring.imitates == "leakage"
        assert spring.cosines["leakage"] == pytest.approx(1.0, abs=1e-3)
        for told in (found["delay"].told_apart, found["A_p"].told_apart):
            assert told is not None and told < 0.1


class TestCommand:
    @pytest.mark.slow
    def test_prints_and_writes(self, tmp_path: Path) -> None:
        loop, page = tmp_path / "axis.toml", tmp_path / "page.html"
        loop.write_text(AXIS)
        done = run("design", loop, *NOISE, "--after", 5, "--json", "--report", page)
        assert done.code == 0, done.err
        said = DesignStudy.model_validate(json.loads(done.out))
        assert said.after_s == 5.0
        fault = said.faults["inertia"]
        assert fault.up.detectable is not None
        assert fault.up.isolable is not None
        assert 1.0 < fault.up.isolable < 1.01
        assert fault.up.clear(1.05)
        assert not fault.up.clear(1.0001)
        assert fault.down.isolable is not None
        assert fault.down.isolable < 1.0
        assert fault.sizes[-1].std is not None
        lost = {(one.fault, one.kind): one for one in operating_limits(Loop.load(loop))}
        for name, each in said.faults.items():
            assert [each.up.tracking, each.down.tracking] == [lost[name, "tracking"].up, lost[name, "tracking"].down]
            assert [each.up.stability, each.down.stability] == [
                lost[name, "stability"].up,
                lost[name, "stability"].down,
            ]
        out = io.StringIO()
        print_study(Console(file=out, width=100), said)
        heavy = fault.up.tracking  # a heavier axis follows worse
        assert heavy is not None and f"inertia up {heavy:g}" in " ".join(out.getvalue().split())
        html = page.read_text(encoding="utf-8")
        assert html == design_page.render_design_page(said)
        assert html.count("<svg") == 2
        assert "http" not in html.replace("http-equiv", "")
        with speak("de"):  # page and terminal
            out = io.StringIO()
            print_study(Console(file=out, width=100), said)
            text = re.sub(r"<style>.*?</style>|<[^>]*>", " ", design_page.render_design_page(said), flags=re.S)
        assert re.findall(r".{30}\b(the|which|from|size|never|told|most|samples|change)\b", text + out.getvalue()) == []

    @pytest.mark.parametrize(
        ("old", "new", "told"),
        [
            ("[controller]", "[monitor]\ncutoff = 5.0\n", "[controller]"),
            ("order = 2", 'order = 2\nfriction = "coulomb"', "linear plant"),
        ],
    )
    def test_refuses_in_one_line(self, old: str, new: str, told: str, tmp_path: Path) -> None:
        loop = tmp_path / "axis.toml"
        text = (
            AXIS.split("[controller]")[0]
            if old == "[controller]"
            else AXIS.replace("inertia = 2.0", "inertia = 2.0, coulomb_friction = 1.0")
        )
        loop.write_text(text.replace(old, new))
        one_line(run("design", loop), told)


def test_refuses_a_reference_that_is_too_short(learned: Baseline) -> None:
    with pytest.raises(SimulationError, match="at most 10 s"):
        study(learned, reference("profile", 10.0, 100.0), 20.0)


def test_refuses_a_plant_without_values() -> None:
    loop = Loop.from_dict({"sample_rate": 100.0, "plant": {"kind": "polynomial", "order": 2}})
    with pytest.raises(LoopError, match="nominal values"):
        ss.design_study(loop)


def test_a_path_is_a_loop_too(tmp_path: Path) -> None:
    with pytest.raises(LoopError, match="no such file"):
        ss.design_study(tmp_path / "loop.toml")
