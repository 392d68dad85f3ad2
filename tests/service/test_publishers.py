"""Files for foreign systems, judged by foreign programs: shells by aas-core and the official test engines."""

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
from servoscope.service.kinds import PUBLISHERS, find_kinds
from servoscope.service.publishers.aas import CONCEPT, TEMPLATE, package, shell

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
