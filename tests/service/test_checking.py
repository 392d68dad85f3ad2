"""What actions of a service file name has to be there before it runs, and is found from wherever it is run."""

from __future__ import annotations

from pathlib import Path

import halls
import pytest
from commands import one_line, run

from servoscope.service.actions import ActionSettings

TOOL = '[actions.command.tool]\nargv = ["true"]\n'
HOOK = '[actions.webhook.desk]\nurl = "http://127.0.0.1:9/"\n'
CHANGE = """[actions.tolerance.softer]
assets = ["press"]
fault = "pmp"
quantity = "k_p"
kind = "gain"
nominal = 1.0
value = 1.0
min = 1.0
max = 1.0
max_step = 1.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("hall")
    halls.files(made)
    return made


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (TOOL + 'assets = ["pres"]', "[actions] command.tool.assets: there is no asset 'pres', did you mean 'press'?"),
        (TOOL + 'alarms = ["falt"]', "[actions] command.tool.alarms: there is no alarm 'falt', did you mean 'fault'?"),
        ('[actions.command.x]\nargv = ["./none.sh"]', "none.sh that can be run, give its path"),
        (
            HOOK + 'secret_env = "NO_SUCH_SECRET"',
            "webhook.desk.secret_env: the environment variable NO_SUCH_SECRET holds",
        ),
        (HOOK + 'secret_file = "none"', "webhook.desk.secret_file: "),
        (CHANGE, "tolerance.softer.fault: there is no fault of press 'pmp', did you mean 'pump'?"),
        (CHANGE.replace("press", "dock"), "tolerance.softer.assets: there is no asset 'dock'"),
    ],
)
def test_what_is_not_there_is_told_before_the_first_alarm(folder: Path, more: str, said: str) -> None:
    one_line(run("run", halls.hall(folder, "wrong", more=more), "--check"), "wrong.toml: [actions] ", said)


def test_programs_and_secrets_are_sought_beside_the_service_file(
    folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (folder / "tool.sh").write_text("#!/bin/sh\n")
    (folder / "tool.sh").chmod(0o755)
    (folder / "secret").write_text("hush")
    monkeypatch.chdir(tmp_path)
    config = halls.hall(folder, "beside", more=TOOL.replace("true", "./tool.sh") + HOOK + 'secret_file = "secret"')
    assert run("run", config, "--check").code == 0
    settings = ActionSettings.model_validate({"command": {"a": {"argv": ["page", "x/y"]}}})
    assert settings.command["a"].program(folder) == "page"
