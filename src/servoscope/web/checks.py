"""What to check on an asset: for each fault that is suspected, its owner's own text, else that of its loop or plant."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable

import sqlalchemy as sa
from starlette.exceptions import HTTPException

from servoscope.core.errors import BaselineError
from servoscope.core.messages import translate
from servoscope.diagnosis.change_words import fault_label
from servoscope.diagnosis.checks import suspects
from servoscope.machines.kinds import load_cached
from servoscope.machines.protocol import Machine
from servoscope.service.assets.condition import asset_condition
from servoscope.service.assets.status import AssetStatus
from servoscope.service.store import Row, tables
from servoscope.service.store.series import read_checks
from servoscope.web.dependencies import Context
from servoscope.web.routes.baselines import asset_baseline_id, find_baseline
from servoscope.web.schemas.responses import FaultCheck
from servoscope.web.stored_diagnosis import read_diagnosis


def last_full_diagnosis(context: Context, asset: str) -> Row | None:
    """Return the row of the last full diagnosis of an asset that found a fault."""
    table = tables.diagnoses
    query = sa.select(table).where(table.c.asset == asset, table.c.grounds == "full", table.c.verdict == "fault")
    rows = context.store.fetch(query.order_by(table.c.number.desc()).limit(1))
    return rows[0] if rows else None


def asset_checks(context: Context, asset: str, status: AssetStatus, row: Row | None) -> list[FaultCheck]:
    """Return what to check, by fault; `row`: its last full diagnosis. Nothing without a fault that is open."""
    if not asset_condition(status).is_open:
        return []
    diagnosis = read_diagnosis(row["document"]) if row is not None else None
    names = [fault.name for fault in status.faults] or (suspects(diagnosis.current) if diagnosis is not None else ())
    checks = fault_checks(context, asset, asset_machine(context, asset), names)
    if not any(check.texts for check in checks) and diagnosis is not None:  # its baseline is not here any more
        return [FaultCheck(fault="", label="", texts=[str(text) for text in diagnosis.checks])]
    return checks


def fault_checks(context: Context, asset: str, machine: Machine | None, names: Iterable[str]) -> list[FaultCheck]:
    """Return what to check on an asset for each of these faults."""
    own, checks = read_checks(context.store, asset), []
    for name in names:
        row = own.get(name, {})
        texts = row.get("texts") or [str(text) for text in (machine.checks(name) if machine is not None else ())]
        who = {"who": row["who"], "at": row["at"]} if row.get("texts") else {}
        checks.append(FaultCheck(fault=name, label=translate(fault_label(name)), texts=texts, **who))
    return checks


def asset_machine(context: Context, asset: str) -> Machine | None:
    """Return the machine that an asset is compared with; None where its baseline is not here."""
    id_ = asset_baseline_id(context, asset)
    if id_ is None:
        return None
    with contextlib.suppress(HTTPException, BaselineError):
        return load_cached(find_baseline(context, id_).path)
    return None
