"""What all tests share: the recordings beside the project, the reference rig, and how strictly tests run.

REQUIRE_ALL=1 turns every skipped test into a failed one, so that a run meant to be complete is.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import hypothesis
import pytest
import sqlalchemy as sa
from reliability.servers import Postgres, programs
from shares import Share

from servoscope.cli import progress
from servoscope.service.store import Store, tables

pytest_plugins = ("opening",)  # the browser, and what stands before it
PROJECT = Path(__file__).resolve().parent.parent

hypothesis.settings.register_profile("servoscope", derandomize=True, deadline=None, max_examples=50)
hypothesis.settings.load_profile("servoscope")


progress.LINE_INTERVAL_S = 3600.0  # what a command says on stderr must not depend on how fast the machine is
# one cache of compiled kernels for all workers and subprocesses
os.environ.setdefault("NUMBA_CACHE_DIR", str(PROJECT / ".cache" / "numba"))


# Subjects whose files of tests take longest: they begin first, so that no worker has one left when the others are done.
LONGEST = (
    "spark",
    "web_pages",
    "web_schema",
    "web_files",
    "web_access",
    "documents",
    "figures",
    "service",
    "opcua_restarts",
    "web_relearn",
    "web",
    "web_situations",
    "shards",
    "axis_payload",
    "report",
    "reliability",
    "web_action",
    "source_contract",
    "hostile",
    "learning",
    "secrets_service",
    "arm_diagnosis",
    "reload",
    "refinement",
    "metamorphic",
    "opcua",
    "release",
    "estimator_peers",
    "signals",
    "likelihood",
    "cli",
    "innovations",
    "turns",
    "labelled",
    "estimators",
    "paper",
    "eha_cases",
    "export",
    "points",
    "lake",
    "compatibility",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files of tests first."""
    ranks = {f"test_{subject}": rank for rank, subject in enumerate(LONGEST)}
    items.sort(key=lambda item: ranks.get(item.path.stem, len(ranks)))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Under REQUIRE_ALL=1, report a skipped test as failed, with the reason of the skip."""
    report = yield
    if report.skipped and not hasattr(report, "wasxfail") and os.environ.get("REQUIRE_ALL") == "1":
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        report.outcome = "failed"
        report.longrepr = f"{item.nodeid}: nothing may be skipped under REQUIRE_ALL=1, but: {reason}"
    return report


@pytest.fixture(scope="session")
def project() -> Path:
    """The folder with pyproject.toml."""
    return PROJECT


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder ``../shared/data``: simulated and measured recordings that are not part of the project."""
    folder = PROJECT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the recordings in ../shared/data are not on this machine")
    return folder


@pytest.fixture(scope="session")
def eha_cases(shared_data: Path) -> Path:
    """The folder of 60 s recordings of the rig, by an independent simulator; faults start at 30 s."""
    return shared_data / "eha_cases"


@pytest.fixture(scope="session")
def eha_truth(eha_cases: Path) -> dict[str, dict[str, Any]]:
    """What was injected into each of them: file name -> {"reference", "fault_at_s", "ratios", ...}."""
    return {case["file"]: case for case in json.loads((eha_cases / "truth.json").read_text())}


@pytest.fixture(scope="module")
def postgres() -> Iterator[Postgres]:
    """A PostgreSQL server of the module's own."""
    found = programs()
    if found is None:
        pytest.skip("PostgreSQL is not on this machine: scripts/install-test-servers installs it")
    server = Postgres.temporary(found)
    server.start()
    yield server
    server.remove()


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """Where a store may be made: on either database."""
    if request.param == "sqlite":
        yield str(tmp_path / "history.sqlite")
        return
    server: Postgres = request.getfixturevalue("postgres")
    yield server.url
    engine = sa.create_engine(server.url.replace("postgresql", "postgresql+psycopg"))
    tables.METADATA.drop_all(engine)
    engine.dispose()


@pytest.fixture
def store(url: str) -> Iterator[Store]:
    """An empty store."""
    opened = Store.open(url, write=True)
    yield opened
    opened.close()


@pytest.fixture
def share(tmp_path: Path) -> Iterator[Callable[..., Share]]:
    """Makes folders of logs with a source each, which is closed at the end."""
    made: list[Share] = []

    def make(*assets: str, **settings: Any) -> Share:
        made.append(Share(tmp_path / str(len(made)), *assets, **settings))
        return made[-1]

    yield make
    for one in made:
        if one.source is not None:
            one.source.close()


@pytest.fixture
def rig() -> dict[str, Any]:
    """A fresh loop file, as a mapping, of the rig behind `eha_cases`; a test may change it."""
    return {
        "name": "reference rig",
        "sample_rate": 100.0,
        "plant": {
            "kind": "eha",
            "m_p": 4.0,
            "b_p": 200.0,
            "k_p": 4.0 * (2.0 * math.pi * 13.0) ** 2,  # without oil, the mass would swing at 13 Hz
            "A_p": 4e-4,
            "V_o": 1e-4,
            "beta": 1e9,
            "C_ie": 6e-12,
            "p_s": 14e6,
            "rho": 850.0,
            "C_d": 0.6,
            "W": 0.02,
            "K_m": 1e-3,
        },
        "controller": {"kind": "pi", "k_p": 20.0, "k_i": 5.0},
    }
