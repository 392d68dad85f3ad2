"""The HTTP interface of a running service: every endpoint, live updates, alarms, and files from strangers."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path

import h5py
import halls
import httpx
import numpy as np
import pytest
from browsing import SOURCE, Served, events, finished, upload
from halls import hall

from servoscope.service.store import Store
from servoscope.service.store.queries import query_downsampled
from servoscope.signals import writers
from servoscope.simulation import FaultEvent

LEAKING = 200  # minutes of it, by the clock of the samples: longer than the tests
WEB = """
[web]
listen = "127.0.0.1:0"
upload_mb = 1.0
job_s = 60.0
job_memory_mb = 3000.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("web")
    halls.files(made)
    writers.write_recording(made / "leaking.csv", halls.recorded(3, FaultEvent.parse("C_ie=1.2@0")))
    return made


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[Served]:
    """Pages over a store that no service has written to yet."""
    config = hall(folder, "pages", store="live.sqlite", more=WEB)
    config.write_text(longer(config.read_text()))
    with Served(folder, "serve", str(config)) as served:
        yield served


@pytest.fixture(scope="module")
def followed(server: Served, folder: Path) -> Iterator[Served]:
    """The service, at ten times true speed: the press leaks from 90 s on, and goes on leaking."""
    config = hall(folder, "live", speed=10.0)
    config.write_text(longer(config.read_text()))
    command = [sys.executable, "-m", "servoscope", "run", str(config)]
    process = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": str(SOURCE)})
    yield server
    process.terminate()
    assert process.wait(30) in (0, -signal.SIGTERM)  # it may not have begun yet


def longer(text: str) -> str:
    """Return a service file with more to replay, a group, and residuals at a finer resolution."""
    text = text.replace("[assets.lift]", '[assets.lift]\ngroup = "north"')
    text = text.replace('"leaky.csv", "healthy.csv"]', '"leaky.csv"' + LEAKING * ', "leaking.csv"' + "]")
    text = text.replace(", ".join(3 * ['"healthy.csv"']), ", ".join((2 + LEAKING) * ['"healthy.csv"']))
    return text.replace("residual_every_s = 2.0", "residual_every_s = 0.5")


@pytest.fixture
def client(followed: Served) -> Iterator[httpx.Client]:
    with followed.client() as found:
        yield found


def until(client: httpx.Client, path: str, **wanted: object) -> dict[str, object]:
    """Return an answer that has these values, as soon as there is one."""
    deadline = time.monotonic() + 180.0
    while time.monotonic() < deadline:
        said = client.get(path)
        if said.is_success and all(said.json()[key] == value for key, value in wanted.items()):
            found: dict[str, object] = said.json()
            return found
        time.sleep(0.2)
    raise AssertionError(f"{path}: {wanted} never came: {said.text[:500]}")


def test_it_says_that_there_is_no_login_on_loopback(server: Served) -> None:
    assert "no login" in server.said and server.url.startswith("http://127.0.0.1:")
    with server.client() as client:
        said = client.get("/session").json()
    assert (said["login_required"], said["user"], said["role"], said["csrf"]) == (False, "local", "engineer", None)


@pytest.mark.slow
def test_live_updates_arrive_until_the_leak_is_told(server: Served, request: pytest.FixtureRequest) -> None:
    """Who listens from before the first sample hears of assets, then what changes, alarm and full diagnosis."""
    heard: dict[str, list[dict[str, object]]] = {}
    with server.client() as client, client.stream("GET", "/live") as stream:
        assert stream.headers["content-type"].startswith("text/event-stream")
        request.getfixturevalue("followed")
        begun = time.monotonic()
        for kind, data in events(stream):
            assert time.monotonic() - begun < 300.0, heard
            heard.setdefault(kind, []).append(json.loads(data))
            if any(one["grounds"] == "full" for one in heard.get("diagnosis", [])):
                break
    assert {row["asset"] for event in heard["assets"] for row in event["assets"]} == {"press", "lift"}  # type: ignore[attr-defined]
    assert len(heard["assets"]) > 5
    assert [one["asset"] for one in heard["alarm"] if one["after"] == "unacknowledged"] == ["press"]
    (full,) = [one for one in heard["diagnosis"] if one["grounds"] == "full"]
    assert full["asset"] == "press" and "leakage" in str(full["summary"])
    with server.client() as client:
        told = client.get(f"/diagnoses/{full['id']}").json()
    assert told["document"]["faults"][0]["name"] == "leakage" and told["sections"][1]["title"] == "What to check"
    assert told["units"] == {"r": "m", "u": "A", "y": "m", "response": "A/m"}


@pytest.mark.slow
def test_the_fleet_has_the_worst_first(client: httpx.Client) -> None:
    until(client, "/assets/press", verdict="fault")
    fleet = client.get("/assets").json()
    assert [row["asset"] for row in fleet["assets"]] == ["press", "lift"] and fleet["groups"] == ["north"]
    assert [row["asset"] for row in client.get("/assets", params={"group": "north"}).json()["assets"]] == ["lift"]
    assert [row["asset"] for row in client.get("/assets", params={"search": "PRES"}).json()["assets"]] == ["press"]
    assert fleet["services"][0]["service"] == "hall"
    until(client, "/assets/press", verdict="fault", awaited=[])
    press, lift = client.get("/assets").json()["assets"]
    (size,) = press["sizes"]
    # which window was diagnosed last is a matter of time, and the 95 % interval of one in twenty misses the truth
    assert size["low"] - 0.01 < 1.2 < size["high"] + 0.01 and lift["sizes"] == []


@pytest.mark.slow
def test_an_asset_in_detail(client: httpx.Client) -> None:
    said = until(client, "/assets/press", verdict="fault", awaited=[])
    assert {row["name"] for row in said["sizes"]} == {"leakage"}  # type: ignore[attr-defined]
    for response in said["responses"]:  # type: ignore[attr-defined]
        major, minor, _ = response["ellipse"]
        assert major >= minor > 0.0
    first = said["parameters"][0]  # type: ignore[index]
    assert first["low"] < first["value"] < first["high"] and first["unit"] == "A/m"
    assert said["baseline"] == "service:press" and said["about"]["sample_rate_hz"] == 100.0  # type: ignore[index]
    signals = client.get("/assets/press/signals", params={"seconds": 5, "points": 100}).json()
    assert 450 < signals["samples"] <= 500 and 50 < len(signals["t"]) <= 110
    assert np.all(np.diff(signals["t"]) > 0.0)
    end = signals["t"][-1] - 2.0  # a part of them, every sample
    part = client.get("/assets/press/signals", params={"seconds": 1, "to": end, "points": 1000}).json()
    # a stamp of today has steps of 0.2 us: a sample on the edge may be on either side of it
    assert abs(part["samples"] - 100) <= 1 and end - 1.0 < part["t"][0] <= part["t"][-1] <= end
    full = client.get("/diagnoses", params={"asset": "press", "grounds": "full"}).json()["diagnoses"][-1]
    *_, now = client.get(f"/diagnoses/{full['id']}").json()["signature"]
    assert now["words"] in ("after", "measured") and len(now["position"]) == len(now["forward"]) > 20
    limits = {(one["fault"], one["kind"]): one for one in client.get("/assets/press/limits").json()["limits"]}
    assert limits["pump", "tracking"]["down"] == pytest.approx(0.41, abs=0.01)
    row = next(one for one in client.get("/assets").json()["assets"] if one["asset"] == "press")
    assert row["source"] == "line" and client.get("/assets").json()["configured"] == 2


def test_history_is_thinned_and_keeps_what_was_largest(client: httpx.Client, folder: Path) -> None:
    until(client, "/assets/press", verdict="fault")
    ends = client.get("/assets/press").json()["counted"]["t"]
    span = {"from": ends - 60.0, "to": ends}
    thin = client.get("/assets/press/history", params={**span, "points": 10}).json()
    every = client.get("/assets/press/history", params={**span, "points": 5000}).json()
    assert len(thin["t"]) == 10 and len(every["t"]) == every["rows"] == thin["rows"] > 50
    assert max(thin["statistic"]) == max(every["statistic"]) and max(thin["level"]) == max(every["level"])
    assert [one["frequency_hz"] for one in thin["residuals"]] == [1.0, 10.0, 20.0]
    assert len(thin["residuals"][0]["real"]) == 10
    store = Store.open("live.sqlite", folder, lock_timeout_s=5.0)
    try:
        assert query_downsampled(store, "nobody", (0.0, 1.0), 10) == ([], 0)
    finally:
        store.close()


def test_an_alarm_is_acknowledged_and_the_audit_says_by_whom(client: httpx.Client) -> None:
    until(client, "/assets/press", verdict="fault")
    (alarm,) = client.get("/alarms", params={"asset": "press"}).json()["alarms"]
    assert alarm["alarm"] == "fault" and alarm["operator_action"] and "acknowledge" in alarm["commands"]
    path = "/assets/press/alarms/fault"
    refused = client.post(f"{path}/reset", json={})
    assert refused.status_code == 409 and refused.headers["content-type"] == "application/problem+json"
    assert client.post(f"{path}/shelve", json={}).status_code == 422
    assert client.post("/assets/nobody/alarms/fault/acknowledge", json={}).status_code == 404
    done = client.post(f"{path}/acknowledge", json={"why": "seen"})
    assert done.status_code == 200 and done.json()["outcome"] == "done"
    states = [one["after"] for one in client.get("/alarms/history", params={"asset": "press"}).json()["transitions"]]
    assert states[-1] in ("acknowledged", "latched_acknowledged")
    assert client.post(f"{path}/shelve", json={"for_s": 3600.0}).json()["outcome"] == "done"
    (alarm,) = client.get("/alarms", params={"asset": "press"}).json()["alarms"]
    assert alarm["state"] == "shelved" and alarm["until"] is not None
    said = [one for one in client.get("/audit").json()["entries"] if one["what"] == "acknowledge"]
    assert said[-1]["who"] == "local" and said[-1]["document"]["why"] == "seen"


@pytest.mark.slow
def test_a_recording_is_inspected_diagnosed_and_reported(client: httpx.Client, folder: Path) -> None:
    sent = upload(client, "../../leaky run.csv", (folder / "leaky.csv").read_bytes())
    assert sent.status_code == 201, sent.text
    said = sent.json()
    assert said["name"] == "leaky run.csv" and said["rows"] == 6000 and len(said["preview"]["rows"]) == 20
    assert {key: said["mapping"][key] for key in ("time", "reference", "input", "output")} == {
        "time": "t",
        "reference": "r",
        "input": "u",
        "output": "y",
    }
    seen = finished(
        client, client.post("/inspections", json={"upload": said["id"], "loop": {"example": "reference-rig"}})
    )
    assert seen["result"]["inspection"]["verdict"] == "usable" and len(seen["result"]["signals"]["t"]) <= 2010
    asked = {"upload": said["id"], "baseline": "service:press", "columns": {"input": "1 * u"}}
    job = finished(client, client.post("/diagnoses", json=asked))
    assert job["state"] == "done", job["problem"]
    id_ = job["result"]["diagnosis"]
    told = client.get(f"/diagnoses/{id_}").json()
    assert told["verdict"] == "fault" and told["document"]["faults"][0]["name"] == "leakage"
    assert max(x for x in told["trace"]["statistic"] if x is not None) > 1.0
    report = client.get(f"/diagnoses/{id_}/report")
    assert "leakage" in report.text and "sandbox" in report.headers["content-security-policy"]
    assert id_ in {one["id"] for one in client.get("/diagnoses", params={"grounds": "upload"}).json()["diagnoses"]}
    assert client.delete(f"/uploads/{said['id']}").status_code == 204
    assert client.get(f"/uploads/{said['id']}").status_code == 404
    assert client.get(f"/diagnoses/{id_}").status_code == 200  # its address is for good


def test_a_baseline_is_learned_saved_used_and_deleted(client: httpx.Client, folder: Path) -> None:
    healthy = upload(client, "healthy.csv", (folder / "healthy.csv").read_bytes()).json()["id"]
    loop = {"toml": halls.LOOP.read_text()}
    job = finished(client, client.post("/learnings", json={"loop": loop, "recordings": [{"upload": healthy}]}))
    assert job["state"] == "done", job["problem"]
    assert job["result"]["recordings"][0]["inspection"]["verdict"] == "usable"
    saved = client.post("/baselines", json={"name": "mine", "learning": job["result"]["learning"]})
    assert saved.status_code == 201 and saved.json()["origin"] == "saved"
    assert client.post("/baselines", json={"name": "mine", "learning": job["result"]["learning"]}).status_code == 409
    one = client.get("/baselines/mine").json()
    assert {promise["name"] for promise in one["summary"]["promises"]} == {
        "pump",
        "leakage",
        "fluid",
        "friction",
    } or one
    assert json.loads(client.get("/baselines/mine/file").content)["hash"] == one["hash"]
    assert {row["id"] for row in client.get("/baselines").json()["baselines"]} == {"service:press", "mine"}
    refs = [one["ref"] for one in client.get("/loops").json()["loops"]]
    assert {"example": "reference-rig"} in refs and {"baseline": "mine"} in refs
    for name in "abcd":  # with the first one five machines, as like as can be
        client.post("/baselines", json={"name": name, "learning": job["result"]["learning"]})
    asked = {"loop": loop, "recordings": [{"upload": healthy}], "population": ["mine", *"abcd"]}
    like = finished(client, client.post("/learnings", json=asked))
    assert "5 like machines" in str(like["result"]["summary"]["notes"]), like["problem"]
    assert client.post("/learnings", json=asked | {"population": ["nobody"]}).status_code == 404
    for name in "abcd":
        assert client.delete(f"/baselines/{name}").status_code == 204
    assert client.delete("/baselines/service:press").status_code == 409
    assert client.delete("/baselines/mine").status_code == 204
    done = [one["what"] for one in client.get("/audit").json()["entries"]]
    assert "baseline saved" in done and "baseline deleted" in done


def bomb() -> bytes:
    """Return a small MAT file whose array takes 80 GB."""
    target = io.BytesIO()
    with h5py.File(target, "w", userblock_size=512) as file:
        file.create_dataset("u", shape=(10**10,), dtype="f8", chunks=(10**6,), compression="gzip", fillvalue=0.0)
    content = bytearray(target.getvalue())
    content[:19] = b"MATLAB 7.3 MAT-file"
    return bytes(content)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("bomb.mat", bomb()),
        ("torn.parquet", b"PAR1" + bytes(range(256)) * 10 + b"PAR1"),
        ("torn.mat", b"MATLAB 5.0 MAT-file" + b"\xff" * 4000),
        ("page.csv", b"<html><script>alert(1)</script>"),
        ("empty.csv", b""),
        ("deep.csv", b"t,r,u,y\n" + b"(" * 200_000),
        ("program.exe", b"MZ"),
        ("x" * 300 + ".csv", b"t\n1\n"),
    ],
    ids=lambda value: value[:12] if isinstance(value, str) else "",
)
def test_a_hostile_file_is_refused_and_the_server_goes_on(client: httpx.Client, name: str, content: bytes) -> None:
    said = upload(client, name, content)
    assert said.status_code == 422 and said.headers["content-type"] == "application/problem+json", said.text
    assert "\n" not in said.json()["detail"] and "servoscope-web" not in said.json()["detail"]
    assert client.get("/session").status_code == 200


def test_too_much_is_refused_while_it_comes(client: httpx.Client) -> None:
    assert upload(client, "big.csv", b"t,r,u,y\n" + b"1,2,3,4\n" * 200_000).status_code == 413

    def endless() -> Iterator[bytes]:
        for _ in range(200):
            yield b"1,2,3,4\n" * 2000

    kind = {"Content-Type": "application/octet-stream"}  # no length is said
    try:
        said = client.post("/uploads", params={"name": "big.csv"}, content=endless(), headers=kind).status_code
    except httpx.WriteError:  # it hung up before all was sent
        said = 413
    assert said == 413
    assert client.post("/session", json={"user": "a", "password": "b" * 2_000_000}).status_code == 413
    assert client.get("/uploads").status_code == 200


def test_pages_and_metrics(server: Served, client: httpx.Client) -> None:
    client.get("/assets")
    until, metrics = time.monotonic() + 30.0, ""
    while 'servoscope_verdict{asset="press"' not in metrics and time.monotonic() < until:  # as soon as it is stored
        metrics = httpx.get(f"{server.url}/metrics").text
    assert 'servoscope_verdict{asset="press"' in metrics and "servoscope_http_requests_total{" in metrics
    assert httpx.get(f"{server.url}/health/ready").json()["ok"]
    address = httpx.URL(server.url)
    for path in ("/static/none.js", "/api/v1/none", "/api", "/static/../guard.py", "/static/%2e%2e/guard.py"):
        connection = HTTPConnection(address.host, address.port or 80)  # it sends dots as they are
        connection.request("GET", path)
        said = connection.getresponse()
        assert said.status == 404 and said.headers["content-type"] == "application/problem+json", path
        connection.close()
    policy = client.get("/session").headers["content-security-policy"]
    assert "default-src 'none'" in policy and "unsafe" not in policy


def test_wrong_requests_say_what_is_wrong_with_them(client: httpx.Client) -> None:
    for said, status in (
        (client.get("/assets", params={"serach": "x"}), 422),
        (client.get("/assets/nobody"), 404),
        (client.get("/diagnoses/press@99999999999999999999"), 404),
        (client.get("/diagnoses/u-../../x"), 404),
        (client.get("/baselines/..%2f..%2fx"), 404),
        (client.get("/assets/press/history", params={"from": "nan"}), 422),
        (client.put("/assets"), 405),
        (client.post("/diagnoses", json={"upload": "0", "baseline": "1"}), 404),
        (client.post("/designs", json={"loop": {"example": "reference-rig"}, "reference": "secret.csv"}), 422),
        (client.post("/designs", content=b"{", headers={"Content-Type": "application/json"}), 422),
    ):
        assert said.status_code == status, said.text
        problem = said.json()
        assert said.headers["content-type"] == "application/problem+json"
        assert problem["status"] == status and problem["detail"] and problem["instance"].startswith("/api/v1/")


def test_a_design_that_takes_too_long_can_be_stopped(client: httpx.Client) -> None:
    job = client.post("/designs", json={"loop": {"example": "reference-rig"}}).json()
    assert client.delete(f"/jobs/{job['id']}").status_code == 204
    ended = client.get(f"/jobs/{job['id']}", params={"wait": 20}).json()
    assert ended["state"] == "failed" and "stopped" in ended["problem"]["detail"]
    assert client.get("/designs").json() == {"designs": []}


@pytest.mark.slow
def test_the_pages_end_with_a_service_that_is_killed(folder: Path) -> None:
    with Served(folder, "run", str(hall(folder, "killed", speed=1.0, more=WEB))) as served:
        assert httpx.get(f"{served.url}/health/live").is_success
        os.kill(served.pid, signal.SIGKILL)
        deadline = time.monotonic() + 20.0
        while time.monotonic() < deadline:
            try:
                httpx.get(f"{served.url}/health/live", timeout=1.0)
            except httpx.TransportError:
                return
            time.sleep(0.1)
    pytest.fail("the pages outlive their service")
