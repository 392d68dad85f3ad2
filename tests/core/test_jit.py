"""The compiler of kernels: its two backends, how one is chosen, and what the cache of a kernel depends on."""

from __future__ import annotations

import json
import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from servoscope.core.errors import ServoscopeError
from servoscope.core.jit import backend, cache, compile, fma, plain, symbolic
from servoscope.core.jit.cache import kernel_key

PROJECT = Path(__file__).resolve().parents[2]
GOLDEN = PROJECT / "tests" / "golden"

# a short recording through Monitor.run, as one asset and as a fleet, with a gap and a missing value
FOLLOW = """
import sys
import numpy as np
import servoscope as ss
folder, target, single = sys.argv[1:]
baseline = ss.Baseline.load(folder + "/axis.json")
recording = ss.read(folder + "/axis-suspect.parquet", baseline.loop)
r, u, y = (x[:400].copy() for x in (recording.r, recording.u, recording.y))
u[200], restart = np.nan, np.zeros(400, dtype=bool)
restart[300] = True
monitor = ss.Monitor([baseline] * 3, precision="single") if single else ss.Monitor(baseline)
if single:
    r, u, y, restart = (np.tile(x, (3, 1)) for x in (r, u, y, restart))
state, trace = monitor.run(monitor.init(), r, u, y, restart)
arrays = {name: value for name, value in vars(trace).items() if isinstance(value, np.ndarray)}
np.savez(target, state=state, H=trace.ifrf.H, numba="numba" in sys.modules, **arrays)
"""


def python(code: str, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run code in a fresh interpreter."""
    environment = {"PYTHONPATH": str(PROJECT / "src"), **os.environ, **variables}
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=300)


class TestPlain:
    @pytest.mark.parametrize("single", ["", "single"])
    def test_it_follows_a_recording_to_the_same_bits(self, tmp_path: Path, single: str) -> None:
        results = {}
        for choice in ("numba", "plain"):
            target = tmp_path / f"{choice}.npz"
            done = python(FOLLOW, str(GOLDEN), str(target), single, SERVOSCOPE_JIT=choice)
            assert done.returncode == 0, done.stderr
            results[choice] = dict(np.load(target))
            assert bool(results[choice].pop("numba")) == (choice == "numba")
        assert np.isfinite(results["plain"]["statistic"]).all() and len(results["plain"]["t"]) > 10
        for name, expected in results["numba"].items():
            found = results["plain"][name]
            if single and found.dtype.kind == "f":  # numbers of both precisions meet in other places: the last bits
                assert np.allclose(found, expected, rtol=1e-4, atol=1e-5, equal_nan=True), name
            else:
                assert np.array_equal(found, expected, equal_nan=found.dtype.kind in "fc"), name

    def test_both_backends_offer_the_same_and_compute_the_same(self) -> None:
        assert np.array_equal(backend.run_trial(compile), backend.run_trial(plain))

    @pytest.mark.parametrize("function", [fma, symbolic._exact_fma])
    def test_a_multiply_add_is_rounded_once(self, function: Any) -> None:
        a = 1.0 + 2.0**-30
        assert function(a, a, -1.0 - 2.0**-29) == 2.0**-60 != a * a - 1.0 - 2.0**-29
        assert function(3.0, 4.0, -12.0) == 0.0
        assert np.isnan(function(np.inf, 0.0, 1.0)) and function(np.inf, 2.0, 1.0) == np.inf
        single = fma(np.float32(a), np.float32(3.0), 1.0)
        assert single.dtype == np.float32


class TestChoice:
    @pytest.fixture(autouse=True)
    def afresh(self, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
        monkeypatch.delenv(backend.VARIABLE, raising=False)
        # a service that another test ran in this process keeps its log to itself, at a level of its own
        monkeypatch.setattr(logging.getLogger("servoscope"), "propagate", True)
        caplog.set_level("WARNING", logger="servoscope")
        monkeypatch.setattr(backend, "load_backend", backend.load_backend.__wrapped__)

    def test_ci_runs_with_a_tested_release_of_numba(self) -> None:
        assert backend.is_tested(numba.__version__)
        pinned = (PROJECT / "requirements-dev.lock").read_text().split("\nnumba==")[1].split()[0]
        assert backend.is_tested(pinned)
        assert backend.is_tested("0.59.1") and not backend.is_tested("0.58.1") and not backend.is_tested("1.0.0rc1")

    def test_a_tested_release_compiles_without_a_word(self, caplog: pytest.LogCaptureFixture) -> None:
        assert backend.load_backend() is compile
        assert not caplog.records

    def test_an_untested_release_is_tried_with_a_warning_of_one_line(
        self, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        monkeypatch.setattr(numba, "__version__", "7.1.0")
        assert backend.load_backend() is compile
        assert [record.getMessage() for record in caplog.records] == [
            "Numba 7.1.0 is untested, 0.59 to 0.68 are tested"
        ]

    @pytest.mark.parametrize("breaks", [True, False])
    def test_where_the_trial_fails_plain_python_takes_over(
        self, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, breaks: bool
    ) -> None:
        def trial(module: Any) -> Any:
            if breaks and module is compile:
                raise AttributeError("no attribute 'x'\nin Numba")
            return np.ones(2) if module is plain else np.zeros(2)

        monkeypatch.setattr(numba, "__version__", "7.1.0")
        monkeypatch.setattr(backend, "run_trial", trial)
        assert backend.load_backend() is plain
        assert "very slowly" in caplog.messages[-1] and "\n" not in caplog.messages[-1]
        monkeypatch.setenv(backend.VARIABLE, "numba")
        with pytest.raises(ServoscopeError, match="Numba cannot compile kernels"):
            backend.load_backend()

    def test_a_choice_that_is_none(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv(backend.VARIABLE, "off")
        with pytest.raises(ServoscopeError, match="choose from auto, numba, plain"):
            backend.load_backend()

    def test_without_numba_it_says_so_in_one_line_and_goes_on(self, tmp_path: Path) -> None:
        blocked = "import sys; sys.modules['numba'] = None\n" + FOLLOW
        target = str(tmp_path / "x.npz")
        done = python(blocked, str(GOLDEN), target, "")
        assert done.returncode == 0 and len(done.stderr.strip().splitlines()) == 1, done.stderr
        assert "very slowly" in done.stderr
        failed = python(blocked, str(GOLDEN), target, "", SERVOSCOPE_JIT="numba")
        assert (
            failed.stderr.strip().splitlines()[-1].startswith("servoscope.core.errors.ServoscopeError: SERVOSCOPE_JIT")
        )


# keys of kernels of several kinds, and after `compile` which of them were compiled or found
KEYS = """
import json, sys
import numpy as np
from servoscope.core.jit.cache import kernel_key
from servoscope.estimation.estimators import akf, kf, sliding_window
from servoscope.estimation.moments import mean_path
from servoscope.estimation.kernel.build import build_kernels
from servoscope.estimation.recursion import _kernel_spec
from servoscope import Baseline
kernels = {"akf": akf.update, "kf": kf.update, "window": sliding_window.update, "mean_path": mean_path}
baseline = Baseline.load(sys.argv[1] + "/axis.json")
for name in ("akf", "kf"):
    monitor = baseline.loop.monitor.model_copy(update={"estimator": name})
    pipeline = baseline.model_copy(update={"loop": baseline.loop.model_copy(update={"monitor": monitor})}).pipeline()
    spec = _kernel_spec([pipeline.constants(baseline.tuning)])
    kernels["block of " + name] = build_kernels(spec, 1, 1, 0).run_blocks
    kernels["fleet of " + name] = build_kernels(spec, 8, 8, 0).run_blocks
keys = {name: kernel_key(each) for name, each in kernels.items()}
if sys.argv[2:]:
    for each in (akf.update, kf.update):
        one, zero = np.eye(2), np.zeros(2)
        each(zero, one, one, 1.0, 5.0, 1.0, zero, zero, zero, np.zeros(0))
    keys["compiled"] = [sum(each.stats.cache_misses.values()) for each in (akf.update, kf.update)]
print(json.dumps(keys))
"""


class TestCache:
    @pytest.mark.slow
    def test_it_depends_on_code_and_not_on_comments(self, tmp_path: Path) -> None:
        """A comment or a docstring in an estimator compiles nothing anew; a line of it, what contains it."""
        shutil.copytree(PROJECT / "src", tmp_path / "src", ignore=shutil.ignore_patterns("__pycache__", "kernels"))
        package = tmp_path / "src" / "servoscope"

        def keys(*arguments: str) -> dict[str, Any]:
            done = python(KEYS, str(GOLDEN), *arguments, **variables)
            assert done.returncode == 0, done.stderr
            found: dict[str, Any] = json.loads(done.stdout)
            return found

        def changed(path: str, old: str, new: str) -> set[str]:
            """Return the names of the keys that a change of one file changes; it stays."""
            text = (package / path).read_text()
            assert text.count(old) == 1, f"{path}: {old}"
            (package / path).write_text(text.replace(old, new))
            after = keys()
            names = {name for name, key in after.items() if key != before[name]}
            before.update(after)
            return names

        variables = {"PYTHONPATH": str(tmp_path / "src"), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        before = keys("compile")
        assert before.pop("compiled") == [1, 1]
        estimator = "estimation/estimators/kf.py"
        for old, new in (
            ("    n = len(theta)\n", "    # one of them\n\n    n = len(theta)\n"),
            ('    """Take one step of', '    """Do one step of'),
            ('"""Standard Kalman filter', '"""The standard Kalman filter'),
        ):
            assert changed(estimator, old, new) == set()
        assert keys("compile")["compiled"] == [0, 0]
        assert changed(estimator, "P_d[i, j] / memory", "P_d[i, j] / (2.0 * memory)") == {
            "kf", "block of kf", "fleet of kf",
        }  # fmt: skip
        assert keys("compile")["compiled"] == [0, 1]
        blocks = {f"{kind} of {name}" for kind in ("block", "fleet") for name in ("akf", "kf")}
        akf = {"block of akf", "fleet of akf"}
        for path, old, new, names in (
            ("estimation/estimators/akf.py", "1.0 / (R + dot(phi, phi))", "2.0 / (R + dot(phi, phi))", akf),
            ("estimation/moments.py", "* 0.5 - dot", "* 0.25 - dot", blocks),  # a function that traced ones call
            ("estimation/kernel/sample_steps.py", "MAX_PHYSICAL = 1e100", "MAX_PHYSICAL = 1e99", blocks),  # a constant
            ("estimation/kernel/build.py", "(steps.columns + 1) * TILE", "(steps.columns + 2) * TILE", blocks),
            ("estimation/estimators/sliding_window.py", "weakest = 8.0", "weakest = 9.0", {"window"}),
            ("core/jit/compile.py", "CACHE_LINE = 64", "CACHE_LINE = 128", set(before)),
            ("core/jit/vector.py", "width == 1:\n        return one", "width <= 1:\n        return one", set(before)),
        ):
            assert changed(path, old, new) == names, path

    def test_the_key_is_the_same_in_every_process(self) -> None:
        def twice(x: float) -> float:
            return 2.0 * x if x in {1.0, 2.0, 3.0} else FACTOR * x

        assert kernel_key(compile.kernel(twice)) == kernel_key(compile.kernel(twice))
        done = [python(KEYS, str(GOLDEN), PYTHONHASHSEED=seed) for seed in "12"]
        assert done[0].returncode == 0, done[0].stderr
        assert done[0].stdout == done[1].stdout

    def test_a_constant_of_numpy_is_part_of_the_key(self) -> None:
        def kernel_with(constant: np.uint64) -> Any:
            def masked(word: np.uint64) -> np.uint64:
                return word & constant

            return compile.kernel(masked)

        keys = [kernel_key(kernel_with(np.uint64(mask))) for mask in (7, 7, 15)]
        assert keys[0] == keys[1] != keys[2]

    def test_without_a_folder_it_compiles_for_this_process(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(cache: Any, function: Any) -> None:
            raise RuntimeError("cannot cache function: no locator available")

        monkeypatch.setattr(cache.FunctionCache, "__init__", fail)

        def twice(x: float) -> float:
            return 2.0 * x

        assert compile.kernel(twice)(3.0) == 6.0


FACTOR = 3.0
