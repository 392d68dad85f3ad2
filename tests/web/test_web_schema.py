"""Requests made up from the OpenAPI description: whatever is sent, the server answers as described, and never fails."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import halls
import pytest
from browsing import Served

from servoscope.service.build import build_components
from servoscope.service.config import ServiceFile
from servoscope.service.service import Service

CHECKS = "not_a_server_error,status_code_conformance,content_type_conformance,response_schema_conformance"
SECONDS = int(os.environ.get("SCHEMA_SECONDS", "0"))  # 1800: the whole measure; 0: a few of each
WEB = """
[web]
listen = "127.0.0.1:0"
job_s = 2.0
"""


@pytest.mark.slow
def test_no_request_makes_the_server_fail(tmp_path: Path) -> None:
    halls.files(tmp_path)
    config = ServiceFile.load(halls.hall(tmp_path, "done", more=WEB))
    Service(config, build_components(config)).run()
    with Served(tmp_path, "serve", "done.toml") as served:
        command = ["--checks", CHECKS, "--max-examples", str(SECONDS or 4), "--seed", "1"]
        command += ["--max-time", str(SECONDS)] if SECONDS else []
        command += ["--phases", "coverage,fuzzing,stateful", "--generation-database", "none", "--request-timeout", "60"]
        command += ["--exclude-path", "/api/v1/live", "--no-color", "--continue-on-failure"]
        done = subprocess.run(
            [sys.executable, "-m", "schemathesis.cli", "run", f"{served.url}/api/v1/openapi.json", *command],
            cwd=tmp_path,
            env={**os.environ, "PYTHONWARNINGS": "default"},
            capture_output=True,
            text=True,
            timeout=600 + 2 * SECONDS,
            check=False,
        )
    print(done.stdout[-1500:])  # how many requests: pytest -s
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
    assert "✅ Stateful" in done.stdout
    assert "Traceback" not in served.log, served.log
