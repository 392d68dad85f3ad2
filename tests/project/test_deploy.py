"""The files of `deploy/`: a container, a composition of them, a unit of systemd; checked by their own tools."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from servoscope.service.config import ServiceFile

HARDENED = 20  # of 100 that `systemd-analyze security` counts at most: 92 where nothing is restricted


@pytest.fixture(scope="module")
def folder(project: Path) -> Path:
    return project / "deploy"


@pytest.fixture(scope="module")
def composition(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((folder / "compose.yaml").read_text())
    return found


def is_exact(image: str) -> bool:
    """Tell whether an image is named with its registry and a version that no later one replaces."""
    return re.fullmatch(r"[\w.]+\.\w+/[\w./-]+:\d+(\.\d+)+[\w.-]*", image) is not None


def instructions(folder: Path) -> list[tuple[str, str]]:
    """Return the instructions of the container file, lines that go on joined."""
    text = re.sub(r"\\\n\s*", "", (folder / "Containerfile").read_text())
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    return [(word, rest) for word, _, rest in (line.partition(" ") for line in lines)]


def test_hadolint_has_nothing_to_say_of_the_container(folder: Path) -> None:
    program = Path(sys.executable).parent / "hadolint"
    done = subprocess.run([program, folder / "Containerfile"], capture_output=True, text=True)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


def test_the_container_is_exact_and_runs_as_nobody_in_particular(folder: Path, project: Path) -> None:
    found = instructions(folder)
    bases = [rest.split()[0] for word, rest in found if word == "FROM"]
    assert len(bases) == 2 and all(map(is_exact, bases))
    (user,) = [rest for word, rest in found if word == "USER"]
    assert all(int(part) > 0 for part in user.split(":"))
    assert any(word == "HEALTHCHECK" and "/health/live" in rest for word, rest in found)
    (install,) = [rest for word, rest in found if "requirements.lock" in rest and word == "RUN"]
    assert "--require-hashes" in install and "--only-binary=:all:" in install
    # what the build needs is not left out of what is sent to it
    kept = set(re.findall(r"^!(\S+)", (project / ".dockerignore").read_text(), flags=re.MULTILINE))
    for name in ("src", "pyproject.toml", "hatch_build.py", "requirements.lock", "README.md", "docs"):
        assert name in kept and (project / name).exists()


def test_the_composition_is_exact_healthy_and_closed(composition: dict[str, Any]) -> None:
    services = composition["services"]
    assert set(services) == {"broker", "database", "service"}
    for name, one in services.items():
        assert "build" in one or (is_exact(one["image"]) and "healthcheck" in one), name
        assert all(port.startswith("127.0.0.1:") for port in one.get("ports", ())), name
        assert set(one.get("secrets", ())) <= set(composition["secrets"])
        for volume in one.get("volumes", ()):
            source = volume.partition(":")[0]
            assert source.startswith((".", "/")) or source in composition["volumes"]
    assert services["service"]["build"]["dockerfile"] == "deploy/Containerfile"
    assert services["service"]["depends_on"] == {
        name: {"condition": "service_healthy"} for name in ("broker", "database")
    }
    assert services["service"]["read_only"] and services["service"]["cap_drop"] == ["ALL"]


def test_the_service_file_of_the_composition_leads_to_its_services(folder: Path, composition: dict[str, Any]) -> None:
    config = ServiceFile.load(folder / "hall.toml")
    hosts = {config.sources["plant"].host, config.outlets["plant"].host}  # type: ignore[attr-defined]
    database = re.fullmatch(r"postgresql://(\w+)@(\w+)/(\w+)", config.store.url)
    assert hosts == {"broker"} and database is not None
    user, host, name = database.groups()
    settings = composition["services"][host]["environment"]
    assert (settings["POSTGRES_USER"], settings["POSTGRES_DB"]) == (user, name)
    assert config.web is not None and config.web.users
    (state,) = [
        one.partition(":")[2] for one in composition["services"]["service"]["volumes"] if one.startswith("state:")
    ]
    assert config.web.folder.startswith(f"{state}/")
    ports = {port.rpartition(":")[2] for port in composition["services"]["service"]["ports"]}
    assert ports == {config.service.listen.rpartition(":")[2], config.web.listen.rpartition(":")[2]}


def test_systemd_accepts_the_unit_and_finds_it_closed(folder: Path, tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not on this machine: scripts/install-test-servers installs it")
    unit = tmp_path / "servoscope.service"
    text = (folder / "servoscope.service").read_text()
    unit.write_text(re.sub(r"(?<=^ExecStart=)\S+", sys.executable, text, flags=re.MULTILINE))
    for words in (("verify",), ("security", "--offline=true", f"--threshold={HARDENED}")):
        done = subprocess.run(
            ["systemd-analyze", *words, unit], capture_output=True, text=True, env=os.environ | {"SYSTEMD_PAGER": ""}
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert words[0] == "security" or not done.stderr
    # a transaction of the store may take a minute, and the service says that it is alive between two of them
    (watchdog,) = re.findall(r"^WatchdogSec=(\d+)$", text, flags=re.MULTILINE)
    assert int(watchdog) > 60
