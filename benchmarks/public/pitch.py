"""Pitch actuators of a wind turbine: five faults after the benchmark of Odgaard, Stoustrup and Kinnaert (2013).

    python benchmarks public/pitch [--hours 100] [--winds 50] [--json]

`pitch_turbine.py` is the simulator. A baseline of blade 1 is learned from five healthy winds of ten minutes. Then, per
wind and fault, ten minutes with the fault from five minutes on.

Sensor faults: detection is that of the comparison of the two sensors, isolation that sensor and kind are named. Faults
of the dynamics: detection is the alarm of the recursion, isolation that the fault is named, in diagnoses of what was
recorded until some times after the onset. The loop file names both by their rays, ratios from w and xi of the
benchmark. The cutoff was chosen on winds that are not judged here; what others do is printed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from tables import Table, parser, show

import servoscope as ss
from public.fault_indices import FaultIndices, fault_indices
from public.pitch_turbine import DYNAMICS, ONSET_S, RAMP_S, RATE, SENSOR_KINDS, SENSORS, measure, ray
from servoscope.baseline.sensors import find_sensor_deviation
from servoscope.diagnosis.diagnose import diagnose_with_trace
from servoscope.diagnosis.monitor import Monitor
from servoscope.evidence.sensors import wrong_sensor
from servoscope.scoring import alarm_rate, events

LEARNED_S, CASE_S, HOUR_S = 600.0, 600.0, 3600.0
TRAINING = 5  # winds
# seeds of the winds with faults, none of which chose a setting, and of the healthy hours
FIRST_WIND, FIRST_HOUR = 300, 5000
RAYS = {fault: fault.replace(" ", "_") for fault in DYNAMICS}
CUTOFF, OTHER_CUTOFFS = 0.35, (0.5, 0.8, 1.4)  # Hz
LOOKS_S = (5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 120.0)  # after the onset, when a diagnosis is made; the last at the end
LOOP: dict[str, Any] = {
    "name": "pitch actuator",
    "sample_rate": RATE,
    "columns": {"reference": "beta_ref", "input": "beta_ref", "output": list(SENSORS)},
    "plant": {"kind": "polynomial", "order": 2, "stiffness": True},
    "monitor": {"memory": 20.0, "frequencies": [0.1, 0.3]},
    "faults": {name: ray(fault) for fault, name in RAYS.items()},
}


class Case(NamedTuple):
    """One recording with a fault: its indices, and what was said at its end."""

    fault: str
    indices: FaultIndices
    said: str


def learn(cutoff: float) -> ss.Baseline:
    """Learn blade 1 from healthy winds."""
    loop = ss.Loop.from_dict({**LOOP, "monitor": LOOP["monitor"] | {"cutoff": cutoff}})
    return ss.learn(loop, [measure("", LEARNED_S, seed)[0] for seed in range(TRAINING)])


def sensor_case(baseline: ss.Baseline, fault: str, recording: ss.Recording) -> Case:
    """Judge a sensor fault: the comparison looks back only, the name takes what follows into account."""
    assert baseline.sensors is not None
    found = find_sensor_deviation(baseline.sensors, recording, lambda at: wrong_sensor(baseline, recording, at))
    shown = np.zeros(recording.samples, np.bool_)
    name = ""
    if found is not None:
        shown[found.detected + 1 :] = True  # at a sample it is known from the next one on
        name = found.kind if found.names == SENSORS[:1] else f"{found.kind} of {' or '.join(found.names)}"
    named = np.where(shown, name, "").tolist()
    return Case(fault, fault_indices(recording.t, shown, named, SENSOR_KINDS[fault], ONSET_S), name)


def name_at(baseline: ss.Baseline, recording: ss.Recording, until_s: float) -> str:
    """Return what a diagnosis names of what was recorded until a time; nothing: no fault, or one without a name."""
    diagnosis = ss.diagnose(baseline, recording.part(0.0, until_s))
    return " + ".join(one.name for one in diagnosis.faults)


def dynamics_case(
    baseline: ss.Baseline, fault: str, recording: ss.Recording, looks_s: Sequence[float] = LOOKS_S
) -> Case:
    """Judge a fault of the dynamics: the alarm over time, the name by diagnoses at some times and at the end."""
    diagnosis, trace = diagnose_with_trace(baseline, recording)
    last = " + ".join(one.name for one in diagnosis.faults)
    shown = np.asarray(trace.exceeded)
    named = np.full(shown.size, "", dtype=object)
    for look in looks_s:
        named[trace.t >= ONSET_S + look] = name_at(baseline, recording, ONSET_S + look)
    # without looks the name at the end counts from the alarm on
    named[(trace.t >= trace.t[-1]) if looks_s else shown] = last
    best = f"{diagnosis.verdict}: {last or (diagnosis.candidates[0].name + '?' if diagnosis.candidates else '')}"
    return Case(fault, fault_indices(trace.t, shown, named.tolist(), RAYS[fault], ONSET_S), best)


def false_alarms(baseline: ss.Baseline, hours: int) -> tuple[int, int]:
    """Return alarms of the recursion and of the sensors over healthy hours of three blades."""
    assert baseline.sensors is not None
    of_dynamics = of_sensors = 0
    monitor = Monitor(baseline)
    for hour in range(hours):
        for rec in measure("", HOUR_S, FIRST_HOUR + hour, (0, 1, 2)):
            of_sensors += find_sensor_deviation(baseline.sensors, rec) is not None
            _, trace = monitor.run(monitor.init(), rec.r, rec.u, rec.y)
            of_dynamics += len(events(np.asarray(trace.exceeded)))
    return of_dynamics, of_sensors


def time_text(values: Sequence[float]) -> str:
    """Return median, smallest and largest of times [s], and how many are missing."""
    found = sorted(value for value in values if np.isfinite(value))
    missed = len(values) - len(found)
    if not found:
        return "never"
    text = f"{np.median(found):.2f} s ({found[0]:.2f} to {found[-1]:.2f})"
    return text + (f", {missed} never" if missed else "")


def count(times: Sequence[float]) -> str:
    """Return how many of some times there are."""
    return f"{sum(np.isfinite(time) for time in times)} of {len(times)}"


def row_of(fault: str, cases: Sequence[Case]) -> tuple[str, ...]:
    """Return the indices of the cases of a fault."""
    i = [case.indices for case in cases]
    said = [case.said for case in cases]
    common = max(sorted(set(said)), key=said.count)
    return (
        fault,
        count([one.t_dt for one in i]),
        time_text([one.t_dt for one in i]),
        count([one.t_it for one in i]),
        time_text([one.t_it for one in i]),
        *(f"{np.mean([getattr(one, name) for one in i]):.3f}" for name in ("r_fd", "r_td", "r_fi", "r_ti")),
        f"{common} ({said.count(common)} of {len(said)})",
    )


def faults_table(baseline: ss.Baseline, winds: int) -> Table:
    """Judge all faults."""
    rows = []
    for fault in (*SENSOR_KINDS, *DYNAMICS):
        judge = sensor_case if fault in SENSOR_KINDS else dynamics_case
        cases = [judge(baseline, fault, measure(fault, CASE_S, FIRST_WIND + k)[0]) for k in range(winds)]
        rows.append(row_of(fault, cases))
    note = (
        f"{winds} winds per fault, ten minutes at {RATE:g} Hz, the fault in blade 1 from {ONSET_S:g} s on (low "
        f"pressure over {RAMP_S['low pressure']:g} s). Found, named: to the end; times from the onset, median "
        f"(smallest to largest). Faults of the dynamics are diagnosed {', '.join(f'{look:g}' for look in LOOKS_S)} s "
        "after the onset and at the end."
    )
    heads = ("fault", "found", "t_dt", "named", "t_it", "r_fd", "r_td", "r_fi", "r_ti", "what was said most")
    return Table("Pitch actuator: faults", note, heads, tuple(rows))


def cutoff_table(baseline: ss.Baseline, winds: int) -> Table:
    """Judge the faults of the dynamics with other cutoffs."""
    rows = []
    for cutoff in (CUTOFF, *OTHER_CUTOFFS):
        learned = baseline if cutoff == CUTOFF else learn(cutoff)
        for fault in DYNAMICS:
            cases = [dynamics_case(learned, fault, measure(fault, CASE_S, FIRST_WIND + k)[0], ()) for k in range(winds)]
            times = [case.indices.t_dt for case in cases]
            named = sum(case.said == f"fault: {RAYS[fault]}" for case in cases)
            rows.append((f"{cutoff:g} Hz", fault, count(times), time_text(times), f"{named} of {winds}"))
    return Table(
        "Pitch actuator: cutoff",
        "The same winds; named at the end. A higher cutoff finds sooner, but the noise of the sensors biases inertia "
        "where the regression sees it.",
        ("cutoff", "fault", "found", "t_dt", "named"),
        tuple(rows),
    )


def alarms_table(baseline: ss.Baseline, hours: int) -> Table:
    """Count false alarms."""
    dynamics, sensors = false_alarms(baseline, hours)
    bound = alarm_rate(0, 3.0 * hours).high
    return Table(
        "Pitch actuator: false alarms",
        "Healthy, other winds, three blades, recordings of an hour. No alarm at all would still leave up to "
        f"{bound:.2g} per hour and blade (95 %).",
        ("hours", "blades", "alarms of the recursion", "alarms of the sensors"),
        ((f"{hours}", "3", str(dynamics), str(sensors)),),
    )


def main() -> None:
    """Run the command line of this process."""
    command = parser(__doc__)
    command.add_argument("--hours", type=int, default=100, help="healthy hours of three blades")
    command.add_argument("--winds", type=int, default=50, help="winds per fault")
    given = command.parse_args()
    baseline = learn(CUTOFF)
    makers = ((faults_table, given.winds), (cutoff_table, given.winds), (alarms_table, given.hours))
    tables = [make(baseline, size) for make, size in makers]
    values = {"false": f"{sum(map(int, tables[2].rows[0][2:]))} in {given.hours} h"}
    for fault, found, delay, named, *_ in tables[0].rows:
        values |= {f"{fault}.found": found, f"{fault}.delay": delay, f"{fault}.named": named}
    show(tables, given.json, values)
