"""Robot arms: measured and simulated changes, named by joint, in comparison with two simple detectors; speed.

    python benchmarks studies/arms {measured,simulated,speed} [--count N] [--data FOLDER] [--json]

UR10e: learned from six recordings of three days, judged on others without payload, to which Coulomb friction of one
joint is added in the middle. Simulated: six joints under position control whose loop reacts to the change; each
recording has a motion, friction and onset of its own. The simple detectors take the largest value of the learned
recordings, each fitted without it, as their limit: the rms over 5 s of what a regression of one joint alone on a, v,
sign(v), sin q, cos q and 1 leaves, and a momentum observer (De Luca and Mattone, 2005) with the identified model.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from tables import Table, parse_with_data, parser, show

from servoscope.arm.baseline import ArmBaseline
from servoscope.arm.diagnosis import diagnose_arm, examine_arm
from servoscope.arm.dynamics import torque_regressor
from servoscope.arm.learning import learn_arm
from servoscope.arm.log import ArmRecording, read_arm_log
from servoscope.arm.model import FRICTION
from servoscope.arm.regression import ArmSignals, block_information, filter_arm_log
from servoscope.arm.settings import ArmLoop
from servoscope.arm.setup import calibrate_load
from servoscope.arm.simulation import (
    URDF,
    ArmChange,
    simulate_arm,
    simulated_arm,
    simulated_arm_loop,
)
from servoscope.arm.urdf import parse_urdf
from servoscope.diagnosis.result import Diagnosis

UR_GAINS = (14.87, 13.26, 11.13, 10.62, 11.03, 11.47)  # N m/A, De Luca's
LEARNED_DAYS = ("20_02_05", "20_02_06", "20_02_10")
HELD_OUT = (
    "identification_data__ur-19_12_23_free",
    "validation_data__ur-20_01_17-ptp_10_points",
    "jointwise_motion__ur-20_01_22-joint_1",
    "jointwise_motion__ur-20_01_22-joint_3",
    "jointwise_motion__ur-20_01_22-joint_5",
    "identification_data__ur-20_02_12-40sec_12harm",
    "identification_data__ur-20_02_12-50sec_12harm",
    "identification_data__ur-20_02_19_14harm50sec",
    "identification_data__ur-20_02_19_15harm50sec",
)
INJECTED = HELD_OUT[5:]  # long enough, and all joints move
LOADED = ("identification_data__ur-20_02_19_14harm50secLoad", "identification_data__ur-20_02_19_15harm50secLoad")
MASS = 2.805  # kg
PUSHED = "collision__ur-20_01_22-push_pose_1"
TX40_FRICTION = ((8.05, 5.53, 1.97, 1.11, 1.86, 0.65), (7.14, 8.26, 6.34, 2.48, 3.03, 0.282))  # N m s; N m
OBSERVER_GAIN = 10.0  # 1/s
WINDOW_S = 5.0
SIMULATED_S = 60.0
SIMULATED_LEARNED = 6
KINDS = {  # sizes of simulated changes, lowest and highest, and joints from 1
    "payload": ((1.0, 3.0), (6,)),
    "friction": ((1.3, 2.0), (1, 2, 3, 4, 5, 6)),
    "drive gain": ((0.8, 0.9), (2, 3)),
    "offset": ((4.0, 8.0), (1, 2, 3)),
    "encoder offset": ((0.03, 0.06), (2, 3)),
}
NEUTRAL = {"friction": 1.0, "drive gain": 1.0}


class OneJoint:
    """The rms over 5 s of what a regression of each joint alone leaves."""

    def __init__(self, baseline: ArmBaseline, learned: Sequence[ArmSignals]) -> None:
        self._baseline = baseline
        self._parts = [[self._columns(s, j) for j in range(len(baseline.noise))] for s in learned]
        self._fits = [self._fit(range(len(learned)))] + [
            self._fit([k for k in range(len(learned)) if k != i]) for i in range(len(learned))
        ]
        self._scale = np.mean([self._rms(s, self._fits[0]).mean(1) for s in learned], axis=0)
        self.limit = max(self._largest(s, fit).max() for s, fit in zip(learned, self._fits[1:], strict=True))

    def _columns(self, s: ArmSignals, j: int) -> tuple[np.ndarray, np.ndarray]:
        v, q = s.v[:, j], s.q[:, j]
        sign = np.tanh(v / self._baseline.loop.sign_speed)
        X = np.column_stack([s.a[:, j], v, sign, np.sin(q), np.cos(q), np.ones(v.size)])
        return X * s.moving[j][:, None], s.tau[j] * s.moving[j]

    def _fit(self, which: Sequence[int]) -> list[np.ndarray]:
        joints = range(len(self._baseline.noise))
        parts = [[self._parts[k][j] for k in which] for j in joints]
        return [np.linalg.lstsq(*(np.concatenate(x) for x in zip(*own, strict=True)))[0] for own in parts]

    def _rms(self, s: ArmSignals, fit: list[np.ndarray]) -> np.ndarray:
        pieces = max(1, round(float(s.t[-1] - s.t[0]) / WINDOW_S))
        left = [tau - X @ x for (X, tau), x in zip((self._columns(s, j) for j in range(len(fit))), fit, strict=True)]
        return np.array([[np.sqrt(np.mean(x**2)) for x in np.array_split(e, pieces)] for e in left])

    def _largest(self, s: ArmSignals, fit: list[np.ndarray]) -> np.ndarray:
        return self._rms(s, fit).max(1) / self._scale

    def judge(self, s: ArmSignals) -> tuple[bool, int]:
        """Return whether something is found, and in which joint."""
        largest = self._largest(s, self._fits[0])
        return bool(largest.max() > self.limit), int(largest.argmax())


class MomentumObserver:
    """The torque from outside by a momentum observer with the identified model, in units of each joint's noise."""

    def __init__(self, baseline: ArmBaseline, learned: Sequence[ArmSignals]) -> None:
        self._baseline = baseline
        self.limit = max(self._largest(s).max() for s in learned)

    def _largest(self, s: ArmSignals) -> np.ndarray:
        from scipy.signal import lfilter

        expected = np.einsum("jpm,p->jm", self._baseline.design(s), np.array(self._baseline.theta))
        share = OBSERVER_GAIN * float(np.median(np.diff(s.t)))
        seen = lfilter([share], [1.0, share - 1.0], (s.tau - expected) * s.moving, axis=1)
        return np.abs(seen).max(1) / np.array(self._baseline.noise)

    def judge(self, s: ArmSignals) -> tuple[bool, int]:
        """Return whether something is found, and in which joint."""
        largest = self._largest(s)
        return bool(largest.max() > self.limit), int(largest.argmax())


def named(diagnosis: Diagnosis, kind: str, joint: str) -> bool:
    """Whether one fault is named, of the right kind and joint."""
    right = kind if kind == "payload" else f"{kind} of {joint}"
    return bool(diagnosis.faults) and diagnosis.candidates[0].name == right


def holds(diagnosis: Diagnosis, size: float) -> bool:
    """Whether the interval of the one fault holds a size."""
    fault = diagnosis.faults[0]
    low, high = fault.mass_kg[1:] if fault.mass_kg is not None else fault.interval
    return low <= size <= high


def of(count: int, total: int) -> str:
    """Return a count among a total, as text."""
    return f"{count} of {total}"


def ur10e(folder: Path) -> tuple[list[Table], dict[str, str]]:
    """Judge the recordings of the UR10e."""
    from scipy.signal import butter, sosfiltfilt

    urdf = (folder / "ur10e.urdf").read_text(encoding="utf-8")
    arm = parse_urdf(urdf, "ur10e.urdf")
    joints = {
        name: {"position": f"q{j + 1}", "torque": f"i{j + 1}", "gain": UR_GAINS[j]} for j, name in enumerate(arm.names)
    }
    loop = ArmLoop.from_dict({"kind": "arm", "urdf": "x", "sample_rate": 100.0, "joints": joints}, "arm.toml")

    def record(name: str, loop: ArmLoop = loop) -> ArmRecording:
        return read_arm_log(folder / f"{name}.parquet", loop, arm)

    days = sorted(path.stem for path in folder.glob("*.parquet") if any(day in path.stem for day in LEARNED_DAYS))
    learned = [record(name) for name in days]
    baseline = learn_arm(loop, urdf, learned)
    signals = [filter_arm_log(recording, baseline.model) for recording in learned]
    simple = [OneJoint(baseline, signals), MomentumObserver(baseline, signals)]
    held_out = {name: record(name) for name in HELD_OUT}
    false = sum(bool(diagnose_arm(baseline, x).intervals) for x in held_out.values())
    simple_false = [
        sum(detector.judge(filter_arm_log(x, baseline.model))[0] for x in held_out.values()) for detector in simple
    ]
    count = len(held_out)
    rows = [("nothing", of(false, count), "", "", *(of(x, count) for x in simple_false))]
    values = {"ur10e.healthy": str(count), "ur10e.false": str(false)}
    best = {}
    for growth in (0.3, 0.1):
        found, right, inside, simple_right = 0, 0, 0, [0, 0]
        for name in INJECTED:
            x = held_out[name]
            smooth = sosfiltfilt(butter(3, 10.0, fs=100.0, output="sos"), x.q, axis=0)
            v, late = np.gradient(smooth, 0.01, axis=0), np.arange(len(smooth)) >= len(smooth) // 2
            of_recording = 0
            for j, joint in enumerate(arm.names):
                coulomb = baseline.coefficient(f"{joint}.coulomb_friction")[0]
                torque = x.torque.copy()
                torque[:, j] += growth * coulomb * np.tanh(v[:, j] / 0.01) * late
                changed = replace(x, torque=torque)
                diagnosis, examination = examine_arm(baseline, changed)
                found += bool(diagnosis.intervals)
                if named(diagnosis, "friction", joint):
                    right += 1
                    of_recording += holds(diagnosis, 1.0 + growth)
                for k, detector in enumerate(simple):
                    simple_right[k] += detector.judge(examination.signals) == (True, j)
            inside += of_recording
            best[growth] = (*best.get(growth, ()), of_recording)
            print(name, growth, of_recording, file=sys.stderr, flush=True)
        total = len(INJECTED) * len(arm.names)
        counts = of(found, total), of(right, total), of(inside, right), *(of(x, total) for x in simple_right)
        rows.append((f"Coulomb friction + {100.0 * growth:.0f} %", *counts))
        values[f"ur10e.named{100.0 * growth:.0f}"] = of(right, total)
    values |= {f"ur10e.{100.0 * growth:.0f}": ", ".join(map(str, counts)) for growth, counts in best.items()}
    masses = []
    for calibrating, judged in (LOADED, LOADED[::-1]):
        gains = calibrate_load(baseline, record(calibrating), MASS)
        scaled = {
            gain.joint: loop.joints[gain.joint].model_copy(update={"gain": gain.gain} if gain.determined else {})
            for gain in gains
        }
        own = loop.model_copy(update={"joints": scaled, "gains": "load"})
        again = learn_arm(own, urdf, [record(name, own) for name in days])
        for before, mine, use in ((True, baseline, loop), (False, again, own)):
            diagnosis = diagnose_arm(mine, record(judged, use))
            (fault,) = diagnosis.faults
            assert fault.mass_kg is not None
            mass, low, high = fault.mass_kg
            undetermined = ", ".join(gain.joint for gain in gains if not gain.determined)
            masses.append((
                judged.rpartition("_")[2], "data sheet" if before else "the other pair",
                f"{mass:.2f}", f"{low:.2f} to {high:.2f}", "" if before else undetermined,
            ))  # fmt: skip
            if not before:
                values[f"ur10e.mass{len(masses) // 2}"] = f"{mass:.2f}"
    pushed = diagnose_arm(baseline, record(PUSHED))
    values["ur10e.push"] = ", ".join(sorted({warning.kind for warning in pushed.warnings}))
    left = tuple(
        (name, f"{100 * noise / torque:.1f}", f"{growth:.1f}")
        for name, noise, torque, growth in zip(
            arm.names, baseline.noise, baseline.torque, floor(baseline, held_out[INJECTED[1]]), strict=True
        )
    )
    tables = [
        Table(
            "UR10e: changes by joint",
            f"{len(days)} recordings learned; friction is added to {len(INJECTED)} recordings of other days. Simple"
            " detectors: found in the right joint; in the first row all that are found.",
            ("change", "found", "named right", "size in 95 %", "one joint at a time", "momentum observer"),
            tuple(rows),
        ),
        Table(
            "UR10e: what limits it",
            "Standard deviation of a change of Coulomb friction in the middle of 58 s, by noise and drift of healthy"
            " recordings.",
            ("joint", "torque unexplained [%]", "standard deviation [% of Coulomb friction]"),
            left,
        ),
        Table(
            "UR10e: a payload of 2.805 kg",
            "Drive gains of a data sheet, and calibrated with the other pair of recordings.",
            ("recording", "drive gains", "mass [kg]", "95 %", "gain not determined"),
            tuple(masses),
        ),
    ]
    return tables, values


def floor(baseline: ArmBaseline, recording: ArmRecording) -> np.ndarray:
    """Return the standard deviation of a change of each joint's Coulomb friction in the middle [%]."""
    s = filter_arm_log(recording, baseline.model)
    design = baseline.design(s)
    columns = np.concatenate([design, baseline.deviations(s, design)], axis=1)
    w = s.moving / (np.array(baseline.noise) * np.sqrt(baseline.inflation))[:, None]
    A = block_information(s.t, columns * w[:, None], s.tau * w).A
    late, whole = A[len(A) // 2 :].sum(0), A.sum(0) + baseline.random_effect
    known = np.diag(late - late @ np.linalg.solve(whole, late))[len(baseline.theta) :]
    found = []
    for joint in baseline.model.arm.names:
        column = next(cause.columns[0] for cause in baseline.causes if cause.joint == joint)
        std = np.sqrt(1.0 / known[column] + baseline.drift[column] ** 2)
        found.append(100.0 * std / abs(baseline.coefficient(f"{joint}.coulomb_friction")[0]))
    return np.array(found)


def tx40(folder: Path) -> Table:
    """Compare friction of a TX40 with the published table (TX40_config.yaml of figaroh-examples), joint by joint."""
    urdf = (folder / "tx40_mdh_modified.urdf").read_text(encoding="utf-8")
    arm = parse_urdf(urdf, "tx40.urdf")
    gears = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
    gears[5, 4] = 32.0
    offsets = (0.0, -np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0)
    joints = {
        name: {"position": f"q{j + 1}_raw", "torque": f"current{j + 1}_raw", "offset": offsets[j]}
        for j, name in enumerate(arm.names)
    }
    # as the authors model it: friction without load and curve
    table = {"kind": "arm", "urdf": "x", "sample_rate": 1000.0, "cutoff": 30.0, "sign_speed": 0.02, "joints": joints}
    table |= {"load_friction": False, "curve_speed": 0.0, "gears": gears.tolist()}
    loop = ArmLoop.from_dict(table, "arm.toml")
    baseline = learn_arm(loop, urdf, [read_arm_log(folder / "tx40.parquet", loop, arm)])
    rows = []
    for j, name in enumerate(arm.names):
        row = [name]
        for what, published in zip(FRICTION, TX40_FRICTION, strict=False):
            value, std = baseline.coefficient(f"{name}.{what}")
            if what == "viscous_friction" and j > 3:  # the wrist's motor turns both
                value += baseline.coefficient(f"motor1.{what}")[0]
            away = 100.0 * (value / published[j] - 1.0)
            row += [f"{value:.3g} ± {1.96 * std:.2g}", f"{published[j]:.3g}", f"{away:+.1f}"]
        row.append("yes" if not any(x.startswith(f"{name}.") for x in baseline.undetermined) else "no")
        rows.append(tuple(row))
    heads = ("joint", "viscous", "published", "away [%]", "Coulomb", "published ", "away [%] ", "determined")
    return Table("TX40: friction and the published table", "N m s and N m, with 95 % intervals.", heads, tuple(rows))


def simulated(count: int) -> tuple[Table, dict[str, str]]:
    """Judge simulated recordings, `count` of each kind of change and twice as many healthy ones."""
    arm, urdf, loop = simulated_arm(), URDF.read_text(encoding="utf-8"), simulated_arm_loop()

    def record(seed: int, change: ArmChange | None = None) -> ArmRecording:
        return read_arm_log(simulate_arm(seed, SIMULATED_S, change), loop, arm)

    learned = [record(seed) for seed in range(SIMULATED_LEARNED)]
    baseline = learn_arm(loop, urdf, learned)
    signals = [filter_arm_log(recording, baseline.model) for recording in learned]
    simple = [OneJoint(baseline, signals), MomentumObserver(baseline, signals)]
    rows = []
    totals = np.zeros(4, int)
    for index, kind in enumerate(("", *KINDS)):
        n = count if kind else 2 * count
        sums = np.zeros(6, int)  # found, named, sizes, onsets, simple detectors
        for k in range(n):
            rng = np.random.default_rng([index, k])
            change = None
            if kind:
                (low, high), choice = KINDS[kind]
                size, joint = rng.uniform(low, high), int(rng.choice(choice))
                change = ArmChange(kind, size, joint, SIMULATED_S * rng.uniform(1.0 / 3.0, 2.0 / 3.0))
            diagnosis, examination = examine_arm(baseline, record(1000 * (index + 1) + k, change))
            sums[0] += bool(diagnosis.intervals)
            if change is not None and named(diagnosis, kind, arm.names[change.joint - 1]):
                sums[1] += 1
                sums[2] += holds(diagnosis, size_of(baseline, change))
                begin, _, end = diagnosis.onset_s
                sums[3] += begin <= change.onset_s <= end
            elif change is not None:
                print(change, diagnosis.summary, file=sys.stderr)
            for i, detector in enumerate(simple):
                found, where = detector.judge(examination.signals)
                sums[4 + i] += found and (change is None or kind == "payload" or where == change.joint - 1)
        print(kind or "none", sums, file=sys.stderr, flush=True)
        changed = (of(sums[1], n), of(sums[2], sums[1]), of(sums[3], sums[1])) if kind else ("", "", "")
        rows.append((kind or "none", of(sums[0], n), *changed, of(sums[4], n), of(sums[5], n)))
        totals += np.array([n, *sums[1:4]]) if kind else 0
    note = (
        f"{SIMULATED_S:g} s each; {SIMULATED_LEARNED} healthy recordings learned; all sizes that are drawn are"
        " listed in the program. Simple detectors: found in the right joint."
    )
    heads = (
        "change",
        "found",
        "named right",
        "size in 95 %",
        "onset in 95 %",
        "one joint at a time",
        "momentum observer",
    )
    values = {
        "simulated.changes": str(totals[0]),
        "simulated.named": f"{100.0 * totals[1] / totals[0]:.0f}",
        "simulated.sizes": f"{100.0 * totals[2] / totals[1]:.0f}",
        "simulated.onsets": f"{100.0 * totals[3] / totals[1]:.0f}",
    }
    return Table("Simulated arm: changes in closed loop", note, heads, tuple(rows)), values


def size_of(baseline: ArmBaseline, change: ArmChange) -> float:
    """Return a change's size in the unit in which the diagnosis has it."""
    if change.kind == "offset":
        return 1.0 + change.size / baseline.torque[change.joint - 1]
    return 1.0 + change.size if change.kind == "encoder offset" else change.size


def speed() -> tuple[Table, dict[str, str]]:
    """Time the regressor and a diagnosis."""
    rng, arm = np.random.default_rng(0), simulated_arm()
    q, v, a = (rng.normal(size=(100_000, 6)) for _ in range(3))
    begin = time.process_time()
    torque_regressor(arm, q, v, a)
    regressor = time.process_time() - begin
    loop = simulated_arm_loop()
    recordings = [read_arm_log(simulate_arm(seed, 60.0), loop, arm) for seed in range(4)]
    baseline = learn_arm(loop, URDF.read_text(encoding="utf-8"), recordings[:3])
    diagnose_arm(baseline, recordings[0])
    begin = time.process_time()
    diagnose_arm(baseline, recordings[3])
    diagnosis = time.process_time() - begin
    rows = (
        ("regressor of 100 000 samples, six joints", f"{regressor:.2f}"),
        ("diagnosis of 60 s at 100 Hz, six joints", f"{diagnosis:.2f}"),
    )
    values = {"speed.regressor": f"{regressor:.1f}", "speed.diagnosis": f"{diagnosis:.1f}"}
    return Table("Arms: processor time", "One core.", ("task", "s"), rows), values


def main() -> None:
    """Print the tables."""
    command = parser(__doc__)
    command.add_argument("--count", type=int, default=8, help="simulated recordings of each change")
    command.add_argument("part", choices=("measured", "simulated", "speed"))
    given = parse_with_data(command, "real/ur10e")
    if given.part == "measured":
        tables, values = ur10e(given.data / "real" / "ur10e")
        tables.append(tx40(given.data / "real" / "tx40"))
    else:
        table, values = simulated(given.count) if given.part == "simulated" else speed()
        tables = [table]
    show(tables, given.json, values)
