"""Contact offsets far beyond their assumed scatter, such as a displacement set to zero at a preload."""

from __future__ import annotations

from dataclasses import replace

from calibration.diagnosis.evidence import Evidence, gather
from calibration.fit.generalised import SUSPECT
from calibration.fit.run_context import RunContext
from calibration.statistics.jitter import Jitter
from tissue_sim.errors import ConvergenceError

#: Fits at most, each counted from the contacts of the one before.
_MOST_FITS = 4
#: A contact is settled within this many standard deviations of its prior.
_SETTLED = 0.2

def settle_contacts(evidence: Evidence, context: RunContext) -> tuple[Evidence, list[str]]:
    """The evidence with displacements from the contacts found, and a sentence on each contact far from its prior.

    A contact beyond the prior is biased by the prior and by the straight continuation of the simulated path, and both
    show as effects. Here displacements are counted from the contacts that were found, and the fit is repeated. Only
    where every region agrees and the scatter was assumed; elsewhere the evidence is returned unchanged.

    Args:
        evidence: at its minimum, without any effect. steps: where the further fits run.
    """
    scatter, found, shifts = evidence.problem.jitter, evidence, dict[str, float]()
    if scatter.freedom != 0 or not evidence.explained:
        return evidence, []
    for _ in range(_MOST_FITS):
        far = {name: contact for name, contact in _contacts(found).items() if abs(contact) > SUSPECT * scatter.contact
               or (name in shifts and abs(contact) > _SETTLED * scatter.contact)}
        if not far:
            break
        shifts |= {name: shifts.get(name, 0.0) + contact for name, contact in far.items()}
        measured = {test: tuple(replace(curve, displacement=curve.displacement - shifts.get(curve.name, 0.0))
                                for curve in curves) for test, curves in evidence.measured.items()}
        try:
            found = gather(evidence.campaign, measured, evidence.problem.solves, context)
        except ConvergenceError:
            return evidence, []
    if not found.explained:
        return evidence, []
    rest = _contacts(found)
    stressed = {curve.name: curve.stressed for curve in evidence.problem.measured}
    return found, [_sentence(name, shift + rest[name], scatter, stressed[name]) for name, shift in shifts.items()]


def _contacts(evidence: Evidence) -> dict[str, float]:
    """Recording -> contact offset, m (strain)."""
    problem, nuisances = evidence.problem, evidence.evaluation.nuisances
    if "contact" not in problem.kinds:
        return {}
    place = problem.kinds.index("contact")
    return {curve.name: float(nuisances[columns][place]) * problem.jitter.contact
            for columns, curve in zip(problem.offset_columns, problem.measured, strict=True)}


def _sentence(name: str, contact: float, scatter: Jitter, stressed: bool) -> str:
    """A contact beyond the assumed scatter, in words."""
    size, assumed = (f"{each:.2g} of strain" if stressed else f"{1e3 * each:.2f} mm"
                     for each in (abs(contact), scatter.contact))
    return (f"contact offset of {name}: contact lies {size} {'before' if contact < 0 else 'after'} the zero of the "
            f"displacement, {abs(contact) / scatter.contact:.2g} times the assumed scatter of {assumed}")
