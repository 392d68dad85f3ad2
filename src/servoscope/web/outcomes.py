"""What the interface answers of uploads, jobs, diagnoses, baselines and studies."""

from __future__ import annotations

from typing import Any, Literal

from servoscope.web.said import DiagnosisRow, Said

__all__ = [
    "Baseline",
    "BaselineRow",
    "Baselines",
    "Design",
    "DesignRow",
    "Designs",
    "Diagnoses",
    "Diagnosis",
    "JobSaid",
    "Loops",
    "Upload",
    "UploadRow",
    "Uploads",
]


class JobSaid(Said):
    """A job: how far it is, and what came of it."""

    id: str
    kind: str
    state: Literal["queued", "running", "done", "failed"]
    step: str | None
    created: float
    finished: float | None
    result: dict[str, Any] | None
    problem: dict[str, Any] | None


class UploadRow(Said):
    """An upload in a line."""

    id: str
    name: str
    bytes: int
    at: float
    who: str


class Upload(UploadRow):
    """An upload with its columns, first rows, and what they may mean."""

    rows: int
    columns: list[dict[str, Any]]
    preview: dict[str, Any]
    mapping: dict[str, Any]


class Uploads(Said):
    """Uploads, the newest last."""

    uploads: list[UploadRow]


class Diagnoses(Said):
    """Diagnoses, the newest last."""

    diagnoses: list[DiagnosisRow]


class Diagnosis(DiagnosisRow):
    """A diagnosis with all that it says."""

    document: dict[str, Any]
    words: dict[str, str]
    began: float | None
    who: str | None
    baseline: dict[str, Any] | None
    units: dict[str, str] | None
    coefficient_units: list[str]
    signals: dict[str, Any] | None
    trace: dict[str, Any] | None
    report: str | None
    upload: str | None


class BaselineRow(Said):
    """A baseline in a line."""

    id: str
    name: str
    origin: Literal["service", "saved"]
    loop: str
    hash: str
    points: list[str]
    columns: dict[str, Any] | None
    units: dict[str, str] | None
    assets: list[str]
    recordings: int
    duration_s: float
    at: float | None
    who: str | None


class Baselines(Said):
    """All baselines."""

    baselines: list[BaselineRow]


class Baseline(BaselineRow):
    """A baseline with what was learned."""

    summary: dict[str, Any]


class Loops(Said):
    """Loops that come with the program, and those of baselines."""

    loops: list[dict[str, Any]]


class DesignRow(Said):
    """A study in a line."""

    id: str
    loop: str
    reference: str
    at: float
    who: str


class Designs(Said):
    """Studies, the newest last."""

    designs: list[DesignRow]


class Design(DesignRow):
    """A study before deployment."""

    study: dict[str, Any]
