"""Effects of the tissue: terms of its law, time and history dependence, layers, differences between sessions."""

from collections.abc import Mapping
from copy import copy
from dataclasses import replace

import numpy as np

from calibration.effects.candidates import (
    WIDER,
    check_biderman_case_and_get_parameter_names,
    find_lowest_missing_coefficient_and_power,
    make_candidate_per_test,
    require_tests,
)
from calibration.effects.effect import Candidate, DiagnosisData, Effect, NotTestableError, get_experiment
from tissue_sim.laws import find_law
from tissue_sim.material.material import BULK_RATIOS, Bulk, with_softening_form
from tissue_sim.material.softening import SofteningForm
from tissue_sim.model import Model


class I2Term(Effect):
    """Effect of a strain energy term C01 (I2 - 3) that the fitted law lacks; the parameter is C01, Pa."""

    name = "i2_term"
    category = "tissue"
    title = "second invariant (tension/compression asymmetry)"
    signature = "the stiffness changes differently with depth under plates and under the needle, equally at every speed"
    separated_by = "tension, or a compression to 20 mm"
    law = WIDER
    #: Trial contribution of the term to the shear modulus, as a fraction of the modulus.
    trial_fraction = 0.05
    #: Largest value of C01 that a refit may find, as a fraction of the shear modulus.
    max_fraction = 2.0

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidate that extends the fitted law to Biderman's law by C01."""
        if "C01" in check_biderman_case_and_get_parameter_names(situation.law):
            raise NotTestableError("the fitted law has a term in I2 - 3 already")
        # mu = 2 (C10 + C01).
        size = 0.5 * self.trial_fraction * situation.estimated_shear_modulus
        return [Candidate(self, {"C01": size}, absent={"C01": 0.0},
                          bounds={"C01": (0.0, self.max_fraction * situation.estimated_shear_modulus)}, law=WIDER)]


class Compressibility(Effect):
    """Effect of a bulk modulus below the assumed one, in the quantity that the campaign states (K/mu, K or D1)."""

    name = "compressibility"
    category = "tissue"
    title = "compressibility"
    signature = "tests that confine the tissue laterally are softer than the other tests predict, from the start on"
    separated_by = "unloading, which separates compressibility from friction, and a specimen of another height"
    #: Trial ratio K / mu. It lowers the force of bonded compression of the reference cylinder by 1 %.
    trial_ratio = 100.0

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidate with the trial ratio K / mu, or with a tenth of the stated ratio if this is smaller."""
        fit, mu = situation.campaign.fit, situation.estimated_shear_modulus
        for path in (path for path in fit.named if path.startswith("bulk.")):
            situation.require_unused_parameter(path)
        if any(find_law(name).is_compressible for name in fit.laws):
            raise NotTestableError("the law states the volumetric response itself")
        if not situation.simulated_tests():
            raise NotTestableError("all tests are computed by closed forms of an incompressible tissue")
        bulk = fit.bulk if fit.bulk.value is not None else Bulk("bulk_ratio", BULK_RATIOS[1])
        trial_ratio = min(self.trial_ratio, 0.1 * bulk.modulus(mu) / mu)
        if trial_ratio < 2.0 * BULK_RATIOS[0]:
            raise NotTestableError("the stated bulk modulus is already close to the smallest that the solver accepts")
        path, absent = f"bulk.{bulk.kind}", float(bulk.value or 0.0)

        def convert_ratio_to_stated_parameter(ratio: float) -> float:
            """Return the parameter of the bulk response (K / mu, K or D1) for a ratio K / mu."""
            return {"bulk_ratio": ratio, "K_Pa": ratio * mu, "D1_per_Pa": 2.0 / (ratio * mu)}[bulk.kind]

        low, high = sorted((absent, convert_ratio_to_stated_parameter(BULK_RATIOS[0])))
        return [Candidate(self, {path: convert_ratio_to_stated_parameter(trial_ratio)}, absent={path: absent},
                          bounds={path: (low, high)},
                          inverse=bulk.kind != "D1_per_Pa")]


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


class Poroelasticity(Effect):
    """Effect of force relaxation by drainage; one candidate per diffusivity that the recordings can resolve."""

    name = "poroelasticity"
    category = "tissue"
    title = "drainage of pore fluid"
    signature = "the force falls in holds, over a time that grows with the square of the contact size"
    separated_by = "holds with two contact sizes"
    #: Trial fraction of the stiffness that drainage removes.
    trial_fraction = 0.1
    #: Largest fraction of the stiffness that a refit may find.
    max_fraction = 0.95
    #: Trial diffusivities per decade.
    diffusivities_per_decade = 2.0
    #: Largest number of trial diffusivities.
    max_diffusivities = 8

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate (relaxing fraction of the stiffness) per trial diffusivity, m2/s."""
        if situation.campaign.fit.placeholder_material_with_effects.poroelasticity is not None:
            raise NotTestableError("the fitted material includes poroelasticity already, so this effect is not tested")
        radii = [situation.contact_radius(test) for test in require_tests(
            situation.simulated_tests(), "no test has a tool, so no contact size is known")]
        times = situation.list_resolvable_relaxation_times()
        slow, fast = min(radii) ** 2 / times[-1], max(radii) ** 2 / times[0]
        phi, D = "poroelasticity.phi", "poroelasticity.diffusivity"
        count = min(self.max_diffusivities, 1 + int(np.ceil(self.diffusivities_per_decade * np.log10(fast / slow))))
        return [Candidate(self, {phi: self.trial_fraction}, shape={D: diffusivity},
                          bounds={phi: (0.0, self.max_fraction), D: (0.1 * slow, 10.0 * fast)})
                for diffusivity in np.geomspace(slow, fast, count).tolist()]


class Softening(Effect):
    """Effect of a loss of stress below the largest previous strain energy; one candidate per trial energy fraction."""

    name = "softening"
    category = "tissue"
    title = "softening on first load (Mullins)"
    signature = "unloading and reloading are below the first loading, more so at smaller displacement, at every speed"
    separated_by = "unloading and loading again"
    #: Trial loss of stress, as a fraction of the stress.
    trial_loss = 0.1
    #: Largest loss of stress that a refit may find.
    max_loss = 0.95
    #: Trial fractions of the largest strain energy that must be released until the tissue has softened; each gives
    #: another shape of the unloading curve.
    trial_energy_fractions = (0.15, 0.4, 1.0, 3.0)
    #: Form of the softening, see `tissue_sim.material.softening.Softening`; the campaign states it.
    form: SofteningForm = "tanh"

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate per trial fraction of the strain energy."""
        if situation.campaign.fit.placeholder_material_with_effects.softening is not None:
            raise NotTestableError("the fitted material includes softening already, so this effect is not tested")
        require_tests(situation.simulated_tests(situation.test_has_unloading),
                      "no recording has an unloading, and softening does not change the first loading")
        loss, energy = "softening.loss", "softening.share"
        limits = 0.1 * self.trial_energy_fractions[0], 10.0 * self.trial_energy_fractions[-1]
        effect = copy(self)
        effect.form = situation.campaign.fit.softening_form
        return [Candidate(effect, {loss: self.trial_loss}, shape={energy: fraction},
                          bounds={loss: (0.0, self.max_loss), energy: limits})
                for fraction in self.trial_energy_fractions]

    def apply(self, model: Model, values: Mapping[str, float]) -> Model:
        """Return the model with softening in the form of the campaign."""
        softened = super().apply(model, values)
        return replace(softened, material=with_softening_form(softened.material, self.form))


class Layer(Effect):
    """Effect of a top layer with its own modulus; one candidate per trial thickness."""

    name = "layer"
    category = "tissue"
    title = "layer or skin"
    signature = "the stiffness under the needle differs between first contact and larger depth, unlike under plates"
    separated_by = "a second tip radius"
    #: Trial ratio of the moduli of layer and tissue.
    trial_ratio = 1.2
    #: Largest ratio of the moduli, and largest inverse ratio, that a refit may find.
    max_ratio = 30.0
    #: Trial thicknesses in units of the smallest contact radius: the smallest tool responds to layers of about its
    #: radius.
    trial_thicknesses = (0.125, 0.25, 0.5, 1.0)
    #: Largest thickness as a fraction of the height of the specimen.
    max_thickness_fraction = 0.4

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate (ratio of moduli) per trial thickness of the layer; the tests must include a needle."""
        if situation.campaign.fit.placeholder_material_with_effects.layers:
            raise NotTestableError("the fitted material includes layers already, so this effect is not tested")
        needles = require_tests(situation.simulated_tests(lambda test: not get_experiment(test).tool.is_plate),
                                "no test has a needle, and plates show only the mean stiffness of all layers")
        height = min(get_experiment(test).specimen.height for test in situation.simulated_tests())
        radius = min(map(situation.contact_radius, needles))
        thickest = self.max_thickness_fraction * height
        thicknesses = np.minimum(radius * np.array(self.trial_thicknesses), thickest)
        ratio, thickness = "layers[0].ratio", "layers[0].thickness"
        return [Candidate(self, {ratio: self.trial_ratio}, shape={thickness: h},
                          bounds={ratio: (1.0 / self.max_ratio, self.max_ratio),
                                  thickness: (0.05 * radius, thickest)})
                for h in dict.fromkeys(thicknesses.tolist())]


class Puncture(Effect):
    """Effect of a permanent drop of the needle force beyond a depth; one candidate per trial depth."""

    name = "puncture"
    category = "tissue"
    title = "puncture"
    signature = "the force of the needle drops suddenly at one depth and stays lower; plates show no drop"
    separated_by = "a repetition at a new site"
    #: Trial drop as a fraction of the force.
    trial_fraction = 0.05
    #: Largest drop, as a fraction of the force, that a refit may find.
    max_fraction = 0.95
    #: Trial depths as fractions of the largest depth of a needle.
    trial_depths = tuple(0.05 * step for step in range(1, 20))

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate (relative drop of the force) per trial depth of the puncture by a needle."""
        if situation.campaign.fit.placeholder_material_with_effects.puncture is not None:
            raise NotTestableError("the fitted material includes a puncture already, so this effect is not tested")
        needles = require_tests(situation.simulated_tests(lambda test: not get_experiment(test).tool.is_plate),
                                "no test has a needle")
        deepest = max(map(situation.largest_displacement, needles))
        drop, depth = "puncture.drop", "puncture.depth"
        return [Candidate(self, {drop: self.trial_fraction}, shape={depth: fraction * deepest},
                          bounds={drop: (0.0, self.max_fraction), depth: (0.01 * deepest, deepest)}, jump=depth)
                for fraction in self.trial_depths]


class SessionScale(Effect):
    """Effect of a stiffness factor of one test relative to the first test."""

    name = "session_scale"
    category = "tissue"
    title = "stiffness of one session (temperature)"
    signature = "all forces of one test are too high, or too low, by the same factor"
    separated_by = "a thermometer, or a repetition of the first test after the last test"
    known_twins = ("radius_error",)
    #: Trial relative change of the stiffness.
    trial_change = 0.02
    #: Largest factor of the stiffness, and largest inverse factor, that a refit may find.
    max_factor = 5.0

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate with a stiffness factor for each simulated test except the first."""
        path = "effects.stiffness_scale.ratio"
        situation.require_unused_parameter(path)
        others = require_tests(situation.simulated_tests()[1:],
                               "only one test has a tool, so its stiffness has no reference")
        return make_candidate_per_test(self, others, lambda _: {path: 1.0 + self.trial_change},
                                       bounds={path: (1.0 / self.max_factor, self.max_factor)})


class StrainStiffening(Effect):
    """Effect of a strain energy term in the lowest power of I1 - 3 that the fitted law lacks."""

    name = "strain_stiffening"
    category = "tissue"
    title = "strain stiffening"
    signature = "the force rises more steeply at the end of the ramp than the law allows, in all tests at every speed"
    separated_by = "any second test, or a deeper ramp"
    law = WIDER
    #: Trial contribution of the new term to the stress at the largest strain, as a fraction of the stress.
    trial_fraction = 0.2
    #: Largest coefficient that a refit may find, in units of the trial coefficient. The bound is wide because the term
    #: grows so steeply with strain that it is small in most of the tissue.
    max_trial_coefficients = 500.0

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidate with the lowest power of I1 - 3 that the fitted law lacks."""
        path, order = find_lowest_missing_coefficient_and_power(situation.law)
        largest = max((situation.largest_strain(test) for test in situation.simulated_tests()), default=0.1)
        # Ratio of the stresses of Cn0 (I1 - 3)^n and C10 (I1 - 3), with C10 = mu / 2 and I1 = 3 + 3 strain^2 to lowest
        # order.
        mu = situation.estimated_shear_modulus
        size = self.trial_fraction * 0.5 * mu / (order * (3.0 * largest**2) ** (order - 1))
        return [Candidate(self, {path: size}, absent={path: 0.0},
                          bounds={path: (0.0, self.max_trial_coefficients * size)}, law=WIDER)]
