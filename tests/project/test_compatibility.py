"""What version 0.1.0 wrote is still read, and still leads to the same: baselines, stores, settings, results, names."""

from __future__ import annotations

import gzip
import importlib
import importlib.util
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import servoscope as ss
from golden import results
from golden.results import FOLDER
from servoscope.baseline.version_2 import GROUPS, group_flat_fields
from servoscope.signals.quality.monitor import STATE_SIZE
from servoscope.simulation import FaultEvent, reference, simulate

# Keys of JSON whose strings have a meaning; all others are wording, which may change.
WORDS = {"verdict", "name", "parameter", "kind", "recording", "point", "asset", "alarm", "before", "after", "grounds"}
WORDS |= {"event", "priority", "unit", "loop", "magic", "baseline", "defect"}
# Keys of results that came later than version 0.1.0.
ADDED = {
    *(
        "checks",
        "said",
        "headline",
        "reasons",
        "intervals",
        "began",
        "zone",
        "description",
        "sensors",
        "provenance",
        "instrument",
        "features",
        "left_out",
    ),
    # of the service: how samples come in, blocks left out for their time stamps, clocks of a fault that stands
    *("reception", "late", "future", "fault_at", "diagnosed", "size", "sized", "source", "signature"),
    "baseline",  # of each row of a diagnosis
}
# Where version 0.1.0 fitted a delay of noise, the likelihood says 0 [s].
TOLERANCE = {"delay_s": 1e-4}
# A size by the recursion counts the uncertainty of the healthy value only as far as the size has changed: it is some
# percent narrower than in version 0.1.0. Explanations that were rejected start from these sizes, and end elsewhere:
# closer to their own minimum, by 0.07 %.
# The search for the actuator behind corrected coefficients ends closer to the minimum than it did.
RELATIVE = {"/refit/recursive/": 0.05, "/candidates/": 1e-3, "/parameters/": 1e-5, "/ifrf/": 1e-5}
# But for the errors, which were `servoscope.errors`: their base is `servoscope.ServoscopeError`.
PUBLIC = (FOLDER / "names.txt").read_text(encoding="utf-8").split()
WITH_SPARK = ("servoscope.fleet.sinks.start",)


def stored(name: str) -> Any:
    return json.loads(gzip.decompress((FOLDER / f"{name}.json.gz").read_bytes()))


FROZEN = stored("digests")
# Filters, discrete models and solutions of equations come from libm and LAPACK, whose last bits may differ from CPU to
# CPU. Where they are those of the machine that wrote the files, all results have to be the same to the last bit; on
# others a rounding error more or less is allowed, which iterations (learning, refits) make larger; measured with a BLAS
# for another CPU, learning ends within 2e-6.
SAME_MACHINE = results.arithmetic() == FROZEN["arithmetic"]
EXACT, ITERATED = (1e-9, 1e-6) if SAME_MACHINE else (1e-4, 1e-4)


def named(records: list[Any]) -> dict[str, Any]:
    """Return records by their names; empty if they have none, or one stands twice."""
    by_name = {each["name"]: each for each in records if isinstance(each, dict) and "name" in each}
    return by_name if len(by_name) == len(records) else {}


def differences(found: Any, expected: Any, rel: float, where: str = "") -> list[str]:
    """Return where two JSON documents differ: in keys, numbers, or strings with a meaning."""
    key = where.rpartition("/")[2]
    if isinstance(expected, dict) and isinstance(found, dict):
        told = [f"{where}/{name}: only in one" for name in expected.keys() ^ (found.keys() - (ADDED - expected.keys()))]
        both = expected.keys() & found.keys()
        return told + [
            line for name in both for line in differences(found[name], expected[name], rel, f"{where}/{name}")
        ]
    if isinstance(expected, list) and isinstance(found, list):
        if all(isinstance(each, str) for each in (*expected, *found)) and key not in WORDS:
            return []  # sentences
        ours, theirs = named(found), named(expected)
        if ours and theirs:  # a fault that came later may be among ours
            return differences({name: ours[name] for name in ours.keys() & theirs.keys()}, theirs, rel, where)
        if len(found) != len(expected):
            return [f"{where}: {len(found)} entries, not {len(expected)}"]
        pairs = enumerate(zip(found, expected, strict=True))
        return [line for i, (a, b) in pairs for line in differences(a, b, rel, f"{where}/{i}")]
    if isinstance(expected, str) and isinstance(found, str):
        return [f"{where}: {found!r}, not {expected!r}"] if key in WORDS and found != expected else []
    numbers = [isinstance(each, int | float) and not isinstance(each, bool) for each in (found, expected)]
    rel = max(rel, *(each for part, each in RELATIVE.items() if part in where), 0.0)
    if all(numbers):
        return (
            []
            if math.isclose(found, expected, rel_tol=rel, abs_tol=TOLERANCE.get(key, 1e-12 * rel))
            else [f"{where}: {found}, not {expected}"]
        )
    return [] if type(found) is type(expected) and found == expected else [f"{where}: {found!r}, not {expected!r}"]


def resolved(dotted: str) -> Any:
    """Return what a dotted name means: the longest module in it, and attributes from there."""
    words = dotted.split(".")
    found = importlib.import_module(words[0])
    for i, word in enumerate(words[1:], 2):
        if not hasattr(found, word):
            importlib.import_module(".".join(words[:i]))
        found = getattr(found, word)
    return found


@pytest.mark.parametrize("dotted", PUBLIC)
def test_a_public_name_is_where_it_was(dotted: str) -> None:
    assert resolved(dotted) is not None


@pytest.mark.parametrize("dotted", WITH_SPARK)
def test_a_public_name_that_needs_spark_is_where_it_was(dotted: str) -> None:
    if importlib.util.find_spec("pyspark") is None:
        pytest.skip("pyspark is missing: pip install 'servoscope[spark]'")
    assert callable(resolved(dotted))


@pytest.mark.parametrize("name", sorted(stored("loops")))
def test_an_old_loop_file_means_the_same(name: str) -> None:
    """But for the step of the sequential test, which is another one where a loop file says nothing."""
    loop, expected = ss.Loop.load(FOLDER / name), stored("loops")[name]
    assert ss.Loop.from_dict(expected["loop"]) == loop
    step = loop.monitor.sequential_step
    assert loop.to_dict() == expected["loop"] | {"monitor": expected["loop"]["monitor"] | {"sequential_step": step}}
    monitor = loop.monitor.model_copy(update={"sequential_step": "update"})
    assert loop.model_copy(update={"monitor": monitor}).hash() == expected["hash"]


@pytest.mark.parametrize("name", ["rig.json", "axis.json", "points.json", "rig-2.json"])
def test_an_old_baseline_is_read_and_nothing_of_it_is_lost(name: str, tmp_path: Path) -> None:
    """Files of version 2, by 0.1.0 and, `rig-2.json`, by the last program that wrote it: fields are grouped since."""
    baseline = ss.Baseline.load(FOLDER / name)
    assert {one.loop.monitor.sequential_step for one in baseline.per_point} == {
        "evaluation" if name == "rig-2.json" else "update"
    }
    baseline.save(tmp_path / name)
    written, old = (json.loads((folder / name).read_text()) for folder in (tmp_path, FOLDER))
    assert (old["version"], written["version"]) == (2, 3)
    assert ss.Baseline.load(tmp_path / name) == baseline
    for one, flat in zip((written, *written["others"]), (old, *old.get("others", ())), strict=True):
        expected = group_flat_fields({key: value for key, value in flat.items() if key != "others"})
        for key in expected.keys() - {"version"}:
            ours = {field: one[key][field] for field in expected[key]} if key in GROUPS else one[key]
            assert differences(ours, expected[key], 0.0) == [], key


@pytest.mark.slow
def test_a_baseline_of_version_2_diagnoses_as_before() -> None:
    baseline = ss.Baseline.load(FOLDER / "rig-2.json")
    r = reference("multisine", 40.0, baseline.loop.sample_rate)
    healthy, _ = simulate(baseline.loop, r, seed=7)
    faulty, _ = simulate(baseline.loop, r, seed=8, faults=[FaultEvent("C_ie", 1.3, 20.0)])
    assert ss.diagnose(baseline, healthy).verdict == "healthy"
    (fault,) = ss.diagnose(baseline, faulty).faults
    assert (fault.parameter, fault.ratio) == ("C_ie", pytest.approx(1.3, rel=0.01))


def test_a_baseline_of_several_points_with_a_labelled_fault_has_them() -> None:
    baseline = ss.Baseline.load(FOLDER / "points.json")
    assert baseline.points == ("cold", "warm")
    assert [fault.name for fault in baseline.at("cold").learned] == ["wear"]


def test_an_old_service_file_is_accepted(tmp_path: Path) -> None:
    for name in ("service.toml", "rig.json", "points.json", "healthy.parquet", "suspect.parquet"):
        shutil.copy(FOLDER / name, tmp_path / name)
    (tmp_path / "password").write_text("correct horse battery\n", encoding="utf-8")
    add = ("users", "add", "otto", "--role", "operator", "--users", "users.json", "--password-stdin")
    results.command(tmp_path, *add, told="correct horse battery\n")
    assert "can be used" in results.command(tmp_path, "run", "service.toml", "--check")


@pytest.mark.slow
def test_a_monitor_says_the_same_to_the_last_bit(tmp_path: Path) -> None:
    """But for `iv-akf`, whose trace is that of its symmetric gain: version 0.1.0 skipped samples, which was a bias."""
    kept, seen = np.load(FOLDER / "traces.npz"), set()
    for what, fleet, arrays in results.traces(tmp_path):
        seen.add(what)
        assert set(arrays) == set(FROZEN["traces"][what])
        for key, array in arrays.items():
            some, expected = results.thin(key, array, fleet), kept[f"{what}|{key}"]
            if SAME_MACHINE:
                assert np.array_equal(some, expected, equal_nan=expected.dtype.kind in "fc"), f"{what}: {key}"
                assert results.digest(array) == FROZEN["traces"][what][key], f"{what}: {key}"
            else:
                rel = 1e-3 if what == "fleet single" else 1e-6
                size = np.abs(expected[np.isfinite(expected)]).max(initial=0.0)
                np.testing.assert_allclose(some, expected, rtol=rel, atol=rel * size, err_msg=f"{what}: {key}")
    assert seen == set(FROZEN["traces"])


# since 2.0: what the motion explains of u sets the cutoff, not the widest band of coherence; recordings have a hash;
# a grid of more than 2^17 levels is how single precision is stored, no sensor's
INTENDED = {
    "inspect": [
        "/0/quantisation/1/effective_bits: None, not 19.526241319061562",
        "/0/quantisation/1/step: None, not 9.5367431640625e-07",
    ],
    "inspect-axis": [
        "/0/quantisation/1/effective_bits: None, not 17.271709219263947",
        "/0/quantisation/1/step: None, not 0.0009765625",
        "/0/quantisation/2/effective_bits: None, not 17.304360235083713",
        "/0/quantisation/2/step: None, not 2.384185791015625e-07",
        "/0/suggested_cutoff_hz: 9.4, not 2.5",
    ],
    "learn": ["/0/sources/healthy.parquet/hash: only in one"],
}


@pytest.mark.parametrize("name", sorted(results.COMMANDS))
def test_a_command_prints_the_same_numbers(name: str, tmp_path: Path) -> None:
    rel = ITERATED if name.startswith("diagnose") else EXACT
    found = differences(results.documents(name, tmp_path), stored("commands")[name], rel)
    assert sorted(found) == INTENDED.get(name, [])


def test_a_diagnosis_from_python_is_that_of_the_command() -> None:
    baseline = ss.Baseline.load(FOLDER / "rig.json")
    said = ss.diagnose(baseline, ss.read(FOLDER / "suspect.parquet", baseline.loop))
    expected = stored("commands")["diagnose"][1]
    assert differences(said.model_dump(mode="json"), expected, ITERATED) == []
    old = ss.Diagnosis.model_validate_json(json.dumps(expected))
    assert differences(old.model_dump(mode="json"), expected, 0.0) == []
    assert (old.summary, list(old.explanation)) == (expected["summary"], expected["explanation"])
    assert old.intervals[0].candidates == old.candidates and old.headline.key == "text"


def test_the_history_of_an_old_store_can_be_read(tmp_path: Path) -> None:
    results.hall(tmp_path, FOLDER / "history.sqlite.gz")
    assert differences(results.history(tmp_path), stored("history-halfway"), 0.0) == []
    rows = [json.loads(line) for line in results.command(tmp_path, "history", "hall.toml", "--json").splitlines()]
    assert len(rows) == len(stored("history-halfway")["diagnoses"])
    shown = json.loads(results.command(tmp_path, "watch", "history.sqlite", "--json"))
    assert {row["asset"] for row in shown} >= {"press", "lift"}


def test_a_service_goes_on_from_an_old_store_and_ends_as_it_did(tmp_path: Path) -> None:
    results.hall(tmp_path, FOLDER / "history.sqlite.gz")
    results.command(tmp_path, "run", "hall.toml")
    found, expected = results.history(tmp_path), stored("history")
    for asset, state in expected["states"].items():
        ours, theirs = found["states"][asset].pop("numbers"), state.pop("numbers")
        # since 2.0: data quality, whose version comes first, counts the changes of u in two numbers
        ours = [*ours[:-STATE_SIZE], 1.0, *ours[1 - STATE_SIZE : -2]]
        # Sums near zero are among them, of which rounding elsewhere changes any number of digits.
        assert ours == theirs if SAME_MACHINE else len(ours) == len(theirs), asset
        state["document"]["judged"]["control"] = None  # kept from 1.1 on
    added = ("ne107", "active")  # to the alarms of a status, from 2.0 on
    alarms = [alarm for one in found["checkpoints"] for alarm in one["status"].get("alarms", {}).values()]
    assert alarms and all(alarm.pop(key) is not None for alarm in alarms for key in added)
    assert differences(found, expected, ITERATED) == []
    verdicts = [row["verdict"] for row in found["diagnoses"] if row["asset"] == "press" and row["grounds"] == "full"]
    assert verdicts == ["fault"]
