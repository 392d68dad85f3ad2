"""The documents do what they say: code blocks, examples and notebooks run, and commands are commands."""

from __future__ import annotations

import doctest
import json
import re
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import matplotlib.pyplot as plt
import numpy as np
import pytest
import typer.main
from commands import prepared
from documents import CodeBlock, code_blocks, command_lines, run_page
from sources import load

import servoscope as ss
from servoscope.arm.settings import ArmLoop
from servoscope.cli import app
from servoscope.models.loop import Loop
from servoscope.service.config import ServiceFile

PROJECT = Path(__file__).resolve().parents[2]
DOCS = PROJECT / "docs"
PAGES = [PROJECT / "README.md", PROJECT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
RUN = (
    "README.md",
    "tutorial.md",
    "from-matlab.md",
    "how-to/hydraulic-cylinder.md",
    "how-to/python.md",
    "how-to/trend.md",
)  # their Python is run, below
# Python that no page can run, and why: the page shows a part of somebody else's program
FRAGMENTS = {
    "fleet.md": "the frame is the reader's, in Spark; test_spark.py runs the call",
    "how-to/robot-arm.md": "the logs are the reader's; test_arm_diagnosis.py makes the calls",
    "how-to/actions.md": "a server of the reader's; test_actions.py checks the signature so",
    "how-to/drive.md": "the image comes from a drive; test_export.py goes there and back",
    "reference/messages.md": "the sender is the reader's; test_payload.py compares with it byte by byte",
}


@pytest.fixture(scope="module")
def tutorial(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of the tutorial after all its steps."""
    folder = tmp_path_factory.mktemp("tutorial")
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        assert run_page(DOCS / "tutorial.md", folder) > 15
    finally:
        for number, handler in handlers.items():  # the service sets its own
            signal.signal(number, handler)
    yield folder / "tutorial"


@pytest.mark.slow
class TestTutorial:
    """The tutorial, and what is built on its files."""

    def test_it_ends_with_a_report(self, tutorial: Path) -> None:
        assert (tutorial / "report.html").stat().st_size > 10_000

    def test_the_page_for_users_of_matlab(self, tutorial: Path) -> None:
        assert run_page(DOCS / "from-matlab.md", tutorial) == 2

    @pytest.mark.parametrize("name", [name for name in (*ss.__all__, "NoveltyDetector") if not name.startswith("_")])
    def test_the_examples_of_docstrings(self, name: str, tutorial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tutorial)
        plt.switch_backend("agg")
        thing = getattr(ss, name)
        names = {each: getattr(ss, each) for each in (*ss.__all__, name)} | {"ss": ss}
        runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
        for one in doctest.DocTestFinder().find(thing, name, globs=names):
            runner.run(one)
        plt.close("all")
        assert runner.failures == 0


@pytest.mark.slow
def test_the_page_for_users_of_python(tmp_path: Path) -> None:
    folder = tmp_path / "demo-output"
    folder.mkdir()
    assert run_page(DOCS / "how-to" / "python.md", prepared(folder)) >= 10
    shown = tmp_path / "README.md"  # its Python alone: its commands read a log of the reader's
    text = "".join(block.text for block in code_blocks(PROJECT / "README.md") if block.kind == "python")
    shown.write_text(f"```python\n{text}```\n\n```text\nfault (FaultEstimate(name='leakage', ...\n```\n")
    assert run_page(shown, tmp_path) == 2


def test_the_page_of_trends(tmp_path: Path) -> None:
    rows = [f"2026-01-{day:02},{1.0 + 0.01 * day + 0.002 * (day % 3)},0.004,{20 + day % 5}" for day in range(1, 31)]
    (tmp_path / "sizes.csv").write_text("\n".join(["time,leakage,std,temperature", *rows]) + "\n")
    names: dict[str, Any] = {}
    assert run_page(DOCS / "how-to" / "trend.md", tmp_path, names) == 1
    assert names["found"].remaining_s is not None


@pytest.mark.slow
def test_the_page_of_the_cylinder(tmp_path: Path) -> None:
    assert run_page(DOCS / "how-to" / "hydraulic-cylinder.md", tmp_path) == 3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["own-log", "motor-axis", "fleet", "robot-arm"])
def test_a_notebook_runs(name: str, tmp_path: Path) -> None:
    import nbformat
    from nbclient import NotebookClient

    book = nbformat.read(DOCS / "notebooks" / f"{name}.ipynb", as_version=4)
    assert [cell.id for cell in book.cells if cell.get("outputs")] == [], "outputs are not kept: they would go stale"
    NotebookClient(book, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    kinds = {kind for cell in book.cells for out in cell.get("outputs", ()) for kind in out.get("data", {})}
    assert "image/png" in kinds
    assert list(tmp_path.iterdir()) == []


def fragments(kind: str) -> list[tuple[str, CodeBlock]]:
    return [
        (page.relative_to(PROJECT).as_posix().removeprefix("docs/"), block)
        for page in PAGES
        for block in code_blocks(page)
        if block.kind == kind
    ]


def test_python_is_run_or_it_is_said_why_not() -> None:
    for name, block in fragments("python"):
        assert name in RUN or name in FRAGMENTS, f"{name}:{block.line}"


@pytest.mark.parametrize(("name", "block"), fragments("json"))
def test_json_is_json(name: str, block: CodeBlock) -> None:
    json.loads(block.text)


def is_read(settings: dict[str, Any]) -> bool:
    """Read a part of a loop file or of a service file, with what it leaves out; an error names what is wrong."""
    if settings.get("kind") == "arm":
        ArmLoop.from_dict(settings, "page")
        return True
    if settings.keys() <= Loop.model_fields.keys():
        inertia = {"kind": "polynomial", "order": 2, "friction": "coulomb"}
        Loop.from_dict({"sample_rate": 1000.0, "plant": inertia} | settings)
        return True
    if settings.keys() <= ServiceFile.model_fields.keys():
        replay = {"sources": {"bench": {"kind": "replay"}}}
        asset: dict[str, Any] = {
            "assets": {"press": {"baseline": "press.json", "source": "bench", "files": ["healthy.csv"]}}
        }
        for one in settings.get("sources", {}).values():
            if one.keys() == {"payload"}:  # of a source that the page shows further above
                one |= {"kind": "mqtt", "host": "broker.example"}
                asset["assets"]["press"] = {"baseline": "press.json", "source": "plant"}
        parts = {"name": "hall"} | (replay | asset if "assets" not in settings else {}) | settings
        ServiceFile.model_validate(parts)
        return True
    return False


@pytest.mark.parametrize(("name", "block"), fragments("toml"))
def test_toml_is_a_file_that_can_be_read(name: str, block: CodeBlock) -> None:
    settings = tomllib.loads(block.text)
    assert is_read(settings) or settings.keys() == {"broker", "replay", "assets"}, name  # of servoscope publish


def commands_of_pages() -> Iterator[tuple[str, list[str]]]:
    for page in PAGES:
        text = re.sub(r"\\\n *", "", page.read_text(encoding="utf-8"))
        lines = re.findall(r"^ {4}(servoscope .*)$", text, re.M)
        lines += [line for block in code_blocks(page) if block.kind == "sh" for line in block.text.splitlines()]
        for line in lines:
            # a form of a command has words in capitals; what is explained beside it stands behind spaces
            if line.startswith("servoscope ") and not re.search(r"[A-Z]{4,}|\.\.\.|\w  ", line.split("#")[0].strip()):
                yield from ((f"{page.name}: {line}", words) for words in command_lines(line))


@pytest.mark.parametrize(("where", "words"), list(commands_of_pages()))
def test_a_command_of_a_page_is_one(where: str, words: list[str]) -> None:
    words = words[1 : words.index(">")] if ">" in words else words[1:]
    command: Any = typer.main.get_command(app)
    context = click.Context(command, info_name="servoscope")
    while isinstance(command, click.Group) and words and not words[0].startswith("-"):
        found = command.get_command(context, words[0])
        assert found is not None, where
        command, words = found, words[1:]
    if "--help" not in words and "--version" not in words:
        command.make_context("servoscope", list(words), resilient_parsing=False)


def test_a_page_that_says_something_else_fails(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("```python\nprint(1)\n```\n\n```text\n2\n```\n")
    with pytest.raises(AssertionError, match=r"page\.md:5: the page says"):
        run_page(page, tmp_path)


def test_the_page_from_docstrings_is_written_anew() -> None:
    api = load(PROJECT / "scripts" / "api.py")
    assert api.render() == api.PAGE.read_text(encoding="utf-8"), "scripts/api.py --write"
    shown = api.formatted(
        "One.\n\nParameters\n----------\na\n    What it\n    is.\n\nRaises it.\n\nExamples\n--------\n>>> 1\n1"
    )
    assert (
        shown == "One.\n\n**Parameters**\n\n- `a`: What it is.\n\nRaises it.\n\n**Examples**\n\n```pycon\n>>> 1\n1\n```"
    )


def test_what_a_user_writes_is_typed(tmp_path: Path) -> None:
    example = tmp_path / "example.py"
    example.write_text(
        "import numpy as np\nimport servoscope as ss\n\n\n"
        "def first_alarm(baseline: ss.Baseline, recording: ss.Recording) -> float | None:\n"
        "    monitor = ss.Monitor(baseline)\n"
        "    _, trace = monitor.run(monitor.init(), recording.r, recording.u, recording.y)\n"
        "    return float(trace.t[trace.exceeded][0]) if trace.exceeded.any() else None\n\n\n"
        'loop = ss.Loop.load("loop.toml")\n'
        'baseline = ss.learn(loop, [ss.read("healthy.csv", loop), "other.csv"])\n'
        'diagnosis: ss.Diagnosis = ss.diagnose(baseline, {"t": np.arange(9.0)})\n'
        "sizes: list[float] = [fault.ratio for fault in diagnosis.faults]\n"
        'print(first_alarm(baseline, ss.read("x.csv", loop)), sizes, ss.plot(baseline)[0].figure)\n'
    )
    argv = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(PROJECT / ".mypy_cache")]
    wrong = tmp_path / "wrong.py"
    wrong.write_text('import servoscope as ss\n\nss.diagnose(3, "x.csv")\n')
    done = subprocess.run([*argv, example, wrong], cwd=PROJECT, capture_output=True, text=True, check=False)
    # mypy remembers what it said of the same lines in the folder of an earlier run
    assert re.findall(r"(\w+\.py):\d+: error: .*\[(.*)\]$", done.stdout, re.M) == [(wrong.name, "call-overload")], (
        done.stdout
    )


def test_the_tutorials_logs_are_the_same_each_time() -> None:
    from servoscope.simulation.tutorial import HEADER, tutorial_log

    log = tutorial_log("friday")
    assert log.startswith(HEADER) and log == tutorial_log("friday")
    t, *_, u = np.loadtxt(log.splitlines()[3:], delimiter=";").T
    assert len(t) == 12_000 and t[-1] == 59_995 and 3.0 < u.std() < 8.0
