"""Pages as a reader of HTML sees them, and the recordings, traces and diagnoses that they are made of."""

from __future__ import annotations

from html.parser import HTMLParser
from typing import Any

import numpy as np

from servoscope.detection.trace import Trace
from servoscope.diagnosis.result import Diagnosis, DiagnosisWarning, FinalCoefficient, ResponsePoint
from servoscope.estimation.frequency_response import FrequencyResponse
from servoscope.isolation.candidate import Candidate, FaultEstimate
from servoscope.models.loop import Loop
from servoscope.report import diagnosis_page as report
from servoscope.signals import Recording

PROVENANCE = {"baseline": "healthy.json", "hash": "0123456789abcdef", "threshold": "46.2"}
VOID = {"meta", "br", "path", "use", "circle", "link", "img"}


class Reader(HTMLParser):
    """Text, tags with attributes, and whether what is opened is closed."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.open: list[str] = []
        self.wrong: list[str] = []
        self.feed(page)
        self.close()
        self.text = " ".join(self.text.split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        if tag in VOID:
            return
        if not self.open or self.open.pop() != tag:
            self.wrong.append(tag)

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.text += data if self.open and self.open[-1] in ("sub", "sup", "i") else f" {data}"


def make_recording(N: int = 6000, seed: int = 0, name: str = "suspect.csv") -> Recording:
    rng = np.random.default_rng(seed)
    t = np.arange(N) / 100.0
    restart = np.zeros(N, dtype=bool)
    restart[0] = True
    if N > 100:
        t[N // 2 :] += 0.37
        restart[[N // 2, 3 * N // 4]] = True
    r = 0.03 * np.sin(t)
    u, noise = rng.normal(0.0, 0.1, N), rng.normal(0.0, 1e-3, N)
    return Recording(t, r, u, r + noise, restart, name=name, sample_rate=100.0, run=np.zeros(N, dtype=np.int32))


def make_trace(K: int = 600, n: int = 4, F: int = 3, seed: int = 1, names: tuple[str, ...] | None = None) -> Trace:
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(1, K + 1)
    shifted = (t > 30.0)[:, None]
    expected = np.tile(10.0 ** -np.arange(n), (K, 1))
    theta = expected * (1.0 + 0.01 * rng.normal(size=(K, n)) + 0.2 * shifted)
    covariance = np.einsum("kn,nm->knm", (0.01 * expected) ** 2, np.eye(n))
    E = np.exp(1j * rng.uniform(0.0, 6.0, (F, n)))

    def of(theta: Any) -> FrequencyResponse:
        spread = np.tile(1e-4 * np.array([[2.0, 0.5], [0.5, 1.0]]), (K, F, 1, 1))
        return FrequencyResponse(np.arange(1.0, F + 1.0), theta @ E.T, spread)

    return Trace(
        t=t,
        names=names or tuple(f"theta_{i}" for i in range(n)),
        theta=theta,
        covariance=covariance,
        expected=expected,
        statistic=rng.chisquare(n, K) + 400.0 * shifted[:, 0],
        threshold=46.2,
        level=2.0 * shifted[:, 0],
        crossed=np.where(shifted[:, 0], 30.1, np.nan),
        ifrf=of(theta),
        ifrf_expected=of(expected),
        ready=t > 0.55 if K > 10 else np.ones(K, dtype=bool),
    )


def make_diagnosis(verdict: str = "fault", **changes: Any) -> Diagnosis:
    leakage = FaultEstimate(name="leakage", parameter="C_ie", ratio=1.2, interval=(1.19, 1.21))
    values: dict[str, Any] = {
        "recording": "suspect.csv",
        "samples": 6000,
        "duration_s": 60.37,
        "verdict": verdict,
        "summary": "What the summary says.",
        "parameters": {"theta_0": FinalCoefficient(value=0.3129, std=0.0023, nominal=0.2590)},
        "ifrf": (
            ResponsePoint(
                frequency_hz=1.0,
                real=0.31,
                imag=1.6625,
                real_std=0.0022,
                imag_std=0.002,
                nominal_real=0.2564,
                nominal_imag=1.6587,
            ),
        ),
        "warnings": (
            DiagnosisWarning(kind="gap", from_s=20.0, to_s=20.37, count=37, message="gap of 37 rows, not bridged"),
        ),
    }
    if verdict == "fault":
        values |= {
            "detected_at_s": 31.4,
            "onset_s": (29.8, 30.0, 30.2),
            "probability": 0.998,
            "faults": (leakage,),
            "candidates": (
                Candidate(name="leakage", probability=0.998, faults=(leakage,)),
                Candidate(name="unknown", probability=0.002),
            ),
        }
    return Diagnosis(**(values | changes))


def read(diagnosis: Diagnosis, loop: Loop, trace: Trace | None = None, recording: Recording | None = None) -> Reader:
    return Reader(
        report.render_diagnosis_page(diagnosis, trace or make_trace(), recording or make_recording(), loop, PROVENANCE)
    )
