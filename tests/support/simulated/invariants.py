"""What must hold in the simulated world, whatever happens: looked at after each step, at each start, and at the end."""

from __future__ import annotations

import json
import zlib
from collections import defaultdict
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import sqlalchemy as sa

from servoscope.service.alarms.records import TRANSITION_TABLE, LifecycleEvent, LifecycleState
from servoscope.service.assets.checkpoint import AssetState, pack_state, unpack_state
from servoscope.service.build import ServiceComponents
from servoscope.service.mqtt import payload, topics
from servoscope.service.store import tables
from servoscope.service.store.bundles import restore_times
from servoscope.service.store.store import Store
from servoscope.signals.quality import active_findings, restart_silence
from simulated.broker import AHEAD

if TYPE_CHECKING:
    from simulated.world import World

NUMBERED = (tables.residuals, tables.diagnoses, tables.transitions)
PATIENCE_S = 12.0  # beyond the time in which silence has to be told
LOOK_S = 1.0


class Invariants:
    """Of one history; each broken one is told to the world in words."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._known = {name: dict[bytes, int]() for name in world.senders}  # number of each block sent, by its samples
        self._noted = dict.fromkeys(world.senders, 0)
        # of each asset, the numbers under which blocks are durable, in their order, as their sender has numbered them
        self.stored: dict[str, list[int]] = {name: [] for name in world.senders}
        self._heard_at = dict.fromkeys(world.senders, 0.0)
        self._begun_at = self._looked_at = self._away_at = 0.0
        self._sealed: dict[str, AssetState] = {}
        self._durable: dict[str, AssetState] = {}
        self._undecided: list[dict[str, AssetState]] = []

    # What is durable, and what may be acknowledged

    def durable(self, written: list[tuple[str, Any]]) -> None:
        """Take what a transaction has made durable."""
        is_commit = False
        for place, row in written:
            if place == "insert bundles":
                self._store(row)
            elif place == "update outbox" and None in row:
                self._world.receivers.delivered.add(row[-1])
            is_commit |= place == "upsert meta"
        if is_commit:
            self._durable = dict(self._sealed)

    def _store(self, row: Any) -> None:
        contents, samples = next(x for x in row if isinstance(x, str) and x[:1] == "["), row[-1]
        at = 0
        for asset, sequence, size, regular in json.loads(contents):
            packed = samples[at : at + size]
            at += size
            number = self._number(asset, restore_times(packed) if regular else packed)
            stored = self.stored[asset]
            if number is None:
                self._world.broken(f"{asset}: block {sequence} of the store has samples that nobody has sent")
            elif stored and number <= stored[-1]:
                self._world.broken(f"{asset}: block {number} of its sender is stored behind block {stored[-1]}")
            elif sequence != len(stored):
                self._world.broken(f"{asset}: {len(stored)} blocks are stored, and the next one is called {sequence}")
            if number is not None:
                stored.append(number)

    def _number(self, asset: str, packed: bytes) -> int | None:
        sender, known = self._world.senders[asset], self._known[asset]
        while self._noted[asset] in sender.sent:
            number = self._noted[asset]
            known[sender.sent[number].pack()] = number
            self._noted[asset] += 1
        return known.get(packed)

    def received(self, topic: str) -> None:
        """Take that the service has received a message."""
        self._heard_at[topics.parse_asset(topic)] = self._world.clock.now

    def acknowledged(self, topic: str, content: bytes) -> None:
        """Look at a message that the broker forgets now: the service has acknowledged it."""
        asset = topics.parse_asset(topic)
        sender = self._world.senders[asset]
        if sender.keeps:
            return  # what comes ahead of others is let go: its sender has it
        number = payload.decode_block(asset, content).sequence
        self._may_go(asset, number, "the broker")

    def confirmed(self, topic: str, content: bytes) -> None:
        """Look at an acknowledgement that goes to a sender, which forgets the blocks up to it."""
        if "/ack/" not in topic:
            return
        asset = topics.parse_asset(topic)
        _, sequence = topics.decode_ack(content)
        sender = self._world.senders[asset]
        for number in range(sequence, max(-1, sequence - AHEAD - 1), -1):
            if number not in sender.misdated and number not in self.stored[asset]:
                self._world.broken(f"{asset}: block {number} is confirmed to its sender before it is stored")

    def _may_go(self, asset: str, number: int, where: str) -> None:
        sender, stored = self._world.senders[asset], self.stored[asset]
        passed = bool(stored) and number < stored[-1]  # its place has passed: the audit names it, or it is late
        if not (number in sender.misdated or number in stored or passed):
            self._world.broken(f"{asset}: block {number} is acknowledged to {where} before it is stored")

    # States

    def sealed(self) -> None:
        """Note the states of all assets with what is going to be committed."""
        service = self._world.service
        if service is not None:
            self._sealed = {name: asset.state for name, asset in service.assets.items() if asset.state is not None}

    def resumed(self, components: ServiceComponents) -> None:
        """Hold the states of a new life against those that the store's last commit belongs to."""
        for name, why in components.left_out.items():
            self._world.broken(f"{name} is left out: {why}")
        for name, before in self._durable.items():
            asset = components.assets.get(name)
            if asset is None or asset.state is None or name in components.restarted or before.position.blocks == 0:
                continue
            if (difference := compare(asset.state, before)) is not None:
                self._world.broken(f"{name}: its state after a restart is another one: {difference}")
        for name in components.restarted:
            state, before = components.assets[name].state, self._durable.get(name)
            if state is not None and before is not None and state.position.digest != before.position.digest:
                self._world.broken(f"{name}: it begins anew, and not behind what was counted")

    def begun(self) -> None:
        """A life has begun."""
        self._begun_at = self._world.clock.now

    # After each step

    def step(self) -> None:
        """Look at what is cheap to look at."""
        world, service = self._world, self._world.service
        now = world.clock.now
        if world.ground.storage.away:
            self._away_at = now
        if service is None:
            return
        if service.writer.waiting > service.writer.capacity:
            world.broken(f"{service.writer.waiting} blocks wait, the buffer has {service.writer.capacity}")
        if now - self._looked_at < LOOK_S:
            return
        self._looked_at = now
        if (waiting := len(service.sources["line"].transport.waiting)) > 2 * world.broker.most:
            world.broken(f"{waiting} messages wait in memory")
        limit = world.config.quality.silent_s + PATIENCE_S
        if now - max(self._begun_at, self._away_at) < limit or service.unready_reason:
            return
        for name, asset in service.assets.items():
            followed = asset.reception.state == "followed"
            if followed and now - self._heard_at[name] > limit and asset.heard:
                world.broken(f"{name}: it is silent since {now - self._heard_at[name]:.1f} s, and nothing says so")

    # At the end

    def unsettled(self) -> str:
        """Return what is still to come; empty: nothing."""
        world = self._world
        if world.service is None:
            return "no service"
        for sender in world.senders.values():
            if sender.waiting:
                return f"{sender.asset}: {sender.waiting} blocks wait at their sender"
        for session in world.broker.sessions.values():
            if session.queue or session.open:
                return f"{len(session.queue)} and {len(session.open)} messages wait at the broker"
        service = world.service
        if service._reload_from is not None:
            return "a reload"
        if not service.writer.empty or service.writer.unavailable_since:
            return "the writer has something"
        if any(asset.pending_diagnoses and asset.due_diagnoses() for asset in service.assets.values()):
            return "diagnoses"
        with world.ground.storage.engine.connect() as connection:
            due = sa.select(sa.func.count()).select_from(tables.outbox).where(tables.outbox.c.due.is_not(None))
            if connection.execute(due).scalar():
                return "deliveries"
            if connection.execute(sa.select(tables.commands.c.id).where(tables.commands.c.outcome.is_(None))).first():
                return "commands"
        return ""

    def settled(self) -> bool:
        """Whether all is quiet."""
        return not self.unsettled()

    def finish(self) -> None:
        """Look at all that the store has."""
        world = self._world
        store = Store.open(world.config.store.url, world.config.folder)
        try:
            rows = store.checkpoints(list(world.senders))
            for name in world.senders:
                if name in rows:
                    self._finish_asset(store, name, rows[name])
            self._finish_outbox(store)
            for name, hash_ in world.people.relearned.items():
                state = unpack_state(rows[name]["state"], name)
                if state.baseline != hash_:
                    world.broken(f"{name}: baseline {hash_} was put in force, and {state.baseline} is")
            for table in (*NUMBERED, tables.outbox, tables.audit, tables.commands):
                count = sa.select(sa.func.count()).select_from(table)
                world.found.counts[table.name] += store.fetch_tuples(count)[0][0]
        finally:
            store.close()

    def _finish_asset(self, store: Store, name: str, row: Any) -> None:
        world, sender, stored = self._world, self._world.senders[name], self.stored[name]
        world.found.counts["blocks"] += len(stored)
        counted, state = row["status"]["counted"], unpack_state(row["state"], name)
        if counted["blocks"] != len(stored):
            world.broken(f"{name}: {counted['blocks']} blocks are counted, and {len(stored)} are stored")
        digest = 0
        for number in stored:
            digest = zlib.crc32(sender.sent[number].pack(), digest)
        if digest != counted["digest"]:
            world.broken(f"{name}: the digest is that of other samples")
        self._finish_losses(store, name, counted)
        numbers = [number for table in NUMBERED for (number,) in store.fetch_tuples(numbers_of(table, name))]
        numbers += [window.number for window in state.pending_diagnoses]
        if sorted(numbers) != list(range(1, counted["rows"] + 1)):
            twice = sorted({number for number in numbers if numbers.count(number) > 1})
            lacking = sorted(set(range(1, counted["rows"] + 1)) - set(numbers))
            beyond = [number for number in numbers if number > counted["rows"]]
            world.broken(f"{name}: rows are lacking {lacking}, twice {twice}, or unknown {beyond}")
        self._finish_alarms(store, name)

    def _finish_losses(self, store: Store, name: str, counted: Any) -> None:
        """What was sent and is not stored was dated by a wrong clock, or is named as lost."""
        world, sender, stored = self._world, self._world.senders[name], set(self.stored[name])
        missing = [number for number in sender.sent if number not in stored and number not in sender.misdated]
        if sender.keeps:
            if missing:
                world.broken(f"{name}: blocks {missing} are lost, though their sender kept them")
            return
        query = sa.select(tables.audit.c.document)
        query = query.where(tables.audit.c.asset == name, tables.audit.c.what == "blocks lost")
        named = set[int]()
        for row in store.fetch(query):
            document = row["document"]
            named.update(range(document["after"][1] + 1, document["before"][1]))
        if stored:
            first, last = min(stored), max(stored)
            unnamed = [number for number in missing if first < number < last and number not in named]
            if len(unnamed) > counted["late"]:
                world.broken(f"{name}: blocks {unnamed} are lost, and the audit does not say so")

    def _finish_alarms(self, store: Store, name: str) -> None:
        table, before = tables.transitions, defaultdict[str, str](lambda: "normal")
        query = sa.select(table).where(table.c.asset == name).order_by(table.c.number)
        for row in store.fetch(query):
            event = LifecycleEvent(row["document"]["event"])
            if row["before"] != before[row["alarm"]]:
                self._world.broken(
                    f"{name}: {row['alarm']} was {before[row['alarm']]}, and row {row['number']} "
                    f"leads from {row['before']} to {row['after']}"
                )
            if (LifecycleState(row["before"]), event) not in TRANSITION_TABLE:
                self._world.broken(f"{name}: {row['alarm']} cannot {event} when it is {row['before']}")
            before[row["alarm"]] = row["after"]
            self._world.found.counts[f"{row['alarm']} {event}"] += 1

    def _finish_outbox(self, store: Store) -> None:
        """Each transition that is to be sent is sent once, and what is in the outbox was taken."""
        world = self._world
        states = world.config.actions.sinks["hook"].states or ()
        query = sa.select(tables.transitions).where(tables.transitions.c.after.in_([str(one.value) for one in states]))
        wanted = sorted((row["asset"], row["alarm"], row["t"], row["after"]) for row in store.fetch(query))
        sent = [row for row in store.fetch(sa.select(tables.outbox)) if row["sink"] == "hook"]
        events = [row["event"] for row in sent if row["event"]["event"] != "diagnosed"]
        given = sorted((event["asset"], event["alarm"], event["time"], event["after"]) for event in events)
        if given != wanted:
            lacking, more = [x for x in wanted if x not in given], [x for x in given if x not in wanted]
            world.broken(f"the outbox lacks {lacking[:3]} and has {more[:3]} ({len(given)} of {len(wanted)})")
        world.found.counts["taken"] += len(world.receivers.taken)
        for row in sent:
            if row["key"] not in world.receivers.taken:
                world.broken(f"{row['key']} was never delivered, the store says: {row['outcome']}")


def numbers_of(table: sa.Table, asset: str) -> sa.Select[tuple[int]]:
    """Ask for the numbers of an asset's rows."""
    return sa.select(table.c.number).where(table.c.asset == asset)


def compare(now: AssetState, before: AssetState) -> str | None:
    """Return in what two states differ, one of them after a restart; None: in nothing that matters."""
    same, mine = _comparable(before), _comparable(now)
    if pack_state(mine) == pack_state(same):
        return None
    for name in ("position", "samples", "last_t", "history", "pending_diagnoses", "examination", "alarms"):
        if (a := getattr(mine, name)) != (b := getattr(same, name)):
            return "; ".join(f"{key} {x}, before {y}" for key, x, y in _differences(name, a, b))
    if mine.monitor.tobytes() != same.monitor.tobytes():
        return "monitor"
    if mine.quality.tobytes() != same.quality.tobytes():
        return f"quality {active_findings(mine.quality)}, before {active_findings(same.quality)}"
    return None


def _differences(name: str, a: Any, b: Any) -> list[tuple[str, Any, Any]]:
    """Return in which of their fields two records differ, with both values."""
    if isinstance(a, dict) and isinstance(b, dict) and a.keys() == b.keys():
        return [one for key in a if a[key] != b[key] for one in _differences(f"{name}.{key}", a[key], b[key])]
    if hasattr(a, "__dict__") and hasattr(b, "__dict__"):
        return _differences(name, vars(a), vars(b))
    return [(name, a, b)]


def _comparable(state: AssetState) -> AssetState:
    """Return a state without when its alarms were last advanced: while an asset is silent, that is not stored."""
    alarms = {name: replace(alarm, at=0.0) for name, alarm in state.alarms.items()}
    quality = restart_silence(state.quality, state.position.t)
    return replace(state, quality=quality, alarms=alarms, alarms_at=None)
