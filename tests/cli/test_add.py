"""`servoscope add` writes a machine into a service file, and nothing where something is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest
from commands import one_line, prepared, run

from servoscope.service.config import ServiceFile


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepared(tmp_path_factory.mktemp("add"))


def test_a_machine_goes_into_a_service_file_whose_comments_stay(folder: Path, tmp_path: Path) -> None:
    config, baseline, log = tmp_path / "hall.toml", folder / "baseline.json", folder / "suspect.csv"
    made = run("add", config, "press", baseline, "--file", log)
    assert made.code == 0 and f"servoscope run {config}" in made.out
    config.write_text(
        "# the hall\n" + config.read_text(encoding="utf-8") + "group = 'a'  # of press\n", encoding="utf-8"
    )
    first = config.read_text(encoding="utf-8")
    assert run("add", config, "lathe", baseline, "--file", log, "--file", log, "--group", "b").code == 0
    assert config.read_text(encoding="utf-8").startswith(first)
    settings = ServiceFile.load(config)
    assert {name: (asset.source, asset.group) for name, asset in settings.assets.items()} == {
        "press": ("recordings", "a"),
        "lathe": ("recordings", "b"),
    }
    assert run("run", config, "--check").code == 0


def test_what_is_wrong_is_one_line_and_leaves_the_file_as_it_was(folder: Path, tmp_path: Path) -> None:
    config, baseline, log = tmp_path / "hall.toml", folder / "baseline.json", folder / "suspect.csv"
    assert run("add", config, "press", baseline, "--file", log).code == 0
    before = config.read_bytes()
    one_line(run("add", config, "press", baseline, "--file", log), "hall.toml", "'press' already", "another name")
    one_line(run("add", config, "mill", baseline, "--source", "line"), "no source 'line'", "recordings")
    one_line(run("add", config, "mill", tmp_path / "none.json", "--file", log), "none.json", "no such file")
    one_line(run("add", config, "a mill", baseline, "--file", log), "'a mill' is no name")
    assert run("add", config, "mill", baseline).code == 2
    assert config.read_bytes() == before
