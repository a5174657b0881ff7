"""Draw an effect to hide in a virtual specimen or rig, and judge whether a diagnosis found the effect."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

import tissue_sim as ts
from calibration.diagnosis.diagnosis import (
    Diagnosis,
    EffectParameter,
    describe_effect,
    describe_parameter,
    join_as_enumeration,
)
from calibration.effects.catalogue import CATALOGUE
from tissue_sim.experiment.contact_law import AS_TOOL
from tissue_sim.parameters import parameters

#: Name of the compression test between lubricated plates.
PLATES = "plates"
#: Name of the needle test.
NEEDLE = "needle"


@dataclass(frozen=True)
class HiddenEffect:
    """Effect that is hidden in a virtual experiment, or no effect.

    Attributes:
        name: name of the effect in the catalogue; empty: no effect is hidden.
        values: path in the model -> value of each parameter of the effect, SI units.
        tests: names of the tests that contain the effect.
    """

    name: str = ""
    values: Mapping[str, float] = field(default_factory=dict)
    tests: tuple[str, ...] = ()

    def add_effect_to_test_model(self, test: str, model: ts.Model) -> ts.Model:
        """Return the model of a test with the effect, or the unchanged model if the test does not contain the effect.

        Args:
            test: name of the test.
            model: model of the test without the effect.
        """
        return make_model_with_effect(self.name, self.values, model) if test in self.tests else model

    def describe_with_values(self, models: Mapping[str, ts.Model]) -> str:
        """Return title and values of the effect, such as ``viscoelasticity (g1 = 0.12, tau1 = 14.1 s)``.

        Args:
            models: test -> model without the effect; used for symbols and units of the parameters.
        """
        if not self.name:
            return "nothing"
        known = {path.removeprefix("material."): each
                 for path, each in parameters(self.add_effect_to_test_model(self.tests[0],
                                                                            models[self.tests[0]])).items()}
        numbers = [describe_parameter(EffectParameter(path=path, symbol=known[path].symbol, value=value,
                                                      unit=known[path].declaration.unit))
                   for path, value in self.values.items()]
        return f"{CATALOGUE[self.name].title} ({', '.join(numbers)})"


def make_model_with_effect(name: str, values: Mapping[str, float], model: ts.Model) -> ts.Model:
    """Return a copy of a model with an effect of the catalogue; friction is applied to both plates.

    Args:
        name: name of the effect in the catalogue.
        values: path in the model -> value of each parameter, SI units.
        model: model without the effect.
    """
    model = CATALOGUE[name]().apply(model, values)
    if "experiment.friction" not in values:
        return model
    return replace(model, experiment=replace(model.experiment, friction_base=AS_TOOL))


@dataclass(frozen=True)
class HideableEffectRange:
    """Effect that the two tests of the demonstration can reveal, with the range of its size.

    Attributes:
        name: name of the effect in the catalogue.
        sizes: path in the model -> lowest and highest value, SI units.
        tests: names of the tests that contain the effect.
    """

    name: str
    sizes: Mapping[str, tuple[float, float]]
    tests: tuple[str, ...] = (PLATES, NEEDLE)

    def draw_random_hidden_effect(self, random: np.random.Generator) -> HiddenEffect:
        """Draw the values of the effect from a log-uniform distribution, rounded to three digits.

        Args:
            random: random number generator.
        """
        values = {path: float(f"{np.exp(random.uniform(*np.log(ends))):.3g}") for path, ends in self.sizes.items()}
        return HiddenEffect(self.name, values, self.tests)


#: Effects that can be hidden.
HIDEABLE_EFFECTS = (
    HideableEffectRange("viscoelasticity",
                        {"viscoelastic.terms[0].g": (0.05, 0.2), "viscoelastic.terms[0].tau": (5.0, 30.0)}),
    HideableEffectRange("softening", {"softening.loss": (0.05, 0.25), "softening.share": (0.7, 1.5)}),
    HideableEffectRange("plate_friction", {"experiment.friction": (0.02, 0.1)}, (PLATES,)),
    HideableEffectRange("machine_compliance", {"rig.compliance": (7e-5, 1.5e-4)}),
    HideableEffectRange("sensor_drift", {"rig.sensor_drift": (3e-4, 1.5e-3)}),
    HideableEffectRange("edge_rounding", {"experiment.tool.edge_radius": (1e-3, 2.5e-3)}, (NEEDLE,)),
    HideableEffectRange("backlash", {"rig.backlash": (5e-5, 2e-4)}))


def choose_hidden_or_no_effect(seed: int) -> HiddenEffect:
    """Draw one of `HIDEABLE_EFFECTS`, or no effect, with equal probability; equal seeds draw the same effect.

    Args:
        seed: seed of the random number generator.
    """
    random = np.random.default_rng(seed)
    number = int(random.integers(len(HIDEABLE_EFFECTS) + 1))
    return HIDEABLE_EFFECTS[number].draw_random_hidden_effect(random) if number < len(HIDEABLE_EFFECTS) \
        else HiddenEffect()


def judge_diagnosis_with_sentence(hidden: HiddenEffect, diagnosis: Diagnosis) -> tuple[bool, str]:
    """Return whether a diagnosis found the hidden effect, and a sentence on it.

    Args:
        hidden: hidden effect, or no effect.
        diagnosis: diagnosis of the virtual measurements.

    Returns:
        Whether the diagnosis is right, and a sentence that states the result.
    """
    named = [each.name for each in diagnosis.effects]
    candidates = [name.partition("@")[0] for name in diagnosis.indistinguishable]
    found = join_as_enumeration([describe_effect(each) for each in diagnosis.effects])
    if not hidden.name:
        right = diagnosis.verdict == "NONE"
        return right, "Nothing was hidden, and nothing was found." if right else \
            f"False alarm: nothing was hidden, and the diagnosis reports {found or 'an unknown effect'}."
    if diagnosis.verdict == "SET" and hidden.name in candidates:
        return True, (f"Found, but not uniquely: it is one of {len(candidates)} effects that these tests cannot "
                      "distinguish.")
    if hidden.name in named:
        others = "" if len(named) == 1 else ", together with an effect that was not hidden"
        confirmation = "" if diagnosis.verdict == "NAMED" else ", its form unconfirmed"
        return len(named) == 1, f"Found{others}{confirmation}: {found}."
    if diagnosis.verdict == "NONE":
        return False, "Missed: the diagnosis reports no effect."
    if diagnosis.verdict == "UNKNOWN":
        return False, ("Partly found: the diagnosis reports that an effect is missing from the model, but does not "
                       "identify it.")
    return False, f"Wrong: the diagnosis reports {found}."
