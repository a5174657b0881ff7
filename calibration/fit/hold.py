"""Fit of a Prony series to the force of a hold, for tools without a closed form."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.campaign.campaign import Campaign, FitSettings, Noise, Test
from calibration.campaign.measured import MeasuredCurve, add_noise_and_requested_interpolation
from calibration.campaign.parameters import SHARED, ScopedCampaignParameter
from calibration.fit.assess import build_fit_record
from calibration.fit.estimate import Estimate
from calibration.fit.ordinary import OrdinaryLeastSquaresEstimator, fit_law_to_descents_and_estimate
from calibration.forward.simulation_cache import SimulationCache
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.material.parts import find_parameter_path_and_declaration
from tissue_sim.material.viscoelasticity import MOST_TERMS, Prony
from tissue_sim.recording.recording import Recording


@dataclass(frozen=True)
class HoldDriftLimitAndShearStrain:
    """Settings of the fit of a hold.

    Attributes:
        max_drift: largest change of the displacement during a hold, relative to the displacement. A larger value admits
            holds whose force also follows the displacement.
        shear_strain: shear strain at which a Neo-Hookean solid is linear in floating-point precision.
    """

    max_drift: float = 0.05
    shear_strain: float = 1e-6


_SETTINGS = HoldDriftLimitAndShearStrain()
#: Law of the equivalent solid.
_LAW = "neo_hooke"


@dataclass(frozen=True)
class HoldFit:
    """Prony series fitted to a hold.

    Attributes:
        force: force of an instantaneous test to the same depth, N (Pa if nominal stress was recorded).
        prony: Prony series of instantaneous moduli.
        standard_errors: ``force`` and paths such as ``viscoelastic.terms[0].g`` -> standard error, SI; None if not
            determined.
        RMSE: root mean square error of all samples, N.
        status: see `calibration.fit.fit.Fit`.
        message: see `calibration.fit.fit.Fit`.
    """

    force: float
    prony: Prony
    standard_errors: dict[str, float | None]
    RMSE: float
    status: str
    message: str


def fit_hold(recording: Recording, terms: int = 1, ramp: float = 0.0) -> HoldFit:
    """Fit a Prony series (g_i and tau_i) to the force of a hold.

    At constant depth the force of a linear viscoelastic solid is proportional to its relaxation modulus for every tool,
    F(t) = F_0 (1 - sum g_i (1 - exp(-t / tau_i))). The hold is therefore fitted as that of a linear solid in shear. The
    proportionality holds for small strains or shallow depths, as in atomic force microscopy.

    Args:
        recording: ``time`` and ``force`` (or ``nominal stress``) of the hold, beginning with its first sample.
        terms: number of Prony terms, 1 to 4.
        ramp: duration of the loading before the hold, s; the elastic force increases linearly in this time.

    Raises:
        InputError: a channel is missing, the displacement changes by more than 5 %, or there are too few samples or too
            many terms.
        ConvergenceError: no start gives a finite force.

    Source: Lee and Radok, J. Appl. Mech. 27 (1960) 438.
    """
    if not 0 <= ramp < np.inf:
        raise InputError(f"ramp must be 0 or positive; got {ramp:g} s", field="ramp")
    if not 1 <= terms <= MOST_TERMS:
        raise InputError(f"terms must be 1 to {MOST_TERMS}; got {terms}", field="terms")
    channel = "nominal stress" if "nominal stress" in recording and "force" not in recording else "force"
    force, time = recording.channel(channel), recording.time
    if "displacement" in recording and \
            np.ptp(recording.displacement) > _SETTINGS.max_drift * np.abs(recording.displacement).max():
        raise InputError("displacement must be constant during the hold; select the samples of the hold, "
                         "recording.select(recording.labels['segment'] == 'hold')", field="displacement")
    if force.size <= 1 + 2 * terms:
        raise InputError(f"{force.size} samples cannot determine {1 + 2 * terms} unknowns; give more samples or fewer "
                         "terms", field="recording")
    strain = np.full(force.size, _SETTINGS.shear_strain)
    if ramp:
        time, force, strain = np.append(time[0] - ramp, time), np.append(0.0, force), np.append(0.0, strain)
    paths = [(f"viscoelastic.terms[{i}].g", f"viscoelastic.terms[{i}].tau") for i in range(terms)]
    start = {name: value for i, (g, tau) in enumerate(paths) for name, value in (
        (g, 0.5 / terms), (tau, float(np.ptp(time)) * 10.0 ** (i - terms)))}
    test = Test("hold", KINDS["simple_shear"], None, (Path("hold"),))
    named = {path: ScopedCampaignParameter(path, find_parameter_path_and_declaration(path)[1], False, SHARED,
                                           (test.name,))
             for path in start}
    campaign = Campaign(Path("hold"), {}, (test,), FitSettings((_LAW,), named=named, start=start), Noise(), "")
    curve = MeasuredCurve(test.name, test, time, strain, force, np.full(force.size, "hold"), Path("hold"), "", True)
    noisy = replace(curve, noise=add_noise_and_requested_interpolation(curve, campaign).noise)
    estimator = OrdinaryLeastSquaresEstimator(campaign, {test.name: (noisy,)}, SimulationCache())
    descents, estimate = fit_law_to_descents_and_estimate(estimator.build_law_problem(_LAW))
    if not isinstance(estimate, Estimate):
        raise ConvergenceError("no start gives a finite force over the hold; check the units of force and time")
    spread = estimator.problem_uncertainty_function(estimate.problem, estimate.evaluation)
    fit = build_fit_record(estimator, estimate, spread, descents, (), campaign)
    material = estimate.problem.space.build_material(fit.parameters)
    size = 2.0 * _SETTINGS.shear_strain
    error = fit.standard_errors["C10"]
    errors = {"force": None if error is None else size * error, **{name: fit.standard_errors[name] for name in start}}
    message = fit.message.replace("C10", "force")
    residual = estimate.evaluation.force - estimate.problem.data
    return HoldFit(size * fit.parameters["C10"], material.viscoelastic, errors,
                   float(np.sqrt(np.mean(residual**2))), fit.status, message)
