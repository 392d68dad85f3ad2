"""An asset's baseline relearned from the samples in the store: how far it is, a preview, and how it is put in force."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.history import history_folder, restore_parent
from servoscope.baseline.records import Occasion
from servoscope.core.errors import BaselineError, RecordingError
from servoscope.core.files import make_folder
from servoscope.core.messages import Message, message
from servoscope.learning.detectability import forecast_changes
from servoscope.prognosis.series import NORMAL_95
from servoscope.service.assets.examination import blocks_to_recording
from servoscope.service.assets.status import MIN_LEARN_S, AssetStatus
from servoscope.service.baselines import announce_baseline
from servoscope.service.config import ServiceFile
from servoscope.service.sources.block import Block
from servoscope.service.store import Store
from servoscope.service.store.rows import BASELINE_NOTE, CONFIRMATION, NOTE
from servoscope.service.store.series import read_notes, read_series
from servoscope.signals import Recording, readers
from servoscope.signals.writers import plain_columns, write_recording

OFFERED_RECORDINGS = 1, 10  # further ones whose gain is stated
MAX_OFFERED_RATIO = 0.95  # of a smallest detectable change, that is worth an offer
JUDGED_AGAIN_S = 28 * 86400.0  # of past values that a preview judges again [s]


class LearningProgress(BaseModel):
    """How far an asset is after what was announced: `after` and `since` of the note, None where there is none."""

    after: Occasion | None
    since: float | None  # [UTC s]
    learned_s: float  # samples since then
    needed_s: float
    revision: int  # number of the baseline in force
    can_go_back: bool


class PastVerdicts(NamedTuple):
    """Stored values of the coefficients that are certainly beyond the limit of T^2, by the old and the new baseline."""

    values: int
    before: int
    after: int


def learning_progress(
    config: ServiceFile, store: Store, asset: str, status: AssetStatus, baseline: Baseline
) -> LearningProgress:
    """Return how far the learning of an asset is; `baseline`: the one in force."""
    revision = baseline.revision
    notes = [note for note in read_notes(store, asset) if note.get("kind", NOTE) not in (NOTE, CONFIRMATION)]
    kept_s = config.diagnosis.kept_s
    after, since, learned_s = None, None, 0.0
    if notes and notes[-1]["kind"] != BASELINE_NOTE:
        after, since = notes[-1]["kind"], notes[-1]["t"]
        learned_s = min(max(status.position.t - since, 0.0), kept_s)
    return LearningProgress(
        after=after,
        since=since,
        learned_s=learned_s,
        needed_s=min(MIN_LEARN_S, kept_s),
        revision=revision.number,
        can_go_back=revision.parent > 0,
    )


def offers(baseline: Baseline, status: AssetStatus, kept_s: float) -> list[Message]:
    """Return what further healthy recordings would bring, and how long a healthy stretch is at hand.

    `baseline`: the one in force, of the asset's operating point. Nothing is offered while something is wrong; where
    the conditions are new, recordings of them are asked for.
    """
    healthy_s = min(status.position.t - status.since, kept_s)
    model = baseline.covariates if baseline.logged_covariates else None
    ranges = [] if model is None else zip(model.names, model.low, model.high, strict=True)
    asked = [message("service.renewal.range", name=name, low=low, high=high) for name, low, high in ranges]
    if status.verdict == "undetermined" and status.learning is None:
        return asked
    if status.verdict != "healthy" or status.learning is not None or healthy_s < min(MIN_LEARN_S, kept_s):
        return []
    messages = [message("service.renewal.ready", minutes=healthy_s / 60.0)]
    for recordings in OFFERED_RECORDINGS:
        changes = forecast_changes(baseline, recordings)
        name = min(changes, key=lambda fault: changes[fault][1] / changes[fault][0], default="")
        if name and changes[name][1] < MAX_OFFERED_RATIO * changes[name][0]:
            before, after = (100.0 * size for size in changes[name])
            messages.append(message("service.renewal.offer", more=recordings, fault=name, before=before, after=after))
    return [*messages, *asked]


def stored_stretch(
    config: ServiceFile, store: Store, asset: str, baseline: Baseline, since: float | None, until: float | None = None
) -> Recording:
    """Return the samples of an asset that the store keeps of a time [UTC s], under the name that its file is to have.

    `baseline`: the one in force. Raises RecordingError if there are none, or if they cannot be used.
    """
    blocks = [Block.unpack(asset, *row) for row in store.recent_samples(asset)]
    first, last = since if since is not None else -np.inf, until if until is not None else np.inf
    blocks = [block for block in blocks if block.t[0] >= first and block.t[-1] < last]
    if not blocks:
        raise RecordingError(f"{asset}: the store keeps no samples of that time, see [diagnosis] keep_s")
    point = config.assets[asset].point
    at = baseline if point is None else baseline.at(point)
    name = f"{asset}-{datetime.fromtimestamp(blocks[0].t[0], UTC):%Y%m%dT%H%M%S}.parquet"
    return blocks_to_recording(at, name, blocks)[0]


def write_stretch(folder: Path, stretch: Recording) -> Path:
    """Write samples from the store into a folder, as history and jobs read them; return the file."""
    path = folder / stretch.name
    write_recording(path, stretch, plain_columns(stretch.channels))
    return path


def read_stretch(path: Path, baseline: Baseline) -> Recording:
    """Read what `write_stretch` wrote of an asset with this baseline."""
    return readers.read(path, baseline.loop, columns=plain_columns(baseline.loop.columns.covariates))


def judge_again(store: Store, asset: str, before: Baseline, after: Baseline, now: float) -> PastVerdicts:
    """Judge the stored coefficients of the last weeks by two baselines.

    A coefficient's own deviation, squared and over its variance, is at most T^2: what exceeds the limit so is certainly
    beyond it. Its expectation by the new baseline is that by the old one, moved as the healthy coefficient has.
    """
    series = read_series(store, asset, (now - JUDGED_AGAIN_S, None), ("coefficient",))
    exceeded: dict[float, list[bool]] = {}
    shift = np.array(after.theta) - np.array(before.theta)
    variances = [np.diag(baseline.covariance_array()) for baseline in (before, after)]
    for i, name in enumerate(before.names):
        for t, value, low, high, healthy in series.get(("coefficient", name), np.zeros((5, 0))).T:
            own = ((high - low) / (2.0 * NORMAL_95)) ** 2
            offs = value - healthy, value - healthy - shift[i]
            limits = before.thresholds.statistic, after.thresholds.statistic
            beyond = [off**2 > limit * (own + C[i]) for off, limit, C in zip(offs, limits, variances, strict=True)]
            exceeded[t] = [a or b for a, b in zip(exceeded.get(t, (False, False)), beyond, strict=True)]
    counts = np.array(list(exceeded.values()), dtype=int).reshape(-1, 2).sum(axis=0)
    return PastVerdicts(len(exceeded), *counts.tolist())


def put_in_force(
    config: ServiceFile, store: Store, asset: str, baseline: Baseline, stretch: Recording, t: float
) -> Path:
    """Put a relearned baseline in force from `t` [UTC s] on, and return its file; the service takes it soon.

    The file is the asset's own; the service file's baseline stays as it is. The samples are kept with the history.

    Raises BaselineError if another one was put in force since its preview, OutputError if a file cannot be written.
    """
    own = config.relearned_file(asset)
    make_folder(history_folder(own))
    write_stretch(history_folder(own), stretch)
    announce_baseline(config, store, asset, baseline.revision.parent, baseline, t)
    return own


def go_back(config: ServiceFile, store: Store, asset: str, who: str, why: str, t: float) -> Baseline:
    """Put the earlier baseline of an asset in force again from `t` [UTC s] on; raises BaselineError without one."""
    own = config.relearned_file(asset)
    if not own.exists():
        raise BaselineError(f"{asset}: its baseline was never relearned, there is none to go back to")
    restored = restore_parent(own, who, why)
    announce_baseline(config, store, asset, Baseline.load(own).revision.number, restored, t)
    return restored
