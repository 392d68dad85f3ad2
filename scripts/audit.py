#!/usr/bin/env python3
"""Compares the lock files with the advisories that the project keeps; it asks no server.

    scripts/audit.py                    prints what has a known hole, and exits with 1 then
    scripts/audit.py --renew all.zip    takes the advisories of locked packages from OSV's export of its PyPI records
    scripts/audit.py --vex FILE         writes what each advisory means for servoscope, as OpenVEX 0.2.0

`scripts/advisories.json` has records in OSV's form, and the day on which they were taken.
"""

from __future__ import annotations

import argparse
import json
import sys
import zipfile
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from packaging.utils import canonicalize_name
from packaging.version import InvalidVersion, Version
from sbom import read_version

ROOT = Path(__file__).resolve().parent.parent
ADVISORIES = Path("scripts", "advisories.json")
LOCK_FILES = ("requirements.lock", "requirements-dev.lock")
KEPT = ("id", "modified", "aliases", "summary", "affected")


def locked_versions(root: Path, files: Sequence[str] = LOCK_FILES) -> dict[str, Version]:
    """Return the version of each package in lock files, which agree in those that both have."""
    lines = [line for name in files for line in (root / name).read_text(encoding="utf-8").splitlines()]
    pinned = (line.split()[0].split("==") for line in lines if "==" in line and line[0].isalnum())
    return {canonicalize_name(name): Version(version) for name, version in pinned}


def is_affected(version: Version, affected: dict[str, Any]) -> bool:
    """Tell whether a version is one of those that a record names, or within its ranges."""
    ranges = (one["events"] for one in affected.get("ranges", ()) if one["type"] in ("ECOSYSTEM", "SEMVER"))
    return str(version) in affected.get("versions", ()) or any(_is_within(version, events) for events in ranges)


def _is_within(version: Version, events: list[dict[str, str]]) -> bool:
    within = False
    for event in sorted(events, key=lambda event: _parse(next(iter(event.values())))):
        ((kind, at),) = event.items()
        if kind == "introduced" and version >= _parse(at):
            within = True
        elif (kind == "fixed" and version >= _parse(at)) or (kind == "last_affected" and version > _parse(at)):
            within = False
    return within


def _parse(text: str) -> Version:
    try:
        return Version(text)
    except InvalidVersion:  # of an old release, which none that is locked can be
        return Version("0")


def find_holes(advisories: dict[str, Any], versions: dict[str, Version]) -> Iterator[str]:
    """Yield a line for each advisory on a locked version."""
    for record in advisories["vulns"]:
        for affected in record["affected"]:
            name = canonicalize_name(affected["package"]["name"])
            if name in versions and is_affected(versions[name], affected):
                known = ", ".join([record["id"], *record.get("aliases", ())])
                fixed = [
                    event["fixed"] for one in affected.get("ranges", ()) for event in one["events"] if "fixed" in event
                ]
                remedy = f"take {' or '.join(fixed)}" if fixed else "there is no release without it"
                yield f"{name} {versions[name]}: {known}: {record.get('summary', 'no summary')}; {remedy}"


def take_records(export: Path, versions: dict[str, Version]) -> dict[str, Any]:
    """Return the records of an export that are of locked packages and hold."""
    records = []
    with zipfile.ZipFile(export) as archive:
        for member in sorted(archive.namelist()):
            record = json.loads(archive.read(member))
            own = [
                {key: one[key] for key in ("package", "ranges", "versions") if key in one}
                for one in record.get("affected", ())
                if one["package"]["ecosystem"] == "PyPI" and canonicalize_name(one["package"]["name"]) in versions
            ]
            if own and "withdrawn" not in record:
                records.append({**{key: record[key] for key in KEPT if key in record}, "affected": own})
    today = datetime.now(UTC).date().isoformat()
    return {"taken": today, "source": "OSV, all records of PyPI", "vulns": records}


def state_exposure(advisories: dict[str, Any], root: Path) -> dict[str, Any]:
    """Return an OpenVEX document: for each advisory on a package that a release installs, whether it applies."""
    versions = locked_versions(root, LOCK_FILES[:1])
    release = read_version(root)
    statements = []
    for record in advisories["vulns"]:
        for affected in record["affected"]:
            name = canonicalize_name(affected["package"]["name"])
            if name not in versions:
                continue
            part = {"@id": f"pkg:pypi/{name}@{versions[name]}"}
            statement: dict[str, Any] = {
                "vulnerability": {"name": record["id"], "aliases": record.get("aliases", [])},
                "products": [{"@id": f"pkg:pypi/servoscope@{release}", "subcomponents": [part]}],
            }
            if is_affected(versions[name], affected):
                statement |= {"status": "affected", "action_statement": f"Install another version of {name}."}
            else:
                statement |= {"status": "not_affected", "justification": "vulnerable_code_not_present"}
            statements.append(statement)
    return {
        "@context": "https://openvex.dev/ns/v0.2.0",
        "@id": f"urn:servoscope:vex:{release}:{advisories['taken']}",
        "author": "The servoscope developers",
        "timestamp": f"{advisories['taken']}T00:00:00Z",
        "version": 1,
        "statements": statements,
    }


def main() -> int:
    """Compare, renew, or write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--renew", type=Path, metavar="FILE")
    parser.add_argument("--vex", type=Path, metavar="FILE")
    parser.add_argument("--root", type=Path, default=ROOT, help="folder of the lock files and of scripts")
    options = parser.parse_args()
    versions = locked_versions(options.root)
    path = options.root / ADVISORIES
    if options.renew is not None:
        path.write_text(json.dumps(take_records(options.renew, versions), indent=1) + "\n", encoding="utf-8")
    advisories = json.loads(path.read_text(encoding="utf-8"))
    if options.vex is not None:
        document = state_exposure(advisories, options.root)
        options.vex.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    holes = list(find_holes(advisories, versions))
    print(*holes, sep="\n", end="\n" if holes else "")
    print(
        f"{len(versions)} packages, {len(advisories['vulns'])} advisories of {advisories['taken']}, {len(holes)} holes"
    )
    return 1 if holes else 0


if __name__ == "__main__":
    sys.exit(main())
