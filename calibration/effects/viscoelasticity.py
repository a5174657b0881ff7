"""Viscoelastic relaxation of the tissue."""

from calibration.effects.effect import Candidate, DiagnosisData, Effect, NotTestableError


class Viscoelasticity(Effect):
    """Effect of one more Prony term; one candidate per relaxation time that the recordings can resolve.

    The effect is added up to three times if one term does not suffice.
    """

    name = "viscoelasticity"
    category = "tissue"
    title = "viscoelasticity"
    signature = "the force falls in holds, grows with the speed and is lower in unloading than in loading, in all tests"
    separated_by = "a hold, or a second speed"
    max_instances = 3
    #: Trial fraction g of the stiffness that relaxes.
    trial_fraction = 0.1
    #: Largest fraction g that a refit may find.
    max_fraction = 0.95

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate (one more Prony term) per relaxation time that the recordings resolve."""
        series = situation.campaign.fit.placeholder_material_with_effects.viscoelastic
        number = 0 if series is None else len(series.terms)
        if number >= self.max_instances:
            raise NotTestableError(f"the fitted material includes {number} Prony terms already, so this effect is not "
                                   "tested")
        g, tau = (f"viscoelastic.terms[{number}].{name}" for name in ("g", "tau"))
        step, longest = situation.sampling_interval_and_duration
        return [Candidate(self, {g: self.trial_fraction}, shape={tau: time},
                          bounds={g: (0.0, self.max_fraction), tau: (0.3 * step, 10.0 * longest)})
                for time in situation.list_resolvable_relaxation_times()]
