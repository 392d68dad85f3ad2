"""Pages of an arm: verdict, joint, the arm with the fault at its joint, coefficients; its log without a service."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import httpx
import pytest
import screens
from arm_halls import FRICTION, replayed_arm, write_arm
from browsing import finished, upload
from halls import service_of
from opening import accessible
from screens import asked

from servoscope.core.errors import RecordingError
from servoscope.web.jobs.tasks import diagnose_file
from servoscope.web.schemas.requests import DiagnosisRequest

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is missing: make install brings it")
expect = playwright.expect

pytestmark = pytest.mark.slow


def test_an_arm_and_its_log(chromium: Any, tmp_path: Path) -> None:
    config = replayed_arm(write_arm(tmp_path), "pages")
    service_of(config).run()
    with screens.serving(config) as base:
        asset = asked(base, "/assets/cell")
        assert asset["verdict"] == "fault" and asset["summary"].startswith(f"Fault: {FRICTION} has risen by")
        (size,) = asset["sizes"]
        assert (size["name"], size["parameter"]) == (FRICTION, "elbow.coulomb_friction")
        moved = {one["name"]: (one["value"] - one["nominal"]) / one["std"] for one in asset["parameters"]}
        assert max(moved, key=lambda name: abs(moved[name])) == "elbow.coulomb_friction"
        assert [one["unit"] for one in asset["parameters"]][:3] == ["N m", "N m s", "N m"]
        assert [check["fault"] for check in asset["checks"]] == [FRICTION]
        assert asset["checks"][0]["texts"] == ["Lubrication, bearings, seals and brake of the joint; its temperature"]
        assert asked(base, "/assets/cell/relearning") is None and asked(base, "/assets/cell/limits") == {"limits": []}
        repair = {"t": asset["t"], "text": "gear", "kind": "repair"}
        noted = httpx.post(f"{base}/api/v1/assets/cell/notes", json=repair, headers={"Origin": base})
        assert noted.status_code == 409 and "'arm' learns from logs" in noted.text
        (learned,) = asked(base, "/baselines")["baselines"]
        assert learned["columns"]["covariates"]["elbow.torque"] == "i3"
        assert asked(base, f"/baselines/{learned['id']}")["summary"]["joints"].keys() >= {"elbow"}
        assert all("baseline" not in row["ref"] or not row["ref"]["baseline"] for row in asked(base, "/loops")["loops"])
        curves = asked(base, "/assets/cell/sizes?of=faults")["curves"]
        assert {curve["name"] for curve in curves} == {FRICTION}

        with httpx.Client(base_url=f"{base}/api/v1", timeout=60.0) as client:
            file = upload(client, "run.csv", (tmp_path / "run.csv").read_bytes()).json()
            wanted = {"upload": file["id"], "baseline": learned["id"]}
            request = DiagnosisRequest.model_validate({**wanted, "from_s": 10.0})
            with pytest.raises(RecordingError, match="from_s: leave out"):
                diagnose_file(lambda _: None, str(tmp_path / "run.csv"), request, str(tmp_path / "arm.json"), "", "")
            done = finished(client, client.post("/diagnoses", json=wanted))
            found = asked(base, f"/diagnoses/{done['result']['diagnosis']}")
            assert found["document"]["faults"][0]["name"] == FRICTION and max(found["arm"]["odds"]) > 0.9
            assert "friction of elbow" in client.get(found["report"].removeprefix("/api/v1")).text

        page = chromium.new_context().new_page()
        complaints: list[str] = []
        page.on("console", lambda said: complaints.append(said.text) if said.type == "error" else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        for address in ("/assets/cell", f"/diagnoses/{done['result']['diagnosis']}"):
            page.goto(base + address)
            expect(page.get_by_role("region", name="Verdict")).to_contain_text(re.compile("friction of elbow"))
            drawn = page.get_by_role("img", name="The arm and its joints")
            expect(drawn.locator("circle.fault title")).to_have_text(re.compile("elbow: (100|9[0-9]) %"))
            expect(page.get_by_text("Inverse frequency response", exact=True)).not_to_be_visible()
            accessible(page)
        assert complaints == []
