"""The reproduction as files: every figure as PNG and SVG, the claims as JSON and Markdown; jobs over the cores."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from servoscope.output import atomic_write, make_folder
from servoscope.paper import claims, measures
from servoscope.paper.claims import Claim
from servoscope.paper.measures import Job

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".svg")
DRAWINGS = 17  # figures that are drawn
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

Told = Callable[[str], None]


@dataclass(frozen=True)
class Reproduction:
    """What came out.

    Parameters
    ----------
    seeds
        That were run.
    metrics
        Name -> one value per seed.
    claims
        The table.
    """

    seeds: tuple[int, ...]
    metrics: dict[str, list[float]]
    claims: tuple[Claim, ...]

    def to_dict(self) -> dict[str, object]:
        """Return seeds and claims, ready for JSON."""
        return {"seeds": list(self.seeds), "claims": [claim.to_dict() for claim in self.claims]}


def run(seeds: Sequence[int], told: Told = lambda _: None, processes: int | None = None) -> Reproduction:
    """Measure everything.

    Parameters
    ----------
    seeds
        One or more.
    told
        Told the name of each job that is done.
    processes
        None: one per core.
    """
    work = measures.jobs(seeds)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = min(cores if processes is None else processes, len(work))
    done: list[tuple[Job, dict[str, float]]] = []
    for job, found in results(work, count):
        done.append((job, found))
        told(f"seed {job.seed}, {job.part}")
    metrics = measures.gather(done)
    return Reproduction(tuple(seeds), metrics, tuple(claims.claims(metrics)))


def results(work: Sequence[Job], processes: int) -> Iterator[tuple[Job, dict[str, float]]]:
    """Yield each job with what it measured, as they are done, on so many processes."""
    if processes <= 1:
        yield from ((job, measures.work(job)) for job in work)
        return
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor, as_completed

    # fresh processes: a fork would inherit the threads of whatever the caller runs
    with (
        _one_thread_each(),
        ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool,
    ):
        futures = {pool.submit(measures.work, job): job for job in work}
        for future in as_completed(futures):
            yield futures[future], future.result()


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Let processes that start within use one thread for linear algebra each: more only get into each other's way."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def drawings(found: Reproduction) -> Iterator[tuple[str, Callable[[], Figure]]]:
    """Yield the name of each figure and what draws it: for the paper's method, and for the default on the same data."""
    from servoscope.paper import charts, figures
    from servoscope.paper.drawings import figure_1, figure_3
    from servoscope.paper.table import residuals

    seed, metrics = found.seeds[0], found.metrics
    yield "figure-1", figure_1
    yield "figure-2", figures.figure_2
    yield "figure-3", figure_3
    yield "figure-4", lambda: figures.figure_4(seed)
    for version in figures.METHODS:
        method = figures.METHODS[version][-1]
        yield f"figure-5-{version}", partial(figures.figure_5, seed, version)
        yield f"figure-6-{version}", partial(figures.figure_6, seed, version)
        yield f"figure-7-{version}", partial(figures.figure_7, residuals(method, seed))
        yield f"figure-8-{version}", partial(figures.figure_8, metrics, version)
    yield "trade-off", lambda: charts.trade_off(metrics)
    yield "conditions", lambda: charts.over_conditions(metrics)
    yield "windup", lambda: charts.windups(seed)
    yield "stability", charts.poles
    yield "fault-tolerance", lambda: charts.tolerant(seed)


def write(found: Reproduction, folder: Path, told: Told = lambda _: None) -> list[Path]:
    """Write all figures and the table of claims; return the files.

    Raises
    ------
    OutputError
        If the folder or a file cannot be written.
    """
    from servoscope.report.canvas import save

    make_folder(folder)
    written = []
    for name, draw in drawings(found):
        figure = draw()
        for suffix in SUFFIXES:
            save(figure, folder / f"{name}{suffix}")
            written.append(folder / f"{name}{suffix}")
        told(name)
    content = json.dumps(found.to_dict(), indent=1, allow_nan=False) + "\n"
    atomic_write(folder / "claims.json", content.encode())
    atomic_write(folder / "claims.md", claims.markdown(found.claims, len(found.seeds)).encode())
    return [*written, folder / "claims.json", folder / "claims.md"]
