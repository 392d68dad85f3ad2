"""Baselines on their way from who relearned them to the service: the store has them, and files are what it exports."""

from __future__ import annotations

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.history import read_history, replace_baseline
from servoscope.baseline.records import RENEWALS
from servoscope.core.errors import BaselineError
from servoscope.core.texts import MAX_TEXT_CHARS
from servoscope.service.config import ServiceFile
from servoscope.service.store import Row, Store
from servoscope.service.store.rows import BASELINE_NOTE

PIECE_CHARS = MAX_TEXT_CHARS  # of its JSON: so much of a text goes into the store as it is


def announce_baseline(config: ServiceFile, store: Store, asset: str, after: int, baseline: Baseline, t: float) -> None:
    """Put a baseline in the place of number `after` from `t` [UTC s] on: baseline, note and command in one transaction.

    The file is exported then, or by the service if that does not succeed. Raises BaselineError if another one was put
    in force meanwhile.
    """
    revision, path = baseline.revision, config.baseline_file(asset)
    text = f"baseline {revision.number} ({revision.kind}){': ' if revision.why else ''}{revision.why}"[:200]
    note = {"t": t, "text": text, "anew": revision.kind in (*RENEWALS, "back"), "kind": BASELINE_NOTE}
    whole = baseline.to_text()
    pieces = [whole[begin : begin + PIECE_CHARS] for begin in range(0, len(whole), PIECE_CHARS)]

    def check(pending: Row | None) -> None:
        before = Baseline.load(path) if pending is None else stored_baseline(asset, pending)
        if before.revision.number != after:
            raise BaselineError(f"{asset}: another baseline was put in force meanwhile, look at a new preview")

    store.add_baseline(revision.who, asset, note, {"why": revision.why, "baseline": pieces}, check)
    export_baseline(config, asset, baseline)


def stored_baseline(asset: str, document: Row) -> Baseline:
    """Return the baseline that a command asks to take; raises BaselineError if it is damaged."""
    return Baseline.parse("".join(document["baseline"]), f"baseline of {asset} in the store")


def export_baseline(config: ServiceFile, asset: str, baseline: Baseline) -> None:
    """Write a baseline of the store into the asset's own file, unless that is there or in its history already.

    The service file's baseline stays as it is. Raises BaselineError if the file is of another history, OutputError if
    it cannot be written.
    """
    own, path = config.relearned_file(asset), config.baseline_file(asset)
    present, revision = Baseline.load(path), baseline.revision
    if present.revision.number >= revision.number:
        known = read_history(path).get(revision.number)
        if known is None or known.hash != baseline.hash:
            raise BaselineError(f"{asset}: {path.name} is another baseline by now, look at a new preview")
        return
    if not own.exists():
        present.save(own)
    replace_baseline(own, baseline)
