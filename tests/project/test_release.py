"""What a release is made of: a wheel of the same bytes whoever builds it, locked packages with hashes, their bill."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

BUILD = "import hatchling.build, sys; print(hatchling.build.build_wheel(sys.argv[1]))"
BUILD_SOURCE = "import hatchling.build, sys; print(hatchling.build.build_sdist(sys.argv[1]))"


def pinned(path: Path) -> dict[str, str]:
    """Return the version of each package of a lock file."""
    found = re.findall(r"^([\w.-]+)==([^\s;]+)", path.read_text(), re.MULTILINE)
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in found}


def build(source: Path, folder: Path, umask: int, seconds: int) -> Path:
    """Return the wheel of a copy of the source whose files have another time and other permissions."""
    for name in ("src", "docs"):
        shutil.copytree(source / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "site"))
    for name in ("pyproject.toml", "hatch_build.py", "README.md", "LICENSE"):
        shutil.copy(source / name, folder)
    for path in folder.rglob("*"):
        os.utime(path, (seconds, seconds))
        path.chmod(path.stat().st_mode & ~umask)
    environment = {name: value for name, value in os.environ.items() if name != "SOURCE_DATE_EPOCH"}
    argv = [sys.executable, "-c", BUILD, str(folder / "dist")]
    done = subprocess.run(argv, cwd=folder, env=environment | {"TZ": "Asia/Tokyo"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "dist" / done.stdout.strip().splitlines()[-1]


@pytest.fixture(scope="module")
def wheel(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel; it is only built if no page has a link that leads nowhere, and no page is missing in index.md."""
    return build(project, tmp_path_factory.mktemp("one"), 0, 1_700_000_000)


@pytest.mark.slow
def test_two_builds_have_the_same_bytes(project: Path, wheel: Path, tmp_path: Path) -> None:
    other = build(project, tmp_path, 0o077, 1_800_000_000)
    assert hashlib.sha256(wheel.read_bytes()).hexdigest() == hashlib.sha256(other.read_bytes()).hexdigest()


@pytest.mark.slow
def test_a_wheel_brings_the_site_which_asks_for_nothing_from_outside(
    project: Path, wheel: Path, tmp_path: Path
) -> None:
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path)
    site = tmp_path / "servoscope" / "site"
    pages = {path.relative_to(project / "docs").with_suffix(".html") for path in (project / "docs").rglob("*.md")}
    found = {path.relative_to(site) for path in site.rglob("*.html")}
    assert found - pages == {Path("genindex.html"), Path("search.html")} and pages <= found
    loads = re.compile(
        r"<(?:script|img|iframe)[^>]*\ssrc=\"([^\"]*)|<link[^>]*rel=\"(?:stylesheet|preload)[^>]*href=\"([^\"]*)"
    )
    for page in found:
        wanted = ["".join(one) for one in loads.findall((site / page).read_text())]
        assert wanted and all((site / page.parent / one.split("?")[0]).exists() for one in wanted), page
    styles = "".join(path.read_text() for path in site.rglob("*.css"))
    assert not re.search(r"@import[^;]*//|url\([\"']?(?:https?:)?//", styles)
    assert "leakag" in (site / "searchindex.js").read_text()  # what the search knows, by stems
    # without the site, the command says how to get it; with it, where it is
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    argv = [sys.executable, "-m", "servoscope", "docs"]
    there = subprocess.run(argv, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert Path(there.stdout.strip()) == site / "index.html", there.stderr
    (site / "index.html").unlink()
    gone = subprocess.run(argv, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert gone.returncode == 1 and "make docs" in gone.stderr


@pytest.mark.slow
def test_wheel_and_source_archive_are_installed_and_run(project: Path, wheel: Path, tmp_path: Path) -> None:
    """A fresh environment: packages that servoscope needs are those of the tests, servoscope is that of the wheel."""
    argv = [sys.executable, "-c", BUILD_SOURCE, str(tmp_path)]
    name = subprocess.run(argv, cwd=project, check=True, capture_output=True, text=True).stdout.split()[-1]
    with tarfile.open(tmp_path / name) as archive:
        archive.extractall(tmp_path, filter="data")
    other = build(tmp_path / name.removesuffix(".tar.gz"), tmp_path / "other", 0, 1_700_000_000)
    assert hashlib.sha256(other.read_bytes()).hexdigest() == hashlib.sha256(wheel.read_bytes()).hexdigest()
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "env"], check=True)
    python = tmp_path / "env" / "bin" / "python"
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    packages = tmp_path / "env" / "lib" / version / "site-packages"
    (packages / "tested.pth").write_text(sysconfig.get_path("purelib") + "\n")
    install = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*install, "--ignore-installed", other], check=True)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def run(*words: str | Path) -> str:
        done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert run(python, "-c", "import servoscope; print(servoscope.__file__)").startswith(str(packages))
    command = python.with_name("servoscope")
    assert run(command, "--version").split() == ["servoscope", version_of(project)]
    run(command, "tutorial")
    assert "Usable" in run(command, "init", "tutorial/monday.csv", "--yes")


def version_of(project: Path) -> str:
    """Return the version, from the only place that says it."""
    (version,) = re.findall(r'^__version__ = "(.+)"', (project / "src/servoscope/__init__.py").read_text(), re.M)
    return str(version)


def test_every_version_that_is_named_has_its_section(project: Path) -> None:
    changes = (project / "CHANGELOG.md").read_text(encoding="utf-8")
    sections = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - \d{4}-\d\d-\d\d$", changes, re.M)
    assert sections[0] == version_of(project) and len(set(sections)) == len(sections)
    assert f"version: {sections[0]}\n" in (project / "CITATION.cff").read_text(encoding="utf-8")
    assert f"servoscope-{sections[0]}-py3" in (project / "README.md").read_text(encoding="utf-8")
    named = set(re.findall(r"\bversion (\d+\.\d+(?:\.\d+)?)\b", changes))
    assert all(any(f"{section}.".startswith(f"{name}.") for section in sections) for name in named)


def test_wheels_are_built_with_the_tested_makers_of_pages(project: Path) -> None:
    settings = tomllib.loads((project / "pyproject.toml").read_text())
    extra, requires = settings["project"]["optional-dependencies"]["docs"], settings["build-system"]["requires"]
    assert set(extra) <= set(requires) and not [each for each in requires if each.startswith(("numba", "llvmlite"))]
    assert dict(each.split("==") for each in extra).items() <= pinned(project / "requirements-dev.lock").items()


def test_a_container_installs_what_the_tests_run_with_and_nothing_without_a_hash(project: Path) -> None:
    text = (project / "requirements.lock").read_text()
    ours, tested = pinned(project / "requirements.lock"), pinned(project / "requirements-dev.lock")
    assert ours.items() <= tested.items()
    entries = re.split(r"\n(?=[\w.-]+==)", text)[1:]
    assert len(entries) == len(ours) and all("--hash=sha256:" in entry for entry in entries)
    settings = tomllib.loads((project / "pyproject.toml").read_text())["project"]
    names = "service", "web", "mqtt", "opcua", "mdf", "tdms"
    extras = [settings["optional-dependencies"][name] for name in names]
    wanted = {re.split(r"[\[>=<]", one)[0].lower() for one in sum(extras, settings["dependencies"])} - {"servoscope"}
    assert wanted <= set(ours)


def test_the_bill_of_materials_has_every_package_with_its_hashes(project: Path) -> None:
    spec = importlib.util.spec_from_file_location("sbom", project / "scripts" / "sbom.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    bill = json.loads(json.dumps(module.bill(project)))
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.5")
    found = {one["name"]: one["version"] for one in bill["components"]}
    assert found == pinned(project / "requirements.lock")
    assert all(one["externalReferences"][0]["hashes"] for one in bill["components"])
    known = {one["bom-ref"] for one in bill["components"]}
    assert set(bill["dependencies"][0]["dependsOn"]) == known and len(known) == len(found)
    assert sum("licenses" in one for one in bill["components"]) > 0.9 * len(found)


def test_no_locked_package_has_a_known_hole_and_one_that_has_is_found(project: Path, tmp_path: Path) -> None:
    def audit(*more: str) -> tuple[int, str]:
        argv = [sys.executable, project / "scripts" / "audit.py", *more]
        done = subprocess.run(argv, capture_output=True, text=True)
        return done.returncode, done.stdout + done.stderr

    assert audit()[0] == 0, audit()[1]
    locks = {
        "requirements.lock": "h11==0.15.0 \\\n    --hash=sha256:0\n",
        "requirements-dev.lock": "a_b==2.0rc1\nc==1.0\n",
    }
    for name, text in locks.items():
        (tmp_path / name).write_text(f"# locked\n{text}")
    own = {"package": {"ecosystem": "PyPI", "name": "A.B"}, "versions": ["1.0"]}
    ranged = own | {"ranges": [{"type": "ECOSYSTEM", "events": [{"introduced": "1.5"}, {"last_affected": "2.0"}]}]}
    with zipfile.ZipFile(tmp_path / "all.zip", "w") as archive:
        records = {"listed": [own], "ranged": [ranged], "other": [{"package": {"ecosystem": "npm", "name": "c"}}]}
        for name, affected in records.items():
            archive.writestr(f"{name}.json", json.dumps({"id": name, "summary": "a hole", "affected": affected}))
        archive.writestr("gone.json", json.dumps({"id": "gone", "withdrawn": "2026-01-01", "affected": [ranged]}))
    (tmp_path / "scripts").mkdir()
    shutil.copy(project / "scripts" / "advisories.json", tmp_path / "scripts")
    code, said = audit("--root", str(tmp_path))
    assert code == 1 and said.startswith("h11 0.15.0: CVE-2025-43859: ") and "take 0.16.0\n3 packages" in said
    package = tmp_path / "src" / "servoscope" / "__init__.py"
    package.parent.mkdir(parents=True)
    package.write_text('__version__ = "9.9"\n')
    assert audit("--root", str(tmp_path), "--vex", str(tmp_path / "vex.json"))[0] == 1
    vex = json.loads((tmp_path / "vex.json").read_text())
    (applies,) = (one for one in vex["statements"] if one["vulnerability"]["name"] == "CVE-2025-43859")
    assert applies["status"] == "affected" and "h11" in applies["action_statement"]
    assert audit("--vex", str(tmp_path / "vex.json"))[0] == 0
    statements = json.loads((tmp_path / "vex.json").read_text())["statements"]
    assert statements and {one["status"] for one in statements} == {"not_affected"}
    code, said = audit("--root", str(tmp_path), "--renew", str(tmp_path / "all.zip"))
    assert code == 1 and said.startswith(
        "a-b 2.0rc1: ranged: a hole; there is no release without it\n3 packages, 2 advi"
    )
