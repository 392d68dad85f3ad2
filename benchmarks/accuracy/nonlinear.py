"""The nonlinear rig: where the linear inverse ends, and what the square-root valve law is worth; prints Markdown.

    python benchmarks accuracy/nonlinear [--quick] [--json] [--figure FILE.png]

Every simulation has its own seed.
The loop file knows the rig's delay of 12.8 ms (one sample and the valve) unless a row says otherwise. About eight
minutes on one core.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from tables import Table, parser, show

import servoscope as ss
from servoscope.core.errors import RecordingError
from servoscope.estimation.pipeline import Pipeline
from servoscope.fit.tuning import least_squares
from servoscope.simulation import FaultEvent, Rig, RigTruth, reference, simulate_rig

RIG_FILE = Path(str(files("servoscope"))) / "simulation" / "reference-rig.toml"
KINDS = ("profile", "multisine", "trapezoid")
FAULTS = (("p_s", 0.8), ("C_ie", 1.2), ("b_p", 20.0), ("beta", 0.1))
FAULT_AT = 30.0  # s
DELAY = 0.0128  # s: a sample, and 2 zeta/w of the valve
SQUARE_ROOT = {"plant": {"valve_law": "square-root"}}
COULOMB = {"plant": {"kind": "polynomial", "order": 3, "stiffness": True, "friction": "coulomb", "sign_cutoff": 20.0}}
AMPLITUDES = (0.1, 0.25, 0.5, 0.75, 1.0, 1.25)
LINEAR_RIG = replace(Rig.ideal(), delay_samples=0.0)
Array = npt.NDArray[np.float64]


@functools.cache
def base() -> dict[str, Any]:
    """Return the reference rig's loop with half its gain, which a rig with a delay asks for, and its limits of u."""
    settings = ss.Loop.load(RIG_FILE).to_dict()
    settings["controller"]["k_p"] = 10.0
    return settings | {"delay": DELAY, "input_limits": [-0.5, 0.5]}


def loop(**changes: Any) -> ss.Loop:
    """Return the loop with sections or keys changed."""
    settings = dict(base())
    for key, value in changes.items():
        whole = not isinstance(value, dict) or "kind" in value
        settings[key] = value if whole else {**settings[key], **value}
    return ss.Loop.from_dict(settings)


@functools.cache
def simulated(
    kind: str, seed: int, amplitude: float = 1.0, temperature: float = 40.0, fault: str = "", rig: Rig | None = None
) -> tuple[ss.Recording, RigTruth]:
    """Simulate 60 s of the rig; a fault is written as on the command line."""
    r = reference(kind, 60.0, 100.0, amplitude=amplitude)
    events = (FaultEvent.parse(fault),) if fault else ()
    rig = replace(Rig() if rig is None else rig, temperature=temperature)
    return simulate_rig(loop(), r, rig, faults=events, seed=seed)


def fitted(
    settings: ss.Loop, recording: ss.Recording, u: Array | None = None
) -> tuple[float, npt.NDArray[np.complex128]]:
    """Return the residual as a share of eta (rms), and H_hat at 1 and 10 Hz."""
    pipeline = Pipeline.of(settings)
    g = pipeline.regression(recording.r, recording.u if u is None else u, recording.y, recording.restart)
    theta = least_squares(g)
    left = (g.eta - g.phi @ theta)[g.ok]
    return float(np.std(left) / np.std(g.eta[g.ok])), pipeline.bank.E([1.0, 10.0]) @ theta


def true(f: npt.ArrayLike) -> npt.NDArray[np.complex128]:
    """Return H of the linear plant at some frequencies."""
    return loop().plant.frequency_response(f)


def effects(only: Sequence[str] = ()) -> Iterator[Table]:
    """Measure what each effect alone does to the inverse, by least squares over one recording; `only` some of them."""
    on = Rig()
    alone = {
        "none: the linear rig": {},
        "square-root valve": {"load_pressure_flow": True},
        "Stribeck friction": {"coulomb": on.coulomb, "static": on.static},
        "limits of current and stroke, sensor": {"current_limit": 0.5, "stroke": 0.2, "sensor_bits": 16},
        "valve of 80 Hz and a sample of delay": {"valve_hz": 80.0, "delay_samples": 1.0},
        "oil 5 K warmer": {"temperature": 45.0},
    }
    rigs = {words: replace(LINEAR_RIG, **changes) for words, changes in alone.items()}
    rigs["all of them at 40 degC"] = on
    rows = []
    for words, rig in rigs.items():
        if only and words not in only:
            continue
        late = DELAY if rig.valve_hz else 0.0
        cells = [words]
        for kind in ("profile", "multisine"):
            recording, _ = simulated(kind, 1, 1.0, rig.temperature, "", rig)
            for law in ("linear", "square-root"):
                share, H = fitted(loop(delay=late, plant={"valve_law": law}), recording)
                cells.append(
                    f"{share:.2%}, {H[0].real / true([1.0])[0].real:.2f}" if kind == "multisine" else f"{share:.2%}"
                )
        rows.append(tuple(cells))
    yield Table(
        "What each effect does to the inverse",
        "Residual of least squares over 60 s as a share of the filtered u (rms), and, on the multisine, Re H_hat over "
        "Re H of the linear plant at 1 Hz. The loop file knows the delay where there is one. The square-root "
        "inverse is wrong where the valve is linear.",
        ("effect", "profile, linear inverse", "square root", "multisine, linear inverse", "square root"),
        tuple(rows),
    )


@dataclass(frozen=True)
class Method:
    """A way to set the loop file up, the oil's temperatures in its healthy recordings, and the rig."""

    words: str
    changes: dict[str, Any]
    temperatures: tuple[float, ...] = (40.0,)
    rig: Rig = field(default_factory=Rig)

    def baseline(self, kind: str) -> ss.Baseline:
        """Learn from one recording per temperature."""
        healthy = [self.recording(kind, i, temperature=t) for i, t in enumerate(self.temperatures)]
        return ss.learn(loop(**self.changes), healthy)

    def recording(self, kind: str, seed: int, **how: Any) -> ss.Recording:
        """Return a recording of the method's rig."""
        return simulated(kind, seed, rig=self.rig, **how)[0]


WARM_AND_COLD = (35.0, 40.0, 45.0)
METHODS = (
    Method("linear inverse on the linear rig", {"delay": 0.0}, rig=LINEAR_RIG),
    Method("linear inverse, delay not told", {"delay": 0.0}),
    Method("linear inverse", {}),
    Method("linear, model_error 2 %", {"monitor": {"model_error": 0.02}}),
    Method("linear, Coulomb column (polynomial)", COULOMB),
    Method("linear, baselines of 35, 40, 45 degC", {}, WARM_AND_COLD),
    Method("square root", SQUARE_ROOT),
    Method("square root, model_error 0.3 %", {**SQUARE_ROOT, "monitor": {"model_error": 0.003}}),
    Method("square root, baselines of 35, 40, 45 degC", SQUARE_ROOT, WARM_AND_COLD),
    Method("square root, coulomb = 60", {"plant": {**SQUARE_ROOT["plant"], "coulomb": 60.0}}),
    Method("square root on a rig without friction", SQUARE_ROOT, rig=Rig(coulomb=0.0, static=0.0)),
)
SHOWN = (2, 6, 9)  # methods whose explanations are told
SHARE = 9  # the method whose diagnosis of a leak tests repeat
IN_SHORT = (0, 2, 6, 8, 9)  # of the page for users
CONDITIONS = (
    ("as learned", tuple({"seed": seed} for seed in range(50, 54))),
    ("amplitude 0.5, 0.8", tuple({"seed": 60 + i, "amplitude": (0.5, 0.8)[i % 2]} for i in range(4))),
    ("oil 35, 45 degC", tuple({"seed": 70 + i, "temperature": (35.0, 45.0)[i % 2]} for i in range(4))),
)


@functools.cache
def judged(method: int, kind: str) -> dict[str, Any]:
    """Learn and judge everything on one reference: alarms per condition, and the diagnosis of each fault."""
    how = METHODS[method]
    learned = how.baseline(kind)

    def alarm(**settings: Any) -> bool:
        return ss.diagnose(learned, how.recording(kind, **settings)).verdict == "fault"

    found: dict[str, Any] = {words: sum(alarm(**each) for each in cases) for words, cases in CONDITIONS}
    for i, (parameter, ratio) in enumerate(FAULTS):
        fault = f"{parameter}={ratio:g}@{FAULT_AT:g}"
        found[parameter] = ss.diagnose(learned, how.recording(kind, 20 + i, fault=fault))
    return found


def methods() -> Iterator[Table]:
    """Count false alarms, detections and names of every method over three references."""
    rows = []
    for method, how in enumerate(METHODS):
        try:
            found = [judged(method, kind) for kind in KINDS]
        except RecordingError as error:
            rows.append((how.words, f"`learn` refuses: {str(error).partition(': ')[2]}", *[""] * 6))
            continue
        alarms = [f"{sum(each[words] for each in found)} of {len(KINDS) * len(cases)}" for words, cases in CONDITIONS]
        said = [(parameter, each[parameter]) for each in found for parameter, _ in FAULTS]
        seen = [
            (parameter, d)
            for parameter, d in said
            if d.verdict in ("suspect", "fault") and (d.detected_at_s or 0.0) >= FAULT_AT
        ]
        right = [d.faults[0] for parameter, d in seen if d.faults and d.faults[0].parameter == parameter]
        wrong = sum(bool(d.faults) for _, d in seen) - len(right)
        truth = dict(FAULTS)
        errors = [
            abs(np.log(fault.ratio / truth[fault.parameter])) / abs(np.log(truth[fault.parameter])) for fault in right
        ]
        late = [d.detected_at_s - FAULT_AT for _, d in seen]
        size = f"{np.median(errors):.0%}" if errors else ""
        rows.append(
            (how.words, *alarms, f"{len(seen)} of 12", f"{len(right)}, {wrong}", size, f"{np.median(late):.1f} s")
        )
    columns = ("method", *(words for words, _ in CONDITIONS), "found", "named right, wrong", "error of size")
    columns = (*columns, "median delay")
    yield Table(
        "Methods",
        "Alarms on healthy recordings, and faults p_s x 0.8, C_ie x 1.2, b_p x 20, beta x 0.1, over three references.",
        columns,
        tuple(rows[i] for i in IN_SHORT),
    )
    yield Table(
        "False alarms and faults",
        "Alarms on healthy recordings (four for each of three references), and the four faults p_s x 0.8, C_ie x 1.2, "
        "b_p x 20 and beta x 0.1, from 30 s on, on each reference; 60 s everywhere, one baseline per reference. "
        "Names count from a probability of 0.95; the error of the size is relative to the change, on a logarithmic "
        "scale, the median of those named rightly. Warmer oil is a leak of 1.22 and colder oil one of 0.82: alarms in "
        "that column are right about the actuator and wrong about its health. A polynomial plant has no physical "
        "names.",
        columns,
        tuple(rows),
    )


def _best(diagnosis: ss.Diagnosis) -> str:
    if diagnosis.verdict != "fault":
        return diagnosis.verdict
    best = diagnosis.candidates[0]
    size = f" x {best.faults[0].ratio:.3g}" if best.faults else ""
    return f"{best.name}{size}, {best.probability:.2f}"


def names() -> Iterator[Table]:
    """Tell the best explanation of each fault, linear against square root."""
    rows = []
    for parameter, ratio in FAULTS:
        for method in SHOWN:
            cells = [_best(judged(method, kind)[parameter]) for kind in KINDS]
            rows.append((f"{parameter} x {ratio:g}", METHODS[method].words, *cells))
    for temperature in (45.0, 35.0):
        for method in SHOWN[:2]:
            learned = [METHODS[method].baseline(kind) for kind in KINDS]
            recordings = [simulated(kind, 30, temperature=temperature)[0] for kind in KINDS]
            cells = [_best(ss.diagnose(b, recording)) for b, recording in zip(learned, recordings, strict=True)]
            rows.append((f"oil of {temperature:g} degC", METHODS[method].words, *cells))
    yield Table(
        "What the best explanation says",
        "Name, size and probability.",
        ("truth", "method", *KINDS),
        tuple(rows),
    )


def flow_of(recording: ss.Recording, pressure: Array) -> Array:
    """Return u held back by a sample and times the root, with a load pressure that is known."""
    u = np.concatenate([recording.u[:1], recording.u[:-1]])
    return u * np.sqrt(np.maximum(1.0 - np.sign(u) * pressure / base()["plant"]["p_s"], 0.0))


def pressure() -> Iterator[Table]:
    """Measure what a sensor of the load pressure would gain over its reconstruction from y."""
    plant, rows = base()["plant"], []
    for kind in KINDS:
        recording, truth = simulated(kind, 1)
        spring = plant["k_p"] * recording.y / plant["A_p"]
        noisy = truth.load_pressure + 0.005 * plant["p_s"] * np.random.default_rng(1).standard_normal(recording.samples)
        rest = loop(delay=DELAY - 0.01)
        shares = [
            fitted(loop(), recording)[0],
            fitted(rest, recording, flow_of(recording, spring))[0],
            fitted(loop(**SQUARE_ROOT), recording)[0],
            fitted(rest, recording, flow_of(recording, noisy))[0],
            fitted(rest, recording, flow_of(recording, truth.load_pressure))[0],
        ]
        rows.append((kind, *(f"{share:.2%}" for share in shares)))
    yield Table(
        "Load pressure: reconstructed or measured",
        "Residual as above, by where the load pressure comes from; the sensor's noise is 0.5 % of p_s.",
        ("reference", "none (linear)", "spring force alone", "m y'' + b y' + k y (as built)", "noisy sensor", "exact"),
        tuple(rows),
    )


def describing(f: float, amplitude: float) -> tuple[complex, complex]:
    """Return the describing functions y -> u and y -> u times the root, both without the delay, for one sine."""
    t = np.arange(3000) / 100.0
    recording, _ = simulate_rig(loop(), amplitude * np.sin(2.0 * np.pi * f * t), noise_u_std=0.0, noise_y_std=0.0)
    turning = np.exp(-2j * np.pi * f * t[1000:])
    pipeline = Pipeline.of(loop(**SQUARE_ROOT))
    flow = pipeline.flow(recording.u, recording.y, recording.restart)
    output = recording.y[1000:] @ turning
    held = np.sinc(f / 100.0) * np.exp(-1j * np.pi * f / 100.0)
    linear = recording.u[1000:] @ turning / output * held * np.exp(-2j * np.pi * f * DELAY)
    root = flow[1000:] @ turning / output * held * np.exp(-2j * np.pi * f * (DELAY - 0.01))
    return complex(linear), complex(root)


FREQUENCIES = (0.5, 1.0, 3.0)
SINES = (0.005, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06)


def over_amplitude() -> Iterator[Table]:
    """Show the inverse over amplitude: as describing function of a sine, and as estimated on the multisine."""
    rows = []
    for amplitude in SINES:
        cells = [_parts(H, f) for f in FREQUENCIES for H in describing(f, amplitude)]
        rows.append((f"{1e3 * amplitude:g} mm", *cells))
    heads = [f"{f:g} Hz, {law}" for f in FREQUENCIES for law in ("linear", "square root")]
    yield Table(
        "Describing function",
        "First harmonic of u, or of u times the root, over that of y in closed loop with a sine, without noise, over "
        "the H of the linear plant: real part over Re H, magnitude over |H|.",
        ("amplitude of r", *heads),
        tuple(rows),
    )
    rows = []
    root = Pipeline.of(loop(**SQUARE_ROOT))
    for amplitude in AMPLITUDES:
        recording, _ = simulated("multisine", 40, amplitude)
        flow = root.flow(recording.u, recording.y, recording.restart)
        found = (
            fitted(loop(), recording),
            fitted(loop(**COULOMB), recording),
            fitted(loop(**SQUARE_ROOT), recording),
            fitted(loop(**COULOMB, delay=DELAY - 0.01), recording, flow),
        )
        cells = [f"{share:.2%}, {_parts(H[0], 1.0)}, {abs(H[1] / true([10.0])[0]):.3f}" for share, H in found]
        rows.append((f"{amplitude:g}", *cells))
    yield Table(
        "Estimated inverse",
        "Least squares on 60 s of the multisine with noise: residual; Re H(1 Hz), |H(1 Hz)| and |H(10 Hz)|, each over "
        "the linear plant's.",
        ("amplitude", "linear", "linear, Coulomb column", "square root", "square root, Coulomb column"),
        tuple(rows),
    )


def _parts(H: complex, f: float) -> str:
    nominal = true([f])[0]
    return f"{H.real / nominal.real:.2f}, {abs(H / nominal):.3f}"


def draw(path: Path) -> None:
    """Draw the describing function over amplitude."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(8.0, 3.2), layout="constrained", sharex=True)
    for f, colour in zip(FREQUENCIES, ("#1f77b4", "#d62728", "#2ca02c"), strict=True):
        values = np.array([describing(f, amplitude) for amplitude in SINES])
        for i, (style, law) in enumerate((("o-", "linear"), ("s--", "square root"))):
            mm = 1e3 * np.array(SINES)
            nominal = true([f])[0]
            axes[0].plot(
                mm, values[:, i].real / nominal.real, style, color=colour, ms=3, lw=1.2, label=f"{f:g} Hz, {law}"
            )
            axes[1].plot(mm, np.abs(values[:, i] / nominal), style, color=colour, ms=3, lw=1.2)
    axes[0].set(xlabel="amplitude of r [mm]", ylabel="Re of the inverse over Re H")
    axes[1].set(xlabel="amplitude of r [mm]", ylabel="magnitude over |H|")
    axes[0].legend(fontsize=7, frameon=False)
    figure.savefig(path, dpi=120, metadata={"Software": None})
    plt.close(figure)


def leak() -> str:
    """Return how a leak of 1.2 on the multisine is explained by the square root with friction."""
    how = METHODS[SHARE]
    recording = how.recording("multisine", 21, fault=f"C_ie=1.2@{FAULT_AT:g}")
    return _best(ss.diagnose(how.baseline("multisine"), recording))


def values(made: Sequence[Table]) -> dict[str, str]:
    """Return the figures that stand in sentences of the page."""
    rows = {table.title: {row[0]: row[1:] for row in table.rows} for table in made}
    alone, sines = rows["What each effect does to the inverse"], rows["Describing function"]
    whole = alone["all of them at 40 degC"]
    found = {
        "residual.linear-rig": alone["none: the linear rig"][0],
        "residual.linear": whole[0],
        "residual.root": whole[1],
        "multisine.linear": whole[2].split(", ")[1],
        "multisine.root": whole[3].split(", ")[1],
        "warmer": alone["oil 5 K warmer"][2].split(", ")[1],
        "leak": leak(),
    }
    found |= {f"sine.{mm}": sines[f"{mm} mm"][4].split(", ")[0] for mm in (5, 60)}
    roots = [abs(float(row[column].split(", ")[0]) - 1.0) for row in sines.values() for column in (1, 3, 5)]
    return found | {"sine.root": f"{100.0 * max(roots):.0f} %"}


def main() -> None:
    """Print the tables, or draw the picture alone."""
    options = parser(__doc__)
    options.add_argument("--figure", type=Path, help="draw the describing function over amplitude, and measure no more")
    given = options.parse_args()
    if given.figure:
        draw(given.figure)
    else:
        made = [table for part in (effects, methods, names, pressure, over_amplitude) for table in part()]
        show(made, given.json, values(made))
