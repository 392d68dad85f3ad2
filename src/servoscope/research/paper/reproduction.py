"""The reproduction as files: every figure as PNG and SVG, the claims as JSON and Markdown; jobs over the cores."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from servoscope.core.files import atomic_write, make_folder
from servoscope.core.workers import WorkerError, Workers
from servoscope.estimation.kernel.threads import core_count
from servoscope.research.paper import claims, jobs
from servoscope.research.paper.claims import Claim
from servoscope.research.paper.jobs import SeedJob

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".svg")
DRAWINGS = ("figure-1", "figure-3")  # files of this package: the actuator, and the diagnostic around its loop
FIGURE_COUNT = 17  # drawings and figures
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

StepCallback = Callable[[str], None]


@dataclass(frozen=True)
class Reproduction:
    """What came out."""

    seeds: tuple[int, ...]  # that were run
    metrics: dict[str, list[float]]  # name -> one value per seed
    claims: tuple[Claim, ...]

    def to_dict(self) -> dict[str, object]:
        """Return seeds and claims, ready for JSON."""
        return {"seeds": list(self.seeds), "claims": [claim.to_dict() for claim in self.claims]}


def reproduce(
    seeds: int = 1, output: Path | str | None = None, *, progress: StepCallback = lambda _: None
) -> Reproduction:
    """Reproduce the source paper: measure each of its claims on simulated data, as ``servoscope reproduce`` does.

    Parameters
    ----------
    seeds
        Realisations of the noise, at least 1; each takes some twenty seconds of processor time.
    output
        Folder for figures and claims; without one nothing is written.
    progress
        Takes the name of each step that is done.

    Returns
    -------
    Reproduction
        ``claims``, each with ``claim``, ``measured`` and ``verdict``, and ``metrics``, one value per seed.

    Raises
    ------
    ValueError
        If there is no seed.
    OutputError
        If the folder or a file cannot be written.

    Examples
    --------
    >>> paper = ss.reproduce()  # doctest: +SKIP
    >>> [claim.verdict for claim in paper.claims]  # doctest: +SKIP
    """
    if seeds < 1:
        raise ValueError(f"seeds: is {seeds}, but at least 1 is needed")
    reproduction = run_reproduction(range(1, seeds + 1), progress)
    if output is not None:
        write_reproduction(reproduction, Path(output), progress)
    return reproduction


def run_reproduction(seeds: Sequence[int], told: StepCallback = lambda _: None) -> Reproduction:
    """Measure everything, on all cores; `told` takes the name of each job that is done."""
    work = jobs.list_jobs(seeds)
    done: list[tuple[SeedJob, dict[str, float]]] = []
    for job, outcome in run_jobs(work, min(core_count(), len(work))):
        done.append((job, outcome))
        told(f"seed {job.seed}, {job.part}")
    metrics = jobs.merge_metrics(done)
    return Reproduction(tuple(seeds), metrics, tuple(claims.evaluate_claims(metrics)))


def run_jobs(work: Sequence[SeedJob], processes: int) -> Iterator[tuple[SeedJob, dict[str, float]]]:
    """Yield each job with what it measured, as they are done, on so many processes."""
    pool = Workers(environment={**os.environ, **dict.fromkeys(ONE_THREAD, "1")})
    for job, outcome in pool.map(f"{__name__}:run_in_worker", work, processes):
        if isinstance(outcome, WorkerError):
            raise outcome
        yield job, outcome


def run_in_worker(_: StepCallback, job: SeedJob) -> dict[str, float]:
    """Do one job in a worker."""
    return jobs.run_job(job)


def list_figures(reproduction: Reproduction) -> Iterator[tuple[str, Callable[[], Figure]]]:
    """Yield the name of each figure and what draws it: for the paper's method, and for the default on the same data."""
    from servoscope.research.paper import charts, figures
    from servoscope.research.paper.table import table_2_residuals

    seed, metrics = reproduction.seeds[0], reproduction.metrics
    yield "figure-2", figures.figure_2
    yield "figure-4", lambda: figures.figure_4(seed)
    for version in figures.METHODS:
        method = figures.METHODS[version][-1]
        yield f"figure-5-{version}", partial(figures.figure_5, seed, version)
        yield f"figure-6-{version}", partial(figures.figure_6, seed, version)
        yield f"figure-7-{version}", partial(figures.figure_7, table_2_residuals(method, seed))
        yield f"figure-8-{version}", partial(figures.figure_8, metrics, version)
    yield "trade-off", lambda: charts.draw_trade_off(metrics)
    yield "conditions", lambda: charts.draw_conditions(metrics)
    yield "windup", lambda: charts.draw_windup(seed)
    yield "stability", charts.draw_poles
    yield "fault-tolerance", lambda: charts.draw_tolerance(seed)


def write_reproduction(reproduction: Reproduction, folder: Path, told: StepCallback = lambda _: None) -> list[Path]:
    """Write all figures and the table of claims; return the files.

    Raises OutputError if the folder or a file cannot be written.
    """
    from servoscope.report.plotting import save_figure

    make_folder(folder)
    written = []
    for name in DRAWINGS:
        for suffix in SUFFIXES:
            written.append(folder / f"{name}{suffix}")
            atomic_write(written[-1], files(__package__).joinpath(written[-1].name).read_bytes())
        told(name)
    for name, draw in list_figures(reproduction):
        figure = draw()
        for suffix in SUFFIXES:
            save_figure(figure, folder / f"{name}{suffix}")
            written.append(folder / f"{name}{suffix}")
        told(name)
    content = json.dumps(reproduction.to_dict(), indent=1, allow_nan=False) + "\n"
    atomic_write(folder / "claims.json", content.encode())
    atomic_write(folder / "claims.md", claims.format_markdown(reproduction.claims, len(reproduction.seeds)).encode())
    return [*written, folder / "claims.json", folder / "claims.md"]
