"""The delay between u and y: told by the likelihood of y, refused only where that is certain, never faked by noise."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servoscope.core.errors import RecordingError
from servoscope.learning.delay import check_delay
from servoscope.learning.inspection import inspect
from servoscope.learning.inspection.delay_fit import fit_delay
from servoscope.learning.inspection.model_order import form_regressors
from servoscope.models.loop import Loop
from servoscope.simulation import simulate
from servoscope.simulation.measurement import NOISE_U_STD, NOISE_Y_STD

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from accuracy import smooth

PLANTS: dict[int, dict[str, Any]] = {  # orders of a polynomial plant that the predictor can be written down for
    2: {"stiffness": 40.0, "viscous_friction": 2.0, "inertia": 0.02},
    3: {"stiffness": 40.0, "viscous_friction": 2.0, "inertia": 0.02, "jerk": 1e-4},
}


def axis(order: int, rate: float, delay: float = 0.0, nominal: bool = True, **more: Any) -> Loop:
    plant = {"kind": "polynomial", "order": order, "stiffness": True, **more}
    plant |= {"coefficients": PLANTS[order]} if nominal else {}
    controller = {"kind": "pi", "k_p": 40.0, "k_i": 200.0}
    return Loop.from_dict({"sample_rate": rate, "delay": delay, "plant": plant, "controller": controller})


def lively(seconds: float, rate: float, seed: int = 0) -> np.ndarray[Any, Any]:
    """A random motion up to 8 Hz, under which a delay shows at any sample rate."""
    rng, t = np.random.default_rng(seed), np.arange(round(seconds * rate)) / rate
    f, phase = rng.uniform(0.2, 8.0, 30), rng.uniform(0.0, 6.28, 30)
    return np.asarray(0.05 / 6.0 * np.sin(2.0 * np.pi * f * t[:, None] + phase).sum(axis=1))


@pytest.mark.parametrize("kind", smooth.MOTIONS)
def test_healthy_smooth_motion_is_learned_at_every_noise(kind: str) -> None:
    """Noise in the regressors dates y late by a sample here; a refusal for it would bake a wrong delay in."""
    loop = smooth.machine("rig")
    for seed, noise in enumerate(smooth.NOISES):
        r = smooth.motion(kind, 40.0, loop.sample_rate, seed)
        healthy, _ = simulate(loop, r, noise_u_std=noise * NOISE_U_STD, noise_y_std=noise * NOISE_Y_STD, seed=seed)
        delay_s, notes = check_delay(loop, [healthy])
        assert delay_s is not None and delay_s < 0.3 / loop.sample_rate
        assert not notes


@pytest.mark.parametrize("samples", [1, 2])
def test_a_true_delay_is_found_under_smooth_motion(samples: int) -> None:
    loop = smooth.machine("rig")
    late = loop.model_copy(update={"delay": samples / loop.sample_rate})
    recording, _ = simulate(late, smooth.motion("moves", 60.0, loop.sample_rate, 5), seed=5)
    with pytest.raises(RecordingError, match="--accept-delay"):
        check_delay(loop, [recording])
    delay_s, (note,) = check_delay(loop, [recording], accept=True)
    assert delay_s == pytest.approx(late.delay, abs=0.0005)
    assert "set delay" in str(note)
    assert check_delay(late, [recording])[1] == []


def test_what_a_refusal_advises_fits_better() -> None:
    """The remedy is tried before it is printed, as it is printed."""
    loop = smooth.machine("rig")
    late = loop.model_copy(update={"delay": 0.013})
    recording, _ = simulate(late, smooth.motion("moves", 60.0, loop.sample_rate, 6), seed=6)
    fit = fit_delay(loop, recording)
    assert fit is not None and fit.significant and fit.improves(float(f"{fit.seconds:.4g}"))
    assert not fit.improves(0.04)


@pytest.mark.parametrize(("order", "rate"), [(2, 100.0), (3, 500.0), (2, 2000.0)])
@pytest.mark.parametrize("nominal", [True, False])
def test_polynomial_plants_of_any_order_and_rate(order: int, rate: float, nominal: bool) -> None:
    """With nominal coefficients or without: least squares then says where the search begins."""
    true = axis(order, rate, delay=2.0 / rate)
    r = lively(20.0, rate)
    recording, _ = simulate(true, r, noise_u_std=1e-3, noise_y_std=1e-5, seed=1)
    told = axis(order, rate, nominal=nominal)
    fit = fit_delay(told, recording, form_regressors(recording, told))
    assert fit is not None and fit.white
    assert abs(fit.seconds - true.delay) < max(4.0 * fit.std_s, 0.02 / rate)


def test_the_likelihood_has_no_jump_at_a_whole_sample() -> None:
    """What u was before the first sample is known: without it the likelihood falls by hundreds below a whole sample."""
    true = axis(2, 100.0, delay=0.02)
    recording, _ = simulate(true, lively(20.0, 100.0), noise_u_std=1e-3, noise_y_std=1e-5, seed=1)
    fit = fit_delay(true, recording)
    assert fit is not None
    assert fit.search.cost_at(0.02 - 1e-7) == pytest.approx(fit.search.cost_at(0.02), abs=1.0)


def test_friction_is_never_a_reason_to_refuse() -> None:
    """The jump of friction dates the delay, and the source of its sign moves it: cannot tell."""
    loop = smooth.machine("axis-2-friction")
    late = loop.model_copy(update={"delay": 2.0 / loop.sample_rate})
    recording, _ = simulate(late, smooth.motion("moves", 30.0, loop.sample_rate, 1), noise_y_std=1e-4, seed=1)
    delay_s, notes = check_delay(loop, [recording])
    assert delay_s is None and all("cannot" in str(note) or "do not determine" in str(note) for note in notes)


def test_a_slower_plant_is_no_delay() -> None:
    """Nothing known of an axis of order 3, smooth motion: its highest coefficient and a delay are all but the same.

    Least squares found a tenth of the coefficient, which the prior then held, and healthy recordings were refused.
    """
    made, told = smooth.machine("axis-3-unknown"), smooth.loop_file("axis-3-unknown")
    r = smooth.motion("moves and rests", smooth.SECONDS, made.sample_rate, 5)
    noise = 0.1 * smooth.NOISE_SHARE
    healthy, _ = simulate(made, r, noise_u_std=0.1 * noise, noise_y_std=noise * float(r.std()), seed=5)
    assert check_delay(told, [healthy])[0] is None


def test_a_delay_that_is_certain_but_rough_is_told_with_its_interval() -> None:
    """Two samples late under slow moves: there is a delay, of one sample or of three."""
    loop = smooth.machine("axis-2")
    late = loop.model_copy(update={"delay": 2.0 / loop.sample_rate})
    r = smooth.motion("moves", smooth.SECONDS, loop.sample_rate, 3)
    noise = 0.1 * smooth.NOISE_SHARE
    recording, _ = simulate(late, r, noise_u_std=0.1 * noise, noise_y_std=noise * float(r.std()), seed=3)
    delay_s, (note,) = check_delay(loop, [recording])
    assert delay_s is None and note.key == "learning.delay_rough"
    assert note.values["low_ms"] < 1e3 * late.delay < note.values["high_ms"]


def test_inspect_advises_no_delay_that_noise_fakes() -> None:
    loop = smooth.machine("rig")
    r = smooth.motion("moves", 60.0, loop.sample_rate, 7)
    healthy, _ = simulate(loop, r, noise_u_std=3.0 * NOISE_U_STD, noise_y_std=3.0 * NOISE_Y_STD, seed=7)
    assert not any(str(line).startswith("delay =") for line in inspect(healthy, loop).recommendations)


def test_study_of_smooth_motion_reports_what_it_saw() -> None:
    """The study itself, with one healthy and one late recording in the place of six hundred."""
    run = {"motion": "moves", "late": 0, "noise": 1.0, "refused": False, "found": 0.01}
    late = run | {"late": 1, "refused": True, "found": 0.98}
    ((_, healthy, _, one, *_, error),) = smooth.rows("rig", [{"runs": [run, late]}])
    assert (healthy, one, error) == ("0 of 1", "1 of 1", "0.02")
