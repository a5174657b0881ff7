"""The relaxation of a hold of force alone, for tools without a closed form."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.campaign.campaign import Campaign, FitSettings, Noise, Test
from calibration.campaign.measured import MeasuredCurve, with_noise
from calibration.campaign.parameters import SHARED, NamedParameter
from calibration.fit.assess import assess
from calibration.fit.estimate import Estimate
from calibration.fit.ordinary import Ordinary, fit_law
from calibration.forward.solves import Solves
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.material.parts import find_declaration
from tissue_sim.material.viscoelasticity import MOST_TERMS, Prony
from tissue_sim.recording.recording import Recording

#: A hold that moves more than this share of its displacement is not one.
HELD = 0.05
#: Shear at which a Neo-Hookean solid is linear to the last digits.
_SMALL = 1e-6
_LAW = "neo_hooke"


@dataclass(frozen=True)
class HoldFit:
    """A Prony series fitted to a hold.

    Attributes:
        force: of a sudden test to the same depth, N (Pa where nominal stress was recorded).
        prony: the series; moduli are instantaneous.
        standard_errors: ``force``, and paths such as ``viscoelastic.terms[0].g``: None where not determined.
        RMSE: of all samples, N. status, message: as of a `Fit`.
    """

    force: float
    prony: Prony
    standard_errors: dict[str, float | None]
    RMSE: float
    status: str
    message: str


def fit_hold(recording: Recording, terms: int = 1, ramp: float = 0.0) -> HoldFit:
    """Fit a Prony series to the force of a hold: g and tau only.

    At constant depth the force of a linear solid is proportional to its relaxation modulus, whatever the tool (Lee and
    Radok, J. Appl. Mech. 27 (1960) 438): a spherical tip and shallow depth, as in atomic force microscopy, or small
    strain. So the hold is fitted as that of a linear solid in shear, like any relaxation of a campaign.

    Args:
        recording: ``time`` and ``force`` (or ``nominal stress``) of the hold, from its first sample on.
        terms: 1 to 4.
        ramp: how long the loading before it took, s; the elastic force is taken as linear in time within it.

    Raises:
        InputError: a channel missing, a displacement that moves more than 5 % of itself, too few samples or too many
            terms.
        ConvergenceError: no start gives a finite force.
    """
    if not 0 <= ramp < np.inf:
        raise InputError(f"{ramp:g} s is not a duration; give the time that the loading took", field="ramp")
    if not 1 <= terms <= MOST_TERMS:
        raise InputError(f"{terms} terms; give 1 to {MOST_TERMS}", field="terms")
    channel = "nominal stress" if "nominal stress" in recording and "force" not in recording else "force"
    force, time = recording.channel(channel), recording.time
    if "displacement" in recording and np.ptp(recording.displacement) > HELD * np.abs(recording.displacement).max():
        raise InputError("the displacement moves during the hold; select the samples of the hold, "
                         "recording.select(recording.labels['segment'] == 'hold')", field="displacement")
    if force.size <= 1 + 2 * terms:
        raise InputError(f"{force.size} samples cannot determine {1 + 2 * terms} unknowns; give more samples or fewer "
                         "terms", field="recording")
    strain = np.full(force.size, _SMALL)
    if ramp:
        time, force, strain = np.append(time[0] - ramp, time), np.append(0.0, force), np.append(0.0, strain)
    paths = [(f"viscoelastic.terms[{i}].g", f"viscoelastic.terms[{i}].tau") for i in range(terms)]
    start = {name: value for i, (g, tau) in enumerate(paths) for name, value in (
        (g, 0.5 / terms), (tau, float(np.ptp(time)) * 10.0 ** (i - terms)))}
    test = Test("hold", KINDS["simple_shear"], None, (Path("hold"),))
    named = {path: NamedParameter(path, find_declaration(path)[1], False, SHARED, (test.name,)) for path in start}
    campaign = Campaign(Path("hold"), {}, (test,), FitSettings((_LAW,), named=named, start=start), Noise(), "")
    curve = MeasuredCurve(test.name, test, time, strain, force, np.full(force.size, "hold"), Path("hold"), "", True)
    estimator = Ordinary(campaign, {test.name: (replace(curve, noise=with_noise(curve, campaign).noise),)}, Solves())
    descents, estimate = fit_law(estimator.problem(_LAW))
    if not isinstance(estimate, Estimate):
        raise ConvergenceError("no start gives a finite force over the hold; check the units of force and time")
    spread = estimator.uncertainty(estimate.problem, estimate.evaluation)
    fit = assess(estimator, estimate, spread, descents, (), campaign)
    material = estimate.problem.space.material(fit.parameters)
    size = 2.0 * _SMALL
    error = fit.standard_errors["C10"]
    errors = {"force": None if error is None else size * error, **{name: fit.standard_errors[name] for name in start}}
    message = fit.message.replace("C10", "force")
    residual = estimate.evaluation.force - estimate.problem.data
    return HoldFit(size * fit.parameters["C10"], material.viscoelastic, errors,
                   float(np.sqrt(np.mean(residual**2))), fit.status, message)
