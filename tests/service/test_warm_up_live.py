"""A warm-up that nobody measures, while it goes on: the course, wear beside it, gaps, and a service that follows it."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from brokers import BEGAN, Running, until
from halls import RESULTS, asked, service_of
from warm_ups import HEALTHY, LOOP, warm_up

import servoscope as ss
from servoscope.detection.warm_up import JUMP, NAME, STD, BlockSums, find_course
from servoscope.service.assets.checkpoint import unpack_state
from servoscope.service.assets.examination import carry_covariates, diagnose_blocks, examine_blocks
from servoscope.service.sources.block import Block
from servoscope.service.store import Store
from servoscope.signals import writers
from servoscope.simulation import FaultEvent, reference
from servoscope.simulation.nonlinear_eha import Rig, simulate_rig

LEAK = FaultEvent.parse("C_ie=1.1@60")


def minutes(seed: int, start: float, rise: float, *faults: FaultEvent, seconds: float = 150.0) -> ss.Recording:
    """Oil that warms with a time constant of a minute, for longer than a recording that was learned."""
    rig = replace(Rig.ideal(), temperature=start, warming=rise, warming_time=60.0)
    made, _ = simulate_rig(LOOP, reference("profile", seconds, LOOP.sample_rate), rig, faults=faults, seed=seed)
    return replace(made, name=f"minutes-{seed}")


@pytest.fixture(scope="module")
def baseline() -> ss.Baseline:
    return ss.learn(LOOP, [warm_up(i, start, rise)[0] for i, (start, rise) in enumerate(HEALTHY)])


def follow(baseline: ss.Baseline, made: ss.Recording) -> tuple[ss.Trace, dict[str, np.ndarray], ss.Monitor]:
    """Return the trace, and the newest value of each channel that the monitor knows."""
    monitor = ss.Monitor(baseline)
    state, trace = monitor.run(monitor.init(), made.r, made.u, made.y, made.restart)
    return trace, {name: values[-1] for name, (_, values) in monitor.covariate_history(state).items()}, monitor


@pytest.mark.parametrize(("start", "rise"), [(30.0, 8.0), (33.0, 18.0), (40.0, 0.0)])
def test_the_course_is_that_of_the_whole_recording_and_wear_beside_it_stays_an_alarm(
    baseline: ss.Baseline, start: float, rise: float
) -> None:
    """Oracle: the fit of the whole recording at once, which `diagnose` makes."""
    assert baseline.covariates is not None and baseline.covariates.warm_up is not None
    for faults in ((), (LEAK,)):
        made = minutes(70, start, rise, *faults)
        trace, now, _ = follow(baseline, made)
        sums = BlockSums.of(baseline.pipeline(), made)
        whole, _ = find_course(sums, baseline.covariates.warm_up, np.array(baseline.theta), baseline.covariates)
        assert abs(now[NAME] - whole.course[-1]) < 4.0 * (now[STD] + whole.std[-1]) < 0.1
        assert 0.0 < now[JUMP] < 0.1
        exceeded = trace.exceeded[trace.t > 70.0]
        assert not trace.exceeded[trace.t < 60.0].any() and trace.ready[trace.t > 5.0].all()
        assert exceeded.all() if faults else not exceeded.any()


def test_states_are_the_same_however_samples_are_cut_and_gaps_forget_the_warmth_only(baseline: ss.Baseline) -> None:
    made, monitor = minutes(71, 33.0, 18.0, LEAK), ss.Monitor(baseline)
    restart = made.restart.copy()
    restart[9013] = True
    y = made.y.copy()
    y[11000:11040] = np.nan
    whole, trace = monitor.run(monitor.init(), made.r, made.u, y, restart)
    state, statistics = monitor.init(), []
    for a, b in pairwise([0, 1, 57, 3000, 9013, 9014, 9100, 11020, made.samples]):
        state, part = monitor.run(state.copy(), made.r[a:b], made.u[a:b], y[a:b], restart[a:b])
        statistics.append(part.statistic)
    np.testing.assert_array_equal(state, whole)
    np.testing.assert_array_equal(np.concatenate(statistics), trace.statistic)
    behind = (trace.t > 90.1) & (trace.t < 91.0)
    assert not trace.ready[behind].any()  # nobody knows how long the gap was, nor what the machine did in it
    assert trace.exceeded[trace.t > 95.0].all()  # what broke the course before it is remembered
    latest = monitor.latest(state)
    assert latest.exceeded.all() and latest.statistic[0] == trace.statistic[-1]
    assert len(state) < 600  # numbers


@pytest.mark.parametrize(("signal", "value"), [("y", 10.0), ("y", 1e9), ("u", 100.0)])
def test_a_sample_that_was_read_wrongly_is_forgotten(baseline: ss.Baseline, signal: str, value: float) -> None:
    """As losses it would warm the machine beyond all measure, and as a regressor outweigh all others."""
    made, monitor = minutes(71, 33.0, 18.0), ss.Monitor(baseline)
    read = {"r": made.r, "u": made.u.copy(), "y": made.y.copy()}
    read[signal][3000] = value
    with np.errstate(over="ignore", invalid="ignore"):
        state, trace = monitor.run(monitor.init(), *read.values(), made.restart)
    late = trace.t > 120.0
    assert trace.ready[late].all() and not trace.exceeded[late].any()
    _, clean, _ = follow(baseline, made)
    assert abs(monitor.covariate_history(state)[NAME][1][-1] - clean[NAME]) < 0.02


def test_the_last_minutes_are_compared_with_what_the_monitor_knows(baseline: ss.Baseline) -> None:
    """Alone, minutes behind the onset of a leak are those of a machine at another temperature."""
    made = minutes(73, 33.0, 18.0, LEAK)
    monitor, last = ss.Monitor(baseline), made.rows(slice(-2000, None))
    state, _ = monitor.run(monitor.init(), made.r, made.u, made.y, made.restart)
    blocks = [Block("rig", 0, BEGAN + last.t, last.r, last.u, last.y)]
    carried = carry_covariates(baseline.logged_covariates, blocks, monitor.covariate_history(state), BEGAN + last.t[-1])
    assert [one.covariates.shape for one in carried] == [(3, 2000)]
    assert examine_blocks(baseline, "rig", blocks).verdict != "fault"
    for found in (examine_blocks(baseline, "rig", carried), diagnose_blocks(baseline, "rig", carried)):
        assert found.verdict == "fault"


def hall(folder: Path, name: str, speed: float = 0.0) -> Path:
    path = folder / f"{name}.toml"
    path.write_text(
        f'name = "hall"\n[service]\nlisten = ""\ncommit_every_s = 0.01\nlog = "error"\n'
        f'[store]\nurl = "{name}.sqlite"\nresidual_every_s = 5.0\n[diagnosis]\nwindow_s = 20.0\nevery_s = 20.0\n'
        f'[sources.line]\nkind = "replay"\nblock = 0.5\nstart = 2026-01-01T00:00:00Z\nspeed = {speed}\n'
        '[assets.rig]\nsource = "line"\nbaseline = "baseline.json"\nfiles = ["day.csv"]\n'
    )
    return path


@pytest.fixture(scope="module")
def folder(baseline: ss.Baseline, tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("rig")
    baseline.save(made / "baseline.json")
    writers.write_recording(
        made / "day.csv", minutes(72, 33.0, 18.0, FaultEvent.parse("C_ie=1.1@50"), seconds=100.0), LOOP.columns
    )
    service_of(hall(made, "whole")).run()
    return made


@pytest.mark.slow
def test_a_service_knows_the_warmth_that_minutes_alone_do_not_tell(folder: Path) -> None:
    """The leak is older than the examined window at the end: by this window alone it would be another temperature."""
    config = folder / "whole.toml"
    verdicts = asked(config, "SELECT t, grounds, verdict, summary FROM diagnoses ORDER BY t, number")
    assert {verdict for t, _, verdict, _ in verdicts if t < BEGAN + 50.0} == {"healthy"}
    status = json.loads(dict(asked(config, "SELECT asset, status FROM checkpoints"))["rig"])
    assert status["verdict"] == "fault" and status["exceeded"]
    assert [fault["name"] for fault in status["faults"]] == ["leakage"]
    assert status["faults"][0]["ratio"] == pytest.approx(1.1, rel=0.03)
    assert BEGAN + 48.0 < status["onset"] < BEGAN + 52.0


@pytest.mark.slow
def test_a_service_that_is_stopped_goes_on_with_the_same_bits(folder: Path) -> None:
    config = hall(folder, "cut", speed=10.0)
    running = Running(service_of(config))
    until(lambda: asked(config, "SELECT count(*) FROM recent")[0][0] > 20)
    running.end(stop=True)
    service_of(hall(folder, "cut")).run()
    states = []
    for name in ("whole", "cut"):
        store = Store.open(f"{name}.sqlite", folder)
        states.append(unpack_state(store.checkpoints(["rig"])["rig"]["state"], "rig").monitor)
        store.close()
    np.testing.assert_array_equal(*states)
    for name, query in RESULTS.items():
        assert asked(config, query) == asked(folder / "whole.toml", query), name
