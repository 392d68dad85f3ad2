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
import tomllib
from pathlib import Path

BUILD = "import hatchling.build, sys; print(hatchling.build.build_wheel(sys.argv[1]))"


def pinned(path: Path) -> dict[str, str]:
    """Return the version of each package of a lock file."""
    found = re.findall(r"^([\w.-]+)==([^\s;]+)", path.read_text(), re.MULTILINE)
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in found}


def build(source: Path, folder: Path, umask: int, seconds: int) -> str:
    """Return the digest of the wheel of a copy of the source whose files have another time and other permissions."""
    shutil.copytree(source / "src", folder / "src", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(source / name, folder)
    for path in folder.rglob("*"):
        os.utime(path, (seconds, seconds))
        path.chmod(path.stat().st_mode & ~umask)
    environment = {name: value for name, value in os.environ.items() if name != "SOURCE_DATE_EPOCH"}
    argv = [sys.executable, "-c", BUILD, str(folder / "dist")]
    done = subprocess.run(argv, cwd=folder, env=environment | {"TZ": "Asia/Tokyo"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return hashlib.sha256((folder / "dist" / done.stdout.strip()).read_bytes()).hexdigest()


def test_two_builds_have_the_same_bytes(project: Path, tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "other").mkdir()
    assert build(project, tmp_path / "one", 0, 1_700_000_000) == build(
        project, tmp_path / "other", 0o077, 1_800_000_000
    )


def test_a_container_installs_what_the_tests_run_with_and_nothing_without_a_hash(project: Path) -> None:
    text = (project / "requirements.lock").read_text()
    ours, tested = pinned(project / "requirements.lock"), pinned(project / "requirements-dev.lock")
    assert ours.items() <= tested.items()
    entries = re.split(r"\n(?=[\w.-]+==)", text)[1:]
    assert len(entries) == len(ours) and all("--hash=sha256:" in entry for entry in entries)
    settings = tomllib.loads((project / "pyproject.toml").read_text())["project"]
    names = "service", "web", "oidc", "mqtt", "opcua", "mdf", "tdms"
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
