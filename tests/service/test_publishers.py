"""Files for foreign systems, judged by foreign programs: shells by aas-core and the official test engines, a work list
by the CSV reader of another stack."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import pytest
from brokers import until
from test_opcua import STATUS

from servoscope.service.assets.status import AssetStatus, read_status
from servoscope.service.assets.work_items import WorkItem, work_items
from servoscope.service.kinds import PUBLISHERS, find_kinds
from servoscope.service.publishers.aas import CONCEPT, TEMPLATE, AasPublisher, package, shell
from servoscope.service.publishers.worklist import to_csv

ALARM = {"state": "unacknowledged", "since": 1.0, "priority": "high", "cause": "Leakage.", "active": True}
OUTLOOK = {"name": "leakage", "limit": 1.5, "outlook": "forecast", "t": 1767225600.0, "asked": 1767225600.0,
           "reach_t": [1767225600.0 + 864000.0, 1767225600.0 + 1728000.0, None], "rate_per_day": [0.01, 0.02, 0.03],
           "summary": "Limit in 20 days."}  # fmt: skip
FAULT = {"name": "leakage", "parameter": "C_ie", "ratio": 1.2, "interval": [1.1, 1.3]}


# The published template (IDTA 02048, 1.0): kind, type and how often each element comes, and what is in it.
LIFE = {
    "RemainingUsefulLifetime": ("Entity", None, "1", {
        "IndicationType": ("Property", "xs:string", "1", {}), "DurationValue": ("Property", "xs:double", "1", {}),
        "EngineeringUnit": ("Property", "xs:string", "1", {}), "StartValue": ("Property", "xs:double", "1", {}),
        "StartDateTime": ("Property", "xs:dateTime", "?", {}), "Description": ("Property", "xs:string", "?", {}),
    }),
    "RemainingUsfulLifeDateTime": ("Property", "xs:dateTime", "?", {}),
    "ConfidenceInterval": ("Range", "xs:double", "1", {}),
    "ListRULBoundaryConditions": ("SubmodelElementList", None, "1", {
        "RULCondition": ("SubmodelElementCollection", None, "+", {
            "ConditionName": ("Property", "xs:string", "1", {}),
            "IsBoundaryConditionUsedInModel": ("Property", "xs:boolean", "1", {}),
            "BoundaryValueRange": ("Property", "xs:double", "1", {}),
            "BoundaryEngineeringUnit": ("Property", "xs:string", "1", {}),
            "DriftInfoAIModel": ("Range", "xs:double", "?", {}), "MeanValue": ("Property", "xs:double", "?", {}),
            "Standarddeviation": ("Property", "xs:double", "?", {}), "Skewness": ("Property", "xs:double", "?", {}),
            "BoundaryDescription": ("Property", "xs:string", "?", {}),
        }),
    }),
    "PredictionModelInformation": ("SubmodelElementCollection", None, "1", {
        "ModelType": ("Property", "xs:string", "1", {}), "ModelDescription": ("Property", "xs:string", "?", {}),
        "SMAIModelNamePlate": ("ReferenceElement", None, "?", {}),
    }),
    "ListPreAlerts": ("SubmodelElementList", None, "?", {}),
    "AlertAfterExceedingRemainingUsableLife": ("SubmodelElementCollection", None, "?", {
        "AlertMessage": ("Property", "xs:string", "?", {}), "MaintenanceRequired": ("Property", "xs:boolean", "1", {}),
    }),
}  # fmt: skip
Template = dict[str, tuple[str, str | None, str, Any]]


def status(**keys: Any) -> dict[str, Any]:
    evaluation = {"statistic": 3.5, "level": 2.0}
    base = {
        **STATUS, **evaluation, "onset": 1767225580.0, "examined": 1767225590.0, "reasons": ["fault"], "quality": {},
        "faults": [FAULT], "alarms": {"fault": ALARM}, "outlook": OUTLOOK, "diagnosed": 1767225595.0,
    }  # fmt: skip
    return {**base, **keys}


def asset(**keys: Any) -> AssetStatus:
    found = read_status({**status(**keys), "counted": {"began": 0.0, "t": 1767225640.0}})
    assert isinstance(found, AssetStatus)
    return found


CASES = [
    {},
    {"verdict": "healthy", "ne107": "good", "faults": [], "alarms": {}, "reasons": [], "outlook": None, "onset": None},
    {"outlook": {**OUTLOOK, "outlook": "reached", "reach_t": None}},
    {"outlook": {**OUTLOOK, "reach_t": [1767225600.0, None, None]}, "faults": [FAULT, {**FAULT, "name": "friction"}]},
    {"summary": 'Leck <&> "1,2" µm ☃', "reasons": ["a", "b"]},
]


@pytest.mark.parametrize("keys", CASES)
def test_shells_pass_the_official_test_engines(keys: dict[str, Any]) -> None:
    from aas_core3 import jsonization, verification
    from aas_test_engines import file

    environment = shell("press 1/ä", asset(**keys))
    text = json.dumps(environment)
    found = file.check_json_data(json.loads(text))
    assert found.ok(), found.to_lines()
    content = package(text.encode())
    assert content == package(text.encode())
    packed = file.check_aasx_data(zipfile.ZipFile(io.BytesIO(content)))
    assert packed.ok(), packed.to_lines()
    read = jsonization.environment_from_jsonable(json.loads(text))
    assert not list(verification.verify(read))
    assert jsonization.to_jsonable(read) == json.loads(text)


def children(element: dict[str, Any]) -> list[dict[str, Any]]:
    value = element.get("statements", element.get("value", []))
    return value if isinstance(value, list) else []


def compare(elements: list[dict[str, Any]], template: Template) -> None:
    """Compare elements with those of the template by the concepts that they name."""
    names = [element["semanticId"]["keys"][0]["value"] for element in elements]
    known = {CONCEPT.format(name): (name, *rest) for name, rest in template.items()}
    assert set(names) <= set(known)
    for concept, (name, (kind, value_type, count, inside)) in {c: (n, r) for c, (n, *r) in known.items()}.items():
        found = [element for element in elements if element["semanticId"]["keys"][0]["value"] == concept]
        assert len(found) <= 1 if count == "?" else len(found) == 1 if count == "1" else found, name
        for element in found:
            assert (element["modelType"], element.get("valueType")) == (kind, value_type)
            assert element.get("idShort", name) == name
            compare(children(element), inside)


@pytest.mark.parametrize("keys", [CASES[0], CASES[2], CASES[3]])
def test_a_forecast_is_an_instance_of_the_published_template(keys: dict[str, Any]) -> None:
    submodel = shell("press", asset(**keys))["submodels"][1]
    assert submodel["semanticId"]["keys"][0]["value"] == TEMPLATE
    (life,) = submodel["submodelElements"]
    assert life["idShort"] == "RemainingUsefulLifePrediction"
    compare(children(life), LIFE)


def test_a_forecast_has_the_days_and_the_interval_of_the_status() -> None:
    (life,) = shell("press", asset())["submodels"][1]["submodelElements"]
    found = {element["idShort"]: element for element in children(life)}
    duration = {one["idShort"]: one["value"] for one in found["RemainingUsefulLifetime"]["statements"]}
    assert duration["DurationValue"] == "20.0" and duration["EngineeringUnit"] == "d"
    assert (found["ConfidenceInterval"]["min"], found["ConfidenceInterval"]["max"]) == ("10.0", "INF")


def test_files_follow_the_status_and_say_why_they_cannot(tmp_path: Path) -> None:
    kind = find_kinds(PUBLISHERS)["aas"].load()
    outlet = kind(kind="aas", path="shells", every_s=0.05).create("hall.twin", tmp_path)
    stored = {**status(), "counted": {"began": 0.0, "t": 1767225640.0}}
    outlet.open({"press": stored, "hall": {"service": True}})
    file = tmp_path / "shells" / "press.json"
    assert sorted(path.name for path in file.parent.iterdir()) == ["press.aasx", "press.json"]
    outlet.publish({"press": {**stored, "summary": "Gone."}})
    until(lambda: "Gone." in file.read_text())
    file.unlink()
    file.mkdir()
    outlet.publish({"press": stored})
    until(lambda: "is a directory" in outlet.trouble)
    file.rmdir()
    until(lambda: not outlet.trouble and file.is_file())
    outlet.close()
    outlet.close()


def test_only_what_has_changed_is_rendered_and_all_files_are_as_if_everything_were(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Oracle: a publisher that is told of all assets at once."""
    rendered = list[list[str]]()
    render = AasPublisher.render

    def noted(self: AasPublisher, changed: Any) -> Any:
        rendered.append(sorted(changed))
        return render(self, changed)

    monkeypatch.setattr(AasPublisher, "render", noted)
    stored = {**status(), "counted": {"began": 0.0, "t": 1767225640.0}}
    fleet = {name: {**stored, "summary": f"{name} 0"} for name in ("lift", "press", "saw")}
    kind = find_kinds(PUBLISHERS)["aas"].load()
    outlet, oracle = (kind(kind="aas", path=path, every_s=600.0).create("twin", tmp_path) for path in ("one", "all"))
    outlet.open(fleet)
    (tmp_path / "one/press.json").unlink()
    (tmp_path / "one/press.json").mkdir()
    for k, names in enumerate((["press"], ["saw"], ["lift", "saw"]), 1):
        news = {name: {**stored, "summary": f"{name} {k}"} for name in names}
        outlet.publish(news)
        outlet._write()
        fleet |= news
        if k == 2:
            (tmp_path / "one/press.json").rmdir()
    outlet.close()
    # what could not be written is tried again, and nothing when nothing has changed
    assert rendered == [["lift", "press", "saw"], ["press"], ["press", "saw"], ["lift", "press", "saw"], []]
    oracle.open(fleet)
    oracle.close()
    one, every = ({path.name: path.read_bytes() for path in (tmp_path / name).iterdir()} for name in ("one", "all"))
    assert one == every and len(one) == 6


ABOUT = {"group": "hall 2", "faults": {"leakage": "leakage"}, "checks": {"leakage": ["Seals.", "Valve; return line."]}}


def test_a_work_list_says_what_to_check_since_when_how_large_and_how_urgent() -> None:
    data = {"state": "shelved", "since": 5.0, "priority": "medium", "cause": "y is frozen.", "active": True,
            "ne107": "out_of_specification"}  # fmt: skip
    critical = {**ALARM, "priority": "critical", "cause": "The limit is near.", "ne107": "maintenance_required"}
    alarms = {"fault": {**ALARM, "ne107": "maintenance_required"}, "limit": critical, "data_quality": data}
    fault, quality = work_items("press", asset(about=ABOUT, alarms=alarms))
    assert fault == WorkItem(
        key="press:leakage", asset="press", group="hall 2", finding="leakage", since="2025-12-31T23:59:40Z",
        parameter="C_ie", size=1.2, size_low=1.1, size_high=1.3, check=("Seals.", "Valve; return line."),
        urgency="critical", due="2026-01-11T00:00:00Z", ne107="failure",
    )  # fmt: skip
    assert quality[:5] == ("press:data_quality", "press", "hall 2", "y is frozen.", "1970-01-01T00:00:05Z")
    assert (quality.urgency, quality.ne107, quality.size, quality.due) == ("medium", "out_of_specification", None, "")


NOTHING: dict[str, Any] = {"faults": [], "alarms": {}, "outlook": None, "ne107": "good", "verdict": "healthy"}
GONE = {"fault": {**ALARM, "state": "latched_unacknowledged", "active": False}}
OUT = {"fault": {**ALARM, "state": "out_of_service", "ne107": "maintenance_required"}}


@pytest.mark.parametrize(
    ("keys", "found"),
    [
        (NOTHING, []),
        ({**NOTHING, "alarms": GONE}, []),  # nothing to do but to reset it
        ({**NOTHING, "verdict": "suspect", "ne107": "maintenance_required"}, ["suspect low"]),
        ({**NOTHING, "verdict": "fault", "ne107": "failure"}, ["unknown medium"]),
        ({**NOTHING, "verdict": "fault", "ne107": "failure", "alarms": OUT}, ["unknown medium"]),
        ({"faults": [FAULT, {**FAULT, "name": "friction"}]}, ["leakage high", "friction high"]),
    ],
)
def test_whatever_is_not_good_is_on_the_work_list(keys: dict[str, Any], found: list[str]) -> None:
    items = work_items("press", asset(**keys))
    assert [f"{item.key.removeprefix('press:')} {item.urgency}" for item in items] == found
    assert bool(items) == (asset(**keys).ne107 != "good")


def test_a_work_list_is_read_by_others_and_stays_as_it_is_while_only_samples_come(tmp_path: Path) -> None:
    import pyarrow.csv

    kind = find_kinds(PUBLISHERS)["worklist"].load()
    outlet = kind(kind="worklist", path="work", every_s=600.0).create("hall.work", tmp_path)
    low = {"alarms": {"fault": {**ALARM, "priority": "low"}}, "summary": '=Leck, "2"\n<&> µm ☃', "faults": []}
    stored = {name: {**status(about=ABOUT, **keys), "counted": {"began": 0.0, "t": 1767225640.0}}
              for name, keys in {"lift": low, "press": {}, "saw": NOTHING}.items()}  # fmt: skip
    outlet.open({**stored, "hall": {"service": True}})
    files = tmp_path / "work/worklist.csv", tmp_path / "work/worklist.json"
    document = json.loads(files[1].read_text(encoding="utf-8"))
    assert [item["key"] for item in document] == ["press:leakage", "lift:unknown"]  # the most urgent first
    table = pyarrow.csv.read_csv(files[0], parse_options=pyarrow.csv.ParseOptions(newlines_in_values=True))
    rows = table.to_pylist()
    assert table.column_names == list(WorkItem._fields) == list(document[0])
    assert [row["size_high"] for row in rows] == [1.3, None] and rows[0]["check"] == "Seals.; Valve; return line."
    assert rows[1]["finding"] == "'" + low["summary"]  # no formula in a spreadsheet
    times = [path.stat().st_mtime_ns for path in files]
    outlet.publish({"press": {**stored["press"], "counted": {"began": 0.0, "t": 1767225700.0}}})
    outlet._write()
    assert [path.stat().st_mtime_ns for path in files] == times
    outlet.publish({name: {**stored[name], **NOTHING} for name in ("lift", "press")})
    outlet.close()
    assert files[0].read_bytes() == to_csv([]).encode() and json.loads(files[1].read_text()) == []


def test_a_size_without_an_upper_bound_is_an_open_interval(tmp_path: Path) -> None:
    """The store keeps an infinite end as null."""
    fault = {"name": "leakage", "parameter": "C_ie", "ratio": 3.0, "interval": [0.5, None]}
    stored = {**status(), "counted": {"began": 0.0, "t": 1767225640.0}, "verdict": "fault", "faults": [fault]}
    for kind in ("aas", "ros2", "worklist"):
        outlet = find_kinds(PUBLISHERS)[kind].load()(kind=kind, path=kind, every_s=600.0).create("twin", tmp_path)
        outlet.open({"press": stored})
        outlet.close()
    (item, *_) = json.loads((tmp_path / "worklist" / "worklist.json").read_text())
    assert (item["size_low"], item["size_high"]) == (0.5, None)
    assert '"max": "INF"' in (tmp_path / "aas" / "press.json").read_text()
