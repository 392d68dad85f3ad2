"""The condition of each asset as an Asset Administration Shell (AAS 3.0): JSON, and the same in an AASX package.

Two submodels: the condition, described in the documentation, and the forecast as an instance of the published template
IDTA 02048 (predictive maintenance), where there is one.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

from servoscope.core.settings import NonEmptyStr
from servoscope.service.assets.outlook import DAY_S, Outlook
from servoscope.service.assets.status import AssetStatus
from servoscope.service.publishers.files import FilesPublisher, FilesSettings

CONDITION = "urn:servoscope:submodel:Condition:1:0"
TEMPLATE = "https://admin-shell.io/idta/SubmodelTemplate/PredictiveMaintenance/1/0"
CONCEPT = "https://admin-shell.io/idta/PredictiveMaintenance/{0}/1/0"
OPC = "http://schemas.openxmlformats.org/package/2006"
AASX = "http://admin-shell.io/aasx/relationships"
ZIP_DATE = (1980, 1, 1, 0, 0, 0)  # the same content has the same bytes
Element = dict[str, Any]


class AasSettings(FilesSettings):
    """An outlet of kind ``aas``: the files ``ASSET.json`` and ``ASSET.aasx``."""

    kind: Literal["aas"]
    # what the identifiers of shells, assets and submodels begin with; the asset's name follows
    prefix: NonEmptyStr = "urn:servoscope"

    def create(self, name: str, folder: Path) -> AasPublisher:
        """Return the publisher."""
        return AasPublisher(self, folder)


class AasPublisher(FilesPublisher):
    """Keeps a shell for each asset."""

    def __init__(self, settings: AasSettings, folder: Path) -> None:
        super().__init__(folder / settings.path, settings.every_s)
        self._prefix = settings.prefix

    def render(self, changed: Mapping[str, AssetStatus]) -> Mapping[str, bytes]:
        """Return the two files of each asset that has changed."""
        files: dict[str, bytes] = {}
        for name, status in changed.items():
            file = quote(name, safe="")
            environment = json.dumps(shell(name, status, self._prefix), indent=1).encode()
            files |= {f"{file}.json": environment, f"{file}.aasx": package(environment)}
        return files


def shell(name: str, status: AssetStatus, prefix: str = "urn:servoscope") -> Element:
    """Return the environment of an asset: its shell and its submodels."""
    identifier = f"{prefix}:{quote(name, safe='')}"
    submodels = [_submodel(f"{identifier}:condition", "Condition", CONDITION, _condition(status))]
    if status.outlook is not None and status.outlook.outlook != "none":
        life = [_collection("RemainingUsefulLifePrediction", _life(status.outlook), concepts=True)]
        submodels.append(_submodel(f"{identifier}:forecast", "PredictiveMaintenance", TEMPLATE, life))
    return {
        "assetAdministrationShells": [
            {
                "modelType": "AssetAdministrationShell",
                "id": f"{identifier}:aas",
                "assetInformation": {"assetKind": "Instance", "globalAssetId": identifier},
                "submodels": [_reference("ModelReference", "Submodel", submodel["id"]) for submodel in submodels],
            }
        ],
        "submodels": submodels,
    }


def _condition(status: AssetStatus) -> list[Element]:
    faults, sized = status.newest_sizes
    return [
        _property("Verdict", status.verdict),
        _property("Summary", status.summary),
        _property("Since", _time(status.since), "dateTime"),
        *_times(Onset=status.onset, Examined=status.examined, Sized=sized),
        _property("LastSample", _time(status.position.t), "dateTime"),
        _property("NE107", status.ne107),
        *_list("Reasons", [_value("Property", "xs:string", value=reason) for reason in status.reasons], "Property"),
        *_list(
            "Faults",
            [
                _collection(
                    None,
                    [
                        _property("Name", fault.name),
                        _property("Parameter", fault.parameter),
                        _property("Ratio", fault.ratio, "double"),
                        _range("Interval95", *fault.interval),
                    ],
                )
                for fault in faults
            ],
        ),
        *_list(
            "Alarms",
            [
                _collection(
                    None,
                    [
                        _property("Name", alarm_name),
                        _property("State", alarm.state.value),
                        _property("Since", _time(alarm.since), "dateTime"),
                        *([_property("Priority", alarm.priority)] if alarm.priority else []),
                        *([_property("Cause", alarm.cause)] if alarm.cause else []),
                    ],
                )
                for alarm_name, alarm in status.alarms.items()
            ],
        ),
    ]


def _life(outlook: Outlook) -> list[Element]:
    """Return the elements of a prediction of the remaining useful life, in days from the newest size on."""
    reach = outlook.reach_t if outlook.outlook == "forecast" and outlook.reach_t else (outlook.t,) * 3
    low, median, high = (float("inf") if t is None else (t - outlook.t) / DAY_S for t in reach)
    condition = [
        _property("ConditionName", outlook.name),
        _property("IsBoundaryConditionUsedInModel", True, "boolean"),
        _property("BoundaryValueRange", outlook.limit, "double"),
        _property("BoundaryEngineeringUnit", "ratio to healthy"),
    ]
    alert = [
        _property("AlertMessage", outlook.summary),
        _property("MaintenanceRequired", outlook.outlook == "reached", "boolean"),
    ]
    lifetime = [
        _property("IndicationType", "time"),
        _property("DurationValue", median, "double"),
        _property("EngineeringUnit", "d"),
        _property("StartValue", 0.0, "double"),
        _property("StartDateTime", _time(outlook.t), "dateTime"),
    ]
    entity = {"modelType": "Entity", "idShort": "RemainingUsefulLifetime", "entityType": "CoManagedEntity"}
    until = [] if reach[1] is None else [_property("RemainingUsfulLifeDateTime", _time(reach[1]), "dateTime")]
    conditions = [_collection(None, condition) | {"semanticId": _concept("RULCondition")}]
    return [
        entity | {"statements": [_with_concept(element) for element in lifetime]},
        *until,  # spelt as in the template
        _range("ConfidenceInterval", low, high),
        *_list("ListRULBoundaryConditions", conditions, concepts=True),
        _collection("PredictionModelInformation", [_property("ModelType", "hybrid")], concepts=True),
        _collection("AlertAfterExceedingRemainingUsableLife", alert, concepts=True),
    ]


def _submodel(identifier: str, name: str, kind: str, elements: list[Element]) -> Element:
    semantic = _reference("ModelReference", "Submodel", kind)
    meta = {"modelType": "Submodel", "id": identifier, "idShort": name, "kind": "Instance", "semanticId": semantic}
    return meta | {"submodelElements": elements}


def _value(kind: str, value_type: str, **values: Any) -> Element:
    return {"modelType": kind, "valueType": value_type} | {key: _text(value) for key, value in values.items()}


def _property(name: str, value: Any, kind: str = "string") -> Element:
    return {"idShort": name, **_value("Property", f"xs:{kind}", value=value)}


def _range(name: str, low: float, high: float) -> Element:
    return {"idShort": name, **_value("Range", "xs:double", min=low, max=high)}


def _collection(name: str | None, elements: Iterable[Element], *, concepts: bool = False) -> Element:
    named = {} if name is None else {"idShort": name}
    inside = [_with_concept(element) if concepts else element for element in elements]
    return {"modelType": "SubmodelElementCollection", **named, "value": inside} | (
        {"semanticId": _concept(name)} if concepts and name else {}
    )


def _list(
    name: str, elements: list[Element], kind: str = "SubmodelElementCollection", *, concepts: bool = False
) -> list[Element]:
    """Return a list of elements; none where it would be empty, which AAS does not allow."""
    if not elements:
        return []
    if concepts:
        for element in elements:
            element["value"] = [_with_concept(inner) for inner in element["value"]]
    typed = {"valueTypeListElement": "xs:string"} if kind == "Property" else {}
    return [
        {"modelType": "SubmodelElementList", "idShort": name, "typeValueListElement": kind, **typed, "value": elements}
    ]


def _with_concept(element: Element) -> Element:
    """Return an element of the published template with the identifier of its concept."""
    return {"semanticId": _concept(element["idShort"]), **element}


def _concept(name: str) -> Element:
    return _reference("ExternalReference", "GlobalReference", CONCEPT.format(name))


def _reference(kind: str, key: str, value: str) -> Element:
    return {"type": kind, "keys": [{"type": key, "value": value}]}


def _times(**times: float | None) -> list[Element]:
    return [_property(name, _time(t), "dateTime") for name, t in times.items() if t is not None]


def _time(t: float) -> str:
    return datetime.fromtimestamp(t, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _text(value: Any) -> str:
    """Return a value as XML Schema writes it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return {"inf": "INF", "-inf": "-INF", "nan": "NaN"}.get(repr(value), repr(value))
    return str(value)


def package(environment: bytes) -> bytes:
    """Return an environment in JSON as an AASX package (IEC 63278-5)."""
    start, types = '<?xml version="1.0" encoding="utf-8"?>\n', f"{OPC}/content-types"
    defaults = (("rels", "application/vnd.openxmlformats-package.relationships+xml"), ("json", "application/json"))
    plain = '<Override PartName="/aasx/aasx-origin" ContentType="text/plain"/>'
    listed = "".join(f'<Default Extension="{suffix}" ContentType="{kind}"/>' for suffix, kind in defaults)

    def relationship(kind: str, target: str) -> str:
        inner = f'<Relationship Id="r1" Type="{AASX}/{kind}" Target="{target}"/>'
        return f'{start}<Relationships xmlns="{OPC}/relationships">{inner}</Relationships>'

    parts: dict[str, str | bytes] = {
        "[Content_Types].xml": f'{start}<Types xmlns="{types}">{listed}{plain}</Types>',
        "_rels/.rels": relationship("aasx-origin", "/aasx/aasx-origin"),
        "aasx/aasx-origin": "Intentionally empty.",
        "aasx/_rels/aasx-origin.rels": relationship("aas-spec", "/aasx/data.json"),
        "aasx/data.json": environment,
    }
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as archive:
        for path, content in parts.items():
            archive.writestr(zipfile.ZipInfo(path, ZIP_DATE), content, zipfile.ZIP_DEFLATED)
    return held.getvalue()
