#!/usr/bin/env python3
"""Writes the software bill of materials of a release: what requirements.lock installs, as CycloneDX 1.5 (JSON).

    scripts/sbom.py [-o FILE]      to standard output without -o

Licences are those that the installed packages state; a package that is not installed here has none.
"""

from __future__ import annotations

import argparse
import json
import re
import tomllib
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PINNED = re.compile(r"^([\w.-]+)==([\w.+!-]+)")
HASH = re.compile(r"--hash=sha256:([0-9a-f]{64})")


def read_lock(text: str) -> list[tuple[str, str, list[str]]]:
    """Return name, version and hashes of all packages of a lock file."""
    found: list[tuple[str, str, list[str]]] = []
    for line in text.splitlines():
        if pinned := PINNED.match(line):
            found.append((pinned[1].lower(), pinned[2], []))
        if found:
            found[-1][2].extend(HASH.findall(line))
    return found


def component(name: str, version: str, hashes: list[str]) -> dict[str, Any]:
    """Return a package as CycloneDX has it."""
    purl = f"pkg:pypi/{name}@{version}"
    one: dict[str, Any] = {"type": "library", "bom-ref": purl, "name": name, "version": version, "purl": purl}
    # one hash for each archive of the release, of which a machine takes the one that suits it
    distribution = {"type": "distribution", "url": f"https://pypi.org/project/{name}/{version}/"}
    one["externalReferences"] = [{**distribution, "hashes": [{"alg": "SHA-256", "content": each} for each in hashes]}]
    if licence := find_licence(name):
        one["licenses"] = [licence]
    return one


def find_licence(name: str) -> dict[str, Any] | None:
    """Return the licence of an installed package as CycloneDX has it."""
    try:
        fields = metadata(name)
    except PackageNotFoundError:
        return None
    if expression := fields.get("License-Expression"):
        return {"expression": expression}
    stated = [
        text.rpartition(" :: ")[2] for text in fields.get_all("Classifier") or () if text.startswith("License ::")
    ]
    text = stated[0] if stated else (fields.get("License") or "").strip().partition("\n")[0]
    return {"license": {"name": text}} if text else None


def read_version(root: Path) -> str:
    """Return the version of the source in a folder."""
    source = (root / "src" / "servoscope" / "__init__.py").read_text(encoding="utf-8")
    return re.findall(r'^__version__ = "(.+)"', source, re.MULTILINE)[0]


def bill(root: Path) -> dict[str, Any]:
    """Return the bill of materials of the source in a folder."""
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    version = read_version(root)
    ref = f"pkg:pypi/{project['name']}@{version}"
    components = [component(*one) for one in read_lock((root / "requirements.lock").read_text(encoding="utf-8"))]
    subject = {"type": "application", "bom-ref": ref, "name": project["name"], "version": version, "purl": ref}
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": {**subject, "licenses": [{"license": {"id": project["license"]["text"]}}]}},
        "components": components,
        "dependencies": [{"ref": ref, "dependsOn": [one["bom-ref"] for one in components]}],
    }


def main() -> None:
    """Run the command line of this process."""
    parser = argparse.ArgumentParser(description="the software bill of materials as CycloneDX")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE")
    given = parser.parse_args()
    text = json.dumps(bill(ROOT), indent=1) + "\n"
    if given.output is None:
        print(text, end="")
    else:
        given.output.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
