"""Actions against a real server and real programs: signed, at least once, bounded; and settings that are refused."""

from __future__ import annotations

import hashlib
import hmac
import json
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from servoscope.core.errors import StateError
from servoscope.core.settings_errors import describe_error
from servoscope.service.actions import (
    ActionSettings,
    FaultToleranceSettings,
    FaultToleranceState,
    OutboxEntry,
    accommodate_fault,
    deliver,
    diagnosis_entries,
    flood_entries,
    transition_entries,
)
from servoscope.service.actions.outbox import schedule_retry
from servoscope.service.actions.settings import RetrySettings
from servoscope.service.alarms import AlarmState, AlarmTransition, LifecycleEvent, LifecycleState, Notification

NOW = 1.7e9
NEW = AlarmTransition(
    NOW,
    "press 1",
    "fault",
    7,
    LifecycleState.NORMAL,
    LifecycleState.UNACKNOWLEDGED,
    LifecycleEvent.OCCUR,
    "leakage",
    "system",
)


@pytest.fixture(autouse=True)
def no_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")


@dataclass
class Receiver:
    """A server on loopback that answers what it is told, and then 200, and keeps what it was sent."""

    answers: list[tuple[int, dict[str, str]]] = field(default_factory=list)
    requests: list[tuple[dict[str, str], bytes]] = field(default_factory=list)
    slow_s: float = 0.0
    url: str = ""


@contextmanager
def receiving(*answers: tuple[int, dict[str, str]]) -> Iterator[Receiver]:
    receiver = Receiver(list(answers))

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            receiver.requests.append((dict(self.headers.items()), body))
            time.sleep(receiver.slow_s)
            status, headers = receiver.answers.pop(0) if receiver.answers else (200, {})
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    receiver.url = f"http://127.0.0.1:{server.server_port}/hook"
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield receiver
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def webhook(url: str, **more: Any) -> ActionSettings:
    return ActionSettings.model_validate({"webhook": {"desk": {"url": url, **more}}})


def command(*argv: str, **more: Any) -> ActionSettings:
    return ActionSettings.model_validate({"command": {"tool": {"argv": argv, **more}}})


def row_for(settings: ActionSettings, transition: AlarmTransition = NEW, **details: Any) -> OutboxEntry:
    (row,) = transition_entries(settings, transition, "high", NOW, details)
    return row


def test_a_webhook_is_tried_until_it_is_taken_with_the_same_key_and_a_good_signature(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("DESK_SECRET", "hush")
    with receiving((500, {}), (503, {"Retry-After": "30"})) as receiver:
        settings = webhook(receiver.url, secret_env="DESK_SECRET")
        row: OutboxEntry | None = row_for(settings, details_of="leakage")
        now, tries = NOW, []
        while row is not None:
            tries.append(deliver(row, settings, now))
            row = tries[-1].retry_entry
            now = row.due if row else now
    assert [(one.entry.attempts + 1, one.delivered, one.retry_entry is None) for one in tries] == [
        (1, False, False),
        (2, False, False),
        (3, True, True),
    ]
    assert tries[0].detail == f"{receiver.url.removesuffix('/hook')}: answered 500"
    first, second = (one.retry_entry for one in tries[:2])
    assert first and 0.5 <= first.due - NOW <= 1.0
    assert second and second.due - first.due == 30.0  # the receiver asked for it
    stamps = []
    for headers, body in receiver.requests:
        stamps.append(headers["X-Servoscope-Timestamp"])
        expected = hmac.new(b"hush", stamps[-1].encode() + b"." + body, hashlib.sha256).hexdigest()
        assert headers["X-Servoscope-Signature"] == f"sha256={expected}"
        assert headers["Idempotency-Key"] == json.loads(body)["key"] == tries[0].entry.key
        assert headers["Content-Type"] == "application/json"
    assert all(abs(int(stamp) - time.time()) < 60.0 for stamp in stamps)  # by the clock that receivers compare with
    event = json.loads(receiver.requests[0][1])
    told = {"asset": "press 1", "alarm": "fault", "after": "unacknowledged", "priority": "high", "cause": "leakage"}
    assert told.items() <= event.items()
    assert event["details"] == {"details_of": "leakage"}


def test_what_fails_otherwise_is_said_and_put_off_too(tmp_path: Path) -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        nobody = f"http://127.0.0.1:{closed.getsockname()[1]}/"
        with receiving((302, {"Location": "http://127.0.0.1:9/"})) as receiver:
            cases = [
                (webhook(nobody), "refused"),
                (webhook(receiver.url), "answered 302"),
                (webhook(receiver.url, secret_env="NOT_SET"), "environment variable NOT_SET holds no secret"),
                (webhook(receiver.url, secret_file=str(tmp_path / "none")), "none: cannot be read"),
            ]
            for settings, words in cases:
                result = deliver(row_for(settings), settings, NOW)
                assert words in result.detail
                assert result.retry_entry
                assert not result.delivered
        assert len(receiver.requests) == 1  # no redirect is followed, nothing goes out unsigned
    result = deliver(row_for(webhook(nobody)), ActionSettings(), NOW)
    assert "none of webhook, command, mqtt and email is called 'desk' any more" in result.detail


def test_a_receiver_that_does_not_answer_in_time_is_tried_again() -> None:
    with receiving() as receiver:
        receiver.slow_s = 0.5
        settings = webhook(receiver.url, timeout_s=0.1)
        result = deliver(row_for(settings), settings, NOW)
    assert not result.delivered
    assert "timed out" in result.detail


def test_a_secret_may_be_in_a_file(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("hush\n")
    with receiving() as receiver:
        settings = webhook(receiver.url, secret_file=str(tmp_path / "secret"))
        assert deliver(row_for(settings), settings, NOW).delivered
    ((headers, body),) = receiver.requests
    signed = f"{headers['X-Servoscope-Timestamp']}.".encode() + body
    assert headers["X-Servoscope-Signature"].endswith(hmac.new(b"hush", signed, hashlib.sha256).hexdigest())


KEEP = "import json, sys; json.dump([sys.argv[1:], json.load(sys.stdin)], open(sys.argv[1], 'w'))"


def test_a_command_gets_whole_arguments_and_the_event_and_no_shell(tmp_path: Path) -> None:
    kept, touched = tmp_path / "kept.json", tmp_path / "touched"
    settings = command(sys.executable, "-c", KEEP, str(kept), "{asset}", "{value}", "$HOME", '{"a": 1}', "{key}")
    nasty = AlarmTransition(**{**vars(NEW), "asset": f"x; touch {touched} `touch {touched}` {{key}}"})
    row = row_for(settings, nasty)
    result = deliver(row, settings, NOW)
    assert result.delivered, result.detail
    argv, event = json.loads(kept.read_text())
    assert argv == [str(kept), nasty.asset, "", "$HOME", '{"a": 1}', row.key]
    assert event == row.event
    assert not touched.exists()


def test_a_command_that_fails_or_hangs_is_told_and_killed_with_what_it_started(tmp_path: Path) -> None:
    fails = command(sys.executable, "-c", "import sys; sys.exit('no such pager')")
    result = deliver(row_for(fails), fails, NOW)
    assert result.detail == f"{sys.executable}: exit code 1, no such pager"
    late = tmp_path / "late"
    grandchild = f"import time, pathlib; time.sleep(1.0); pathlib.Path({str(late)!r}).touch()"
    hangs = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {grandchild!r}])"
    settings = command(sys.executable, "-c", hangs, timeout_s=0.5)
    result = deliver(row_for(settings), settings, NOW)
    assert result.detail == f"{sys.executable}: not done after 0.5 s, killed"
    time.sleep(1.2)
    assert not late.exists()
    missing = command(str(tmp_path / "gone"))
    assert "gone: cannot be run (No such file or directory)" in deliver(row_for(missing), missing, NOW).detail


def test_the_key_says_which_event_it_is() -> None:
    section = {"webhook": {"desk": {"url": "http://desk"}}, "command": {"tool": {"argv": ["true"]}}}
    settings = ActionSettings.model_validate(section)
    rows = transition_entries(settings, NEW, "high", NOW)
    again = transition_entries(settings, NEW, "high", NOW + 100.0)
    later = transition_entries(settings, AlarmTransition(**{**vars(NEW), "sequence": 8}), "high", NOW)
    assert [row.key for row in rows] == [row.key for row in again]
    other = transition_entries(
        settings, AlarmTransition(**{**vars(NEW), "time": NEW.time + 1.0}), "high", NOW
    )  # counted anew
    assert len({row.key for row in (*rows, *later, *other)}) == 6
    assert OutboxEntry(**json.loads(json.dumps(rows[0].to_dict()))) == rows[0]


def test_a_sink_hears_what_it_asks_for() -> None:
    def heard(transition: AlarmTransition = NEW, **sink: Any) -> bool:
        return bool(transition_entries(webhook("http://desk", **sink), transition, "medium", NOW))

    acknowledged = AlarmTransition(**{**vars(NEW), "before": NEW.after, "after": LifecycleState.ACKNOWLEDGED})
    unseen = AlarmTransition(**{**vars(NEW), "before": LifecycleState.SHELVED, "after": LifecycleState.SHELVED})
    assert heard() and heard(assets=["press 1"], alarms=["fault"], priorities=["medium"])
    assert not heard(assets=["press 2"])
    assert not heard(priorities=["high", "critical"])
    assert not heard(events=[])
    assert not heard(acknowledged)
    assert heard(acknowledged, states=["acknowledged"])
    assert not heard(unseen, states=["shelved"])

    alarm = AlarmState("press 1", "fault", NOW, NOW, NOW, LifecycleState.ACKNOWLEDGED, sequence=8)

    def named(**sink: Any) -> list[dict[str, Any]]:
        settings = webhook("http://desk", **sink)
        rows = diagnosis_entries(settings, alarm, "medium", NOW + 10.0, NOW, "Fault: leakage.", {"faults": ["x"]})
        return [row.event for row in rows]

    (event,) = named()
    occurred = transition_entries(webhook("http://desk"), NEW, "medium", NOW)[0].event
    assert event.keys() == occurred.keys() and event["key"] != occurred["key"]
    assert (event["event"], event["before"], event["after"]) == ("diagnosed", "acknowledged", "acknowledged")
    assert named(events=["diagnosed"]) and named(states=None)
    assert not named(events=["occur"]) and not named(states=["normal"]) and not named(alarms=["data_quality"])
    flood = Notification("flood_begins", NOW, counted=11, peak=11)
    assert [row.event["counted"] for row in flood_entries(webhook("http://desk"), flood, NOW)] == [11]
    assert not flood_entries(webhook("http://desk", assets=["press 1"]), flood, NOW)


def test_waits_double_up_to_a_bound_differ_by_event_and_end() -> None:
    retry = RetrySettings(first_s=1.0, longest_s=60.0, give_up_s=3600.0)

    def waits(key: str) -> list[float]:
        row: OutboxEntry | None = OutboxEntry(key, "desk", {}, created=0.0, due=0.0)
        found: list[float] = []
        while row is not None:
            now, row = row.due, schedule_retry(retry, row, row.due)
            found += [row.due - now] if row else []
        return found

    one, other = waits("a"), waits("b")
    for k, wait in enumerate(one):
        assert 0.5 * min(2.0**k, 60.0) <= wait <= min(2.0**k, 60.0)
    assert 3600.0 - 60.0 <= sum(one) <= 3600.0
    assert one[:5] != other[:5]
    assert one == waits("a")


@pytest.mark.parametrize(
    ("section", "complaint"),
    [
        ({"webhook": {"t": {"url": "file:///etc"}}}, "[actions] webhook.t.url: is no address"),
        ({"webhook": {"t": {"url": "http://x", "secret": "s"}}}, "[actions] webhook.t.secret: unknown key"),
        ({"command": {"t": {"argv": ["say", "--to={asset}"]}}}, "'--to={asset}': a placeholder is an argument of its"),
        ({"command": {"t": {"argv": ["say", "{aset}"]}}}, "'{aset}' is no placeholder, choose from"),
        ({"command": {"t": {"argv": ["{asset}"]}}}, "the program must be named"),
        ({"command": {"t": {"argv": "say it"}}}, "'say it' is not a list"),
        (
            {"command": {"t": {"argv": ["x"]}}, "webhook": {"t": {"url": "http://x"}}},
            "'t' names two of webhook, command, mqtt and email",
        ),
    ],
)
def test_wrong_settings_are_told_in_one_line(section: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ValidationError) as caught:
        ActionSettings.model_validate(section)
    assert complaint in describe_error(caught.value, ActionSettings, section="actions")


GAIN = {
    "assets": ["press 1"],
    "fault": "pump",
    "quantity": "k_p",
    "kind": "gain",
    "nominal": 20.0,
    "exponent": -1.0,
    "min": 10.0,
    "max": 29.0,
    "max_step": 4.0,
    "per_hour": 2,
}


def gain(**more: Any) -> FaultToleranceSettings:
    return FaultToleranceSettings.model_validate({**GAIN, **more})


def test_a_change_is_off_unless_told_otherwise() -> None:
    settings = gain()
    assert accommodate_fault("soft", settings, FaultToleranceState(settings.nominal), "press 1", 0.5, NOW, NOW) == (
        FaultToleranceState(settings.nominal),
        None,
        None,
    )


def test_a_change_goes_step_by_step_within_its_bounds_and_back_again() -> None:
    settings = gain(mode="recommend")
    state, changes = FaultToleranceState(settings.nominal), []
    ratios = [(0.0, 0.999), (1.0, 0.5), (2.0, 0.5), (3.0, 0.5), (3602.0, 0.5), (7300.0, None), (7301.0, None)]
    for when, ratio in ratios:
        state, change, row = accommodate_fault("soft", settings, state, "press 1", ratio, when, NOW)
        assert row is None
        changes += [(when, change.previous, change.value, change.target)] if change else []
        state = FaultToleranceState.from_dict(json.loads(json.dumps(state.to_dict())))
    # 0.999 is not worth a change; the third change within the hour has to wait; 40 is beyond the bound of 29.
    assert changes == [
        (1.0, 20.0, 24.0, 40.0),
        (2.0, 24.0, 28.0, 40.0),
        (3602.0, 28.0, 29.0, 40.0),
        (7300.0, 29.0, 25.0, 20.0),
        (7301.0, 25.0, 21.0, 20.0),
    ]


@pytest.mark.parametrize("ratio", [float("nan"), 0.0, -1.0, 1e9, float("inf")])
def test_a_size_that_nobody_believes_changes_nothing(ratio: float) -> None:
    for settings in (gain(mode="recommend"), gain(mode="recommend", exponent=None, value=25.0)):
        assert (
            accommodate_fault("soft", settings, FaultToleranceState(settings.nominal), "press 1", ratio, NOW, NOW)[1]
            is None
        )


def test_an_executed_change_goes_through_a_sink_once_with_a_key(tmp_path: Path) -> None:
    kept = tmp_path / "kept.json"
    argv = [sys.executable, "-c", KEEP, str(kept), "{quantity}", "{value}", "{previous}"]
    section = {
        "command": {"plc": {"argv": argv, "events": []}},
        "tolerance": {"soft": {**GAIN, "mode": "execute", "sink": "plc"}},
    }
    settings = ActionSettings.model_validate(section)
    soft = settings.tolerance["soft"]
    assert transition_entries(settings, NEW, "high", NOW) == ()
    state, change, row = accommodate_fault(
        "soft", soft, FaultToleranceState(soft.nominal), "press 1", 0.9, NOW - 5.0, NOW
    )
    assert change and row and change.executed
    assert change.reason == "pump at 0.9 of healthy"
    assert deliver(row, settings, NOW).delivered
    assert json.loads(kept.read_text())[0] == [str(kept), "k_p", repr(20.0 / 0.9), "20.0"]
    assert accommodate_fault("soft", soft, FaultToleranceState(soft.nominal), "press 1", 0.9, NOW - 5.0, NOW)[2] == row
    _, _, back = accommodate_fault("soft", soft, state, "press 1", None, NOW, NOW)
    assert back and back.key != row.key


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        ({"value": 21.0}, "give value or exponent"),
        ({"nominal": 30.0}, "nominal: 30 must lie between min and max"),
        ({"exponent": None, "value": 30.0}, "value: 30 must lie between min and max"),
        ({"mode": "execute"}, "sink: missing"),
        ({"mode": "execute", "sink": "plc"}, "no webhook, command or mqtt is called 'plc'"),
    ],
)
def test_a_change_without_limits_or_sink_is_refused(wrong: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ValidationError, match=complaint):
        ActionSettings.model_validate({"tolerance": {"soft": {**GAIN, **wrong}}})
    with pytest.raises(StateError, match="tolerance state of version 0"):
        FaultToleranceState.from_dict({"version": 0})
