"""The benchmark of the chain: a small run finds all figures, and peers agree."""

from __future__ import annotations

import pytest
from speed import chain
from tools.timing import JobTiming, time_interleaved

FIGURES = (
    "log, NumPy",
    "log, bare",
    "log, everything",
    "log, bare, with a FIR of 40",
    *(
        f"fleet of 100, {precision}, {what}{cores}"
        for precision in ("double", "single")
        for what in ("bare", "everything")
        for cores in ("", ", 1 core")
    ),
    *(f"service, {layer}" for layer in ("decode", "assemble", "quality", "kernel", "judge", "store", "publish")),
    "Kalman filter, servoscope",
    "Kalman filter, numpy loop",
    "least squares, servoscope",
)
FILTERPY = "filterpy's update over a fleet's sample, everything, one core"
FACTS = (
    "peak multiply-adds per ns, one core, double",
    "memory, GB/s read and written, one core",
    "bits of a vector (256: AVX2, 512: AVX-512)",
    "one step from Python, us, median",
    "one step from Python, us, 99.9 %",
    "state of an asset, bytes",
    "scaling of a fleet over cores, share of the ideal",
    "processor time of a fleet on one core, share of that on all",
    "cores",
    FILTERPY,
    "100 simulations of 60 s, s",
    "100 simulations followed as a fleet, s",
    "alarms among those with a leak, share",
    "alarms among the healthy, share",
)


@pytest.mark.slow
def test_a_small_run_of_the_chain_finds_every_figure_and_peers_that_agree() -> None:
    result = chain.run_benchmarks(1, share=0.01)
    figures = {figure.name: figure for figure in result.figures}
    assert set(FIGURES) <= set(figures) and tuple(result.facts) == FACTS
    for name, figure in figures.items():
        median, low, high = figure.ns
        assert 0.0 < low <= median <= high and figure.processor > 0.0, name
        assert (figure.ratio is None) == (figure.to == ""), name
        assert figure.error is None or figure.error < 1e-9, name
    spent = [
        figures[name].processor for name in ("Kalman filter, filterpy", "fleet of 100, double, everything, 1 core")
    ]
    assert result.facts[FILTERPY] == pytest.approx(spent[0] / spent[1])
    assert {name for name, figure in figures.items() if figure.error is not None} >= {*FIGURES[-3:], FIGURES[1]}
    assert all(number >= 0.0 for number in result.facts.values())
    assert len(result.table().rows) == len(figures)


def test_jobs_take_turns() -> None:
    turns: list[str] = []
    found = time_interleaved({name: lambda name=name: turns.append(name) for name in "ab"}, 3)  # type: ignore[misc]
    assert "".join(turns) == "abababab"  # once uncounted, then three times
    assert all(isinstance(each, JobTiming) and each.low <= each.median <= each.high for each in found.values())
