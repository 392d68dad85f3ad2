"""Covariates: what temperature or load do is healthy, wear beside them is found, and beyond them nothing is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import run

import servoscope as ss
from servoscope.baseline.covariates import CovariateAverage, CovariateModel, hold_last
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import BaselineError, NotEnoughError, RecordingError
from servoscope.export import export_st
from servoscope.signals import writers
from servoscope.simulation import FaultEvent, reference, simulate
from servoscope.simulation.nonlinear_eha import Rig, simulate_rig
from servoscope.simulation.tutorial import AXIS

FILE = Path(__file__).parents[2] / "src/servoscope/simulation/reference-rig.toml"
PLAIN = ss.Loop.load(FILE)
LOOP = PLAIN.model_copy(update={"columns": PLAIN.columns.model_copy(update={"covariates": {"oil": "T_oil"}})})
RESTS = {
    "update_when": "moving",
    "rest_speed": 0.004,
}  # the axis creeps and sticks between its moves: as `inspect` asks
CARRIED = ss.Loop.from_dict({**AXIS, "columns": {"covariates": {"load": "load"}}, "monitor": RESTS})
WEAR = FaultEvent.parse("C_ie=1.1@30")
NOISE = {"noise_u_std": 5e-3, "noise_y_std": 1e-5}


def warm_up(seed: int, start: float, rise: float, *faults: FaultEvent) -> ss.Recording:
    """A minute in which the oil warms: 4 % of viscosity per kelvin, which leakage and friction follow."""
    rig = replace(Rig.ideal(), temperature=start, warming=rise, warming_time=60.0)
    made, truth = simulate_rig(LOOP, reference("profile", 60.0, LOOP.sample_rate), rig, faults=faults, seed=seed)
    return replace(made, channels={"oil": truth.temperature}, name=f"warm-{seed}")


def carry(load: float, seed: int, *faults: FaultEvent) -> ss.Recording:
    """Half a minute of an axis with a load: 10 % of inertia per unit."""
    nominal = CARRIED.plant.coefficients  # type: ignore[attr-defined]
    plant = CARRIED.plant.model_copy(
        update={"coefficients": {**nominal, "inertia": nominal["inertia"] * (1.0 + 0.1 * load)}}
    )
    loop = CARRIED.model_copy(update={"plant": plant})
    made, _ = simulate(loop, reference("trapezoid", 30.0, loop.sample_rate), seed=seed, faults=faults, **NOISE)
    return replace(made, channels={"load": np.full(made.samples, load)}, name=f"load-{load:g}-{seed}")


@pytest.fixture(scope="module")
def warm() -> ss.Baseline:
    return ss.learn(LOOP, [warm_up(i, 30.0 + 2.0 * i, rise) for i, rise in enumerate((5, 10, 15, 20, 25, 30))])


@pytest.fixture(scope="module")
def carried() -> ss.Baseline:
    return ss.learn(CARRIED, [carry(load, i) for i, load in enumerate((1.0, 3.0, 5.0, 1.0, 3.0, 5.0))])


def test_coefficients_follow_the_law_of_the_oil(warm: ss.Baseline) -> None:
    model = warm.covariates
    assert model is not None
    assert model.proportional[0]
    cold, hot = (warm.at({"oil": c}) for c in (35.0, 50.0))
    # theta_0 = C_ie k_p/(A_p K_q), and 15 K are exp(0.04 x 15) times the leakage
    assert hot.theta[0] / cold.theta[0] == pytest.approx(np.exp(0.6), rel=0.003)
    assert hot.healthy.ratios["C_ie"] / cold.healthy.ratios["C_ie"] == pytest.approx(np.exp(0.6), rel=0.01)
    assert hot.healthy.ratios["p_s"] / cold.healthy.ratios["p_s"] == pytest.approx(1.0, abs=0.01)


def test_covariance_of_the_coefficients_is_that_of_the_slopes(warm: ss.Baseline) -> None:
    model, temperatures = warm.covariates, np.linspace(31.0, 55.0, 5)
    assert model is not None
    c, origin = temperatures[:, None], np.array(warm.theta)
    G, size = model.basis(c), np.where(model.proportional, model.theta(origin, c), 1.0)
    C = np.array(model.covariance).reshape(G.shape[1], len(origin), G.shape[1], len(origin))
    expected = np.einsum("kp,piqj,kq,ki,kj->kij", G, C, G, size, size)
    np.testing.assert_allclose(model.theta_covariance(origin, c), expected, rtol=1e-12)


def test_warm_up_is_healthy_where_it_is_a_leak_without_the_covariate(warm: ss.Baseline) -> None:
    recordings = [warm_up(50 + i, start, rise) for i, (start, rise) in enumerate([(35.0, 7.0), (38.0, 20.0)])]
    found = [ss.diagnose(warm, one) for one in recordings]
    assert [one.verdict for one in found] == ["healthy", "healthy"]
    assert "oil 38–50.6" in str(found[1].headline)
    assert ss.diagnose(warm, warm_up(55, 59.0, 0.0)).verdict == "healthy"  # next to the learned range, not of its edge
    blind = ss.Monitor(ss.learn(PLAIN, [replace(warm_up(60, 38.0, 0.0), channels={})]))
    assert all(blind.run(blind.init(), one.r, one.u, one.y)[1].exceeded.any() for one in recordings)


@pytest.mark.parametrize("rise", [0.0, 15.0])
def test_wear_while_the_oil_warms_has_its_name_and_size(warm: ss.Baseline, rise: float) -> None:
    diagnosis = ss.diagnose(warm, warm_up(70, 38.0, rise, WEAR))
    (fault,) = diagnosis.faults
    assert fault.name == "leakage"
    assert fault.ratio == pytest.approx(1.1, rel=0.01)
    # 10 % more leakage is what log(1.1)/0.04 = 2.4 K do: only the thermometer tells
    (warning,) = [one.description for one in diagnosis.warnings if one.kind == "point"]
    logged, other = (float(dict(warning.values)[name]) for name in ("logged", "other"))
    assert other - logged == pytest.approx(2.4, abs=0.4)
    assert diagnosis.onset_s is not None
    assert diagnosis.onset_s[0] - 0.6 <= 30.0 <= diagnosis.onset_s[2] + 0.6


def test_beyond_the_learned_range_nobody_knows(warm: ss.Baseline, carried: ss.Baseline) -> None:
    hot = ss.diagnose(warm, warm_up(80, 60.0, 20.0))
    assert hot.verdict == "undetermined"
    assert "oil was 60–72.6, and the healthy recordings hold 30.4–58" in str(hot.headline)
    assert ss.diagnose(carried, carry(8.0, 81)).verdict == "undetermined"
    with pytest.raises(BaselineError, match="load was 8"):
        carried.at({"load": 8.0})
    with pytest.raises(BaselineError, match="give load"):
        carried.at({"oil": 8.0})


def test_between_learned_loads_the_axis_is_healthy_and_a_fault_found(carried: ss.Baseline) -> None:
    assert [ss.diagnose(carried, carry(load, 90)).verdict for load in (2.0, 4.0)] == ["healthy", "healthy"]
    (found,) = ss.diagnose(carried, carry(2.0, 91, FaultEvent.parse("viscous_friction=1.5@10"))).faults
    assert found.name == "viscous_friction"
    assert found.ratio == pytest.approx(1.5, rel=0.01)
    one = ss.learn(CARRIED.model_copy(update={"columns": PLAIN.columns}), [carry(1.0, i) for i in range(4)])
    assert ss.diagnose(one, carry(4.0, 92)).verdict == "fault"


def test_a_linear_plant_keeps_its_refit_where_the_load_stays_in_a_recording() -> None:
    plain = {"kind": "polynomial", "order": 2, "coefficients": {"inertia": 1.0, "viscous_friction": 10.0}}
    loop = ss.Loop.from_dict({**AXIS, "plant": plain, "sample_rate": 50.0, "columns": CARRIED.columns.model_dump()})

    def record(seed: int, load: float, *faults: FaultEvent) -> ss.Recording:
        heavier = loop.model_copy(update={"plant": loop.plant.with_ratios({"inertia": 1.0 + 0.1 * load})})
        made, _ = simulate(heavier, reference("multisine", 20.0, 50.0), seed=seed, faults=faults, **NOISE)
        return replace(made, channels={"load": np.full(made.samples, load)})

    learned = ss.learn(loop, [record(i, load) for i, load in enumerate((1.0, 3.0, 5.0))])
    assert learned.exact is not None and learned.exact.misfit <= 1.0
    (interval,) = ss.diagnose(learned, record(9, 4.0, FaultEvent.parse("viscous_friction=1.3@10"))).intervals
    assert interval.refit is not None and interval.faults[0].name == "viscous_friction"
    assert interval.faults[0].ratio == pytest.approx(1.3, rel=0.01)


def test_where_the_oil_warms_within_recordings_learn_says_that_there_is_no_refit(warm: ss.Baseline) -> None:
    assert any(note.key == "learning.no_refit_along" for note in warm.notes)


def test_the_monitor_says_the_same_block_by_block(warm: ss.Baseline, tmp_path: Path) -> None:
    warm.save(tmp_path / "baseline.json")
    monitor = ss.Monitor(tmp_path / "baseline.json")
    for faults in ((), (WEAR,)):
        rec = warm_up(52, 38.0, 18.0, *faults)
        oil = rec.channels["oil"].copy()
        oil[:130], oil[1000:1010] = np.nan, np.nan  # comes late, and fails for a while
        signals = rec.r, rec.u, rec.y, rec.restart
        state, trace = monitor.run(monitor.init(), *signals, channels={"oil": oil})
        assert trace.exceeded.any() == bool(faults)
        after = monitor.init()
        for rows in (slice(0, 37), slice(37, 131), slice(131, 1005), slice(1005, None)):
            after, part = monitor.run(after, *(x[rows] for x in signals), channels={"oil": oil[rows]})
        np.testing.assert_array_equal(after, state)
        assert part.statistic[-1] == trace.statistic[-1]
        assert monitor.latest(state).statistic[0] == pytest.approx(trace.statistic[-1], rel=1e-9)
    with pytest.raises(RecordingError, match="oil was not logged"):
        monitor.run(monitor.init(), *signals)


def test_the_monitor_is_silent_outside_of_the_range(warm: ss.Baseline) -> None:
    rec = warm_up(53, 66.0, 20.0)  # the fifth of the range beyond its end is known, with less certainty
    _, trace = ss.Monitor(warm).run(
        ss.Monitor(warm).init(), rec.r, rec.u, rec.y, rec.restart, channels={"oil": rec.channels["oil"]}
    )
    assert not trace.ready[50:].any()
    assert not trace.exceeded[50:].any()


def test_the_loop_file_names_the_columns(tmp_path: Path) -> None:
    text = FILE.read_text(encoding="utf-8")
    head, plant, tail = text.partition("[plant]")
    (tmp_path / "loop.toml").write_text(f'{head}[columns.covariates]\noil = "T_oil"\n\n{plant}{tail}', encoding="utf-8")
    for i, (start, rise) in enumerate([(34.0, 20.0), (42.0, 12.0), (38.0, 10.0)]):
        writers.write_recording(tmp_path / f"{i}.csv", warm_up(i, start, rise), LOOP.columns)
    loop = ss.Loop.load(tmp_path / "loop.toml")
    assert loop.columns.covariates == {"oil": "T_oil"}
    again = ss.read(tmp_path / "0.csv", loop)
    np.testing.assert_allclose(again.channels["oil"], warm_up(0, 34.0, 20.0).channels["oil"])
    assert (
        run("learn", tmp_path / "loop.toml", tmp_path / "0.csv", tmp_path / "1.csv", "-o", tmp_path / "b.json").code
        == 0
    )
    said = run("diagnose", tmp_path / "b.json", tmp_path / "2.csv")
    assert said.code == 0
    assert "Healthy at oil 38" in said.out


def test_what_cannot_be_learned_is_refused() -> None:
    still = [replace(carry(1.0, i), channels={"load": np.full(6000, 1.0)}) for i in range(2)]
    with pytest.raises(NotEnoughError, match="load is 1 in all"):
        ss.learn(CARRIED, still)
    with pytest.raises(NotEnoughError, match="no values of covariate load"):
        ss.learn(CARRIED, [replace(still[0], channels={})])


def test_a_recording_without_the_covariate_is_refused(carried: ss.Baseline) -> None:
    with pytest.raises(RecordingError, match="load was not logged"):
        ss.diagnose(carried, replace(carry(2.0, 93), channels={}))


def test_the_covariance_of_the_coefficients_is_that_of_drawn_slopes() -> None:
    rng = np.random.default_rng(3)
    half = rng.standard_normal((6, 6)) * 0.005
    C, B = half @ half.T, rng.standard_normal((3, 2)) * 0.2
    made: dict[str, object] = {"names": ("a", "b"), "low": (0.0, 1.0), "high": (2.0, 5.0), "degrees": (2, 1)}
    theta, c = np.array([2.0, -1.0]), np.array([1.7, 2.0])

    def model(slopes: FloatArray) -> CovariateModel:
        return CovariateModel.model_validate(
            {**made, "proportional": (True, False), "slopes": slopes.tolist(), "covariance": C.tolist()}
        )

    drawn = rng.multivariate_normal(B.ravel(), C, size=4000).reshape(-1, 3, 2)
    values = np.array([model(one).theta(theta, c) for one in drawn])
    np.testing.assert_allclose(model(B).theta_covariance(theta, c), np.cov(values.T), rtol=0.1, atol=2e-5)


def test_averages_hold_what_was_known_last() -> None:
    c = np.array([[np.nan], [4.0], [np.nan], [2.0]])
    np.testing.assert_array_equal(hold_last(c, np.array([np.nan]))[:, 0], [np.nan, 4.0, 4.0, 2.0])
    average = CovariateAverage(1, 4.0)
    np.testing.assert_allclose(average.run(average.start(), c)[:, 0], [np.nan, 4.0, 4.0, 3.5])


def test_who_carries_no_covariates_refuses_them(carried: ss.Baseline, tmp_path: Path) -> None:
    with pytest.raises(BaselineError, match="this baseline has load: export C"):
        export_st(carried)
    carried.save(tmp_path / "baseline.json")
    hall = (
        'name = "hall"\n[sources.line]\nkind = "opcua"\nurl = "opc.tcp://localhost"\n'
        '[assets.press]\nbaseline = "baseline.json"\nsource = "line"\n'
        'nodes = { r = "ns=1;s=r", u = "ns=1;s=u", y = "ns=1;s=y" }\n'
    )
    (tmp_path / "hall.toml").write_text(hall, encoding="utf-8")
    told = run("run", tmp_path / "hall.toml", "--check")
    assert told.code == 1
    assert "[assets] press.baseline: baseline.json depends on load" in told.err
    assert "name it under [assets.press] nodes.covariates" in told.err


def test_a_motion_never_seen_makes_an_alarm_harder_beside_covariates(carried: ss.Baseline) -> None:
    known, nominal = carry(2.0, 70), carry(2.0, 71)
    far, _ = simulate(CARRIED, reference("multisine", 30.0, CARRIED.sample_rate, amplitude=3.0), seed=72, **NOISE)
    far = replace(far, channels=nominal.channels)
    plain, watched = ss.Monitor(carried), ss.Monitor(carried, motion_check=True)
    for recording, familiar in ((known, True), (far, False)):
        signals = recording.r, recording.u, recording.y, recording.restart
        (_, without), (_, checked) = (
            monitor.run(monitor.init(), *signals, channels=recording.channels) for monitor in (plain, watched)
        )
        assert checked.motion is not None
        assert (checked.statistic <= without.statistic).all()
        assert familiar == bool(checked.motion.max() < 0.5)
        assert familiar or checked.statistic[-1] < 0.1 * without.statistic[-1]
