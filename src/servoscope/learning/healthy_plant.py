"""A step of learning: the healthy plant and its noise, and the sequential test that follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from servoscope.baseline.expectation import Expectation, reference_path, residual_noise_model, residual_system
from servoscope.baseline.hypothesis import CusumHypothesis
from servoscope.baseline.plant_fit import (
    HealthyPlant,
    can_simulate,
    describe_healthy_plant,
    fit_healthy_plant,
    split_residual_noise,
)
from servoscope.baseline.records import HealthyParameters
from servoscope.baseline.threshold import CalibrationFactors
from servoscope.core.arrays import FloatArray, to_tuples
from servoscope.core.messages import Message, message
from servoscope.detection import homogeneity
from servoscope.detection.threshold_calibration import design_sequential_test
from servoscope.estimation.filter_bank import nominal_theta
from servoscope.estimation.noise_model import (
    AR_ORDER,
    ArmaNoise,
    WhiteNoise,
    sample_autocovariance,
    yule_walker,
)
from servoscope.evidence.kind import HealthyRecordings
from servoscope.fit.tuning import TuningFit, prefers_white_noise
from servoscope.fit.white_noise import fit_white_noise
from servoscope.learning.innovation_fit import FILE_ERROR, fit_innovations
from servoscope.models.plants import Plant

ROUNDING_SHARE = 1e-9  # of the residual's variance: what is left below is rounding
MIN_PHYSICS_PROBABILITY = 1e-3  # probability below which the physics are not believed to hold
MAX_MISFIT_PER_COEFFICIENT = 10.0  # from which a misfit of the physics is noted

KnownParameters = tuple[tuple[str, ...], FloatArray, FloatArray]  # names, logarithms (m,), covariance (m, m)


@dataclass(frozen=True, eq=False)
class PlantKnowledge:
    """What is known of the plant behind the coefficients: these are those of least squares where nothing is."""

    plant: Plant  # with its healthy parameters
    fit: TuningFit  # with the noise's colour as it is known now
    theta: FloatArray  # coefficients, shape (n,), with their covariance (n, n)
    theta_covariance: FloatArray
    deviations: FloatArray  # of the recordings from what is expected of each, shape (m, n)
    expectations: Sequence[Expectation] = ()  # one per recording, where the loop can be simulated
    noise: WhiteNoise | None = None
    loudest: WhiteNoise | None = None  # the largest noise that the recordings allow
    healthy: HealthyPlant | None = None
    model_theta: FloatArray = field(default_factory=lambda: np.zeros(0))  # where its parameters lead to
    notes: tuple[Message, ...] = ()

    @property
    def ratios(self) -> dict[str, float]:
        """Healthy parameters relative to the loop file's; empty where they are those of the file."""
        return {} if self.healthy is None else self.healthy.ratios

    @property
    def holds(self) -> bool:
        """Whether the physics explain the coefficients: what they say is then known better than these one by one."""
        from scipy import special

        if self.healthy is None:
            return False
        return self.healthy.misfit <= float(special.chdtri(len(self.theta), MIN_PHYSICS_PROBABILITY))

    def describe(self) -> HealthyParameters:
        """Return what a baseline keeps."""
        std = {} if self.healthy is None else self.healthy.std()
        covariance = np.zeros((0, 0)) if self.healthy is None else self.healthy.covariance
        return HealthyParameters(
            noise=self.noise,
            loudest=self.loudest,
            ratios=self.ratios,
            std=std,
            covariance=to_tuples(covariance),
            theta=tuple(self.model_theta),
        )


def learn_plant(healthy: HealthyRecordings, exact: bool = False) -> PlantKnowledge:
    """Find the healthy plant and its noise; with `exact` the plant is that of the loop file."""
    loop, fit = healthy.loop, healthy.fit
    theta = fit.tuning.theta
    if not can_simulate(loop):
        return PlantKnowledge(loop.plant, fit, theta, fit.covariance, fit.each)
    noise = split_residual_noise(healthy.pipeline, fit, healthy.regressions)
    expectations = [Expectation(healthy.pipeline, fit.tuning, noise, reference_path(rec)) for rec in healthy.recordings]
    if exact:
        theta = expectations[0].batch_estimate(loop.plant)
        return PlantKnowledge(loop.plant, fit, theta, fit.covariance, fit.each, expectations, noise, model_theta=theta)
    known, noise, notes = _likeliest_parameters(healthy, noise)
    plant = _describe(healthy, expectations, fit, known, nominal_theta(loop), fit.tuning.noise)
    noise, loudest, fit, colour = _learn_noise(healthy, plant, noise)
    expectations = [replace(e, tuning=fit.tuning, noise=noise) for e in expectations]
    plant = _describe(healthy, expectations, fit, known, plant.true_theta, colour)
    if healthy.population is not None:
        x = np.log(list(plant.ratios.values()))
        shared = healthy.population.combine_ratios(tuple(plant.ratios), x, plant.covariance)
        plant = plant if shared is None else describe_healthy_plant(expectations, healthy.regressions, fit, *shared)
    changed = loop.plant.scaled(plant.ratios)
    if plant.misfit > MAX_MISFIT_PER_COEFFICIENT * len(theta):
        notes.append(message("learning.physics_misfit", misfit=plant.misfit, expected=len(theta)))
    deviations = fit.each - np.array([e.batch_estimate(changed) for e in expectations])  # each reference has its bias
    learned = PlantKnowledge(
        changed, fit, theta, fit.covariance, deviations, expectations, noise, loudest, plant, plant.theta, tuple(notes)
    )
    return replace(learned, theta=plant.theta, theta_covariance=plant.theta_covariance) if learned.holds else learned


def _likeliest_parameters(
    healthy: HealthyRecordings, noise: WhiteNoise
) -> tuple[KnownParameters | None, WhiteNoise, list[Message]]:
    """Return the parameters and the noise by the innovations, where the plant is of the kind of the loop file.

    Nothing of what y does between the samples, which the recursion's residual takes for noise, is left out. None where
    the innovations are not white, and with covariates, which are taken out of the regressions, not of the recordings.
    """
    fit = None if healthy.covariates is not None else fit_innovations(healthy.loop, healthy.recordings, noise)
    if fit is None or not fit.explains:
        return None, noise, []
    wrong_file = len(fit.names) > len(healthy.loop.plant.parameters)
    notes = [message("learning.wrong_file", share=FILE_ERROR)] if wrong_file else []
    return (fit.names, fit.x, fit.covariance), fit.noise, notes


def _describe(
    healthy: HealthyRecordings,
    expectations: Sequence[Expectation],
    fit: TuningFit,
    known: KnownParameters | None,
    theta: FloatArray,
    colour: ArmaNoise,
) -> HealthyPlant:
    """Return the plant of known parameters, or that of least squares on a residual about theta, which has a colour."""
    if known is not None:
        return describe_healthy_plant(expectations, healthy.regressions, fit, *known)
    return fit_healthy_plant(expectations, healthy.regressions, fit, theta, colour)


def _learn_noise(
    healthy: HealthyRecordings, plant: HealthyPlant, noise: WhiteNoise
) -> tuple[WhiteNoise, WhiteNoise | None, TuningFit, ArmaNoise]:
    """Return the noise, the loudest one that the recordings allow, the fit with its colour, and the residual's.

    What the plant leaves of the residual is noise alone: its colour is known better than before.
    """
    pipeline, fit = healthy.pipeline, healthy.fit
    gamma = sample_autocovariance(plant.residuals, AR_ORDER)
    silent = not gamma[0] > ROUNDING_SHARE * fit.tuning.R  # simulated without noise, for example
    colour = fit.tuning.noise if silent else yule_walker(gamma)
    if pipeline.stage_one is not None or silent:
        return noise, None, fit, colour
    changed = healthy.loop.plant.scaled(plant.ratios)
    noises = fit_white_noise(residual_system(pipeline, changed), plant.residuals, pipeline.stride)
    if not prefers_white_noise(plant.residuals, noises, colour):
        return noise, None, fit, colour
    colour = residual_noise_model(pipeline, changed, noises.noise)
    return noises.noise, noises.loudest, replace(fit, tuning=replace(fit.tuning, noise=colour)), colour


def learn_sequential_test(
    healthy: HealthyRecordings, plant: PlantKnowledge, scatters: bool = False
) -> tuple[CalibrationFactors, tuple[CusumHypothesis, ...], list[Message]]:
    """Design the sequential test where the physics hold, and count its false alarms and those of T^2.

    It takes the parameters for constant: where they scatter, healthy recordings would be alarms. `scatters`: whether an
    earlier baseline of the machine shows that they do.
    """
    none: tuple[CalibrationFactors, tuple[CusumHypothesis, ...], list[Message]] = CalibrationFactors(), (), []
    if not plant.holds or not plant.loudest or healthy.loop.monitor.model_error:
        return none
    if healthy.covariates is not None:
        return *none[:2], [message("learning.no_test_along", names=healthy.covariates.names)]
    by_chance = homogeneity.scatter_probability(plant.deviations, plant.fit.each_covariance)
    scatters = scatters or by_chance <= homogeneity.SCATTER_BY_CHANCE
    if scatters or (healthy.population is not None and not healthy.population.sequential):
        return none
    assert plant.healthy is not None, "the physics hold"
    known = plant.healthy.theta, plant.healthy.covariance
    return design_sequential_test(healthy.recordings, plant.expectations, plant.plant, *known, plant.loudest)
