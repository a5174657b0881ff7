"""What the demo may hide in a virtual specimen or in the rig that measures it, and whether a diagnosis found it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

import tissue_sim as ts
from calibration.diagnosis.diagnosis import Diagnosis, Number
from calibration.diagnosis.words import effect_in_words, joined, number_in_words
from calibration.effects.catalogue import CATALOGUE
from tissue_sim.experiment.interfaces import AS_TOOL
from tissue_sim.parameters import parameters

PLATES, NEEDLE = "plates", "needle"


@dataclass(frozen=True)
class Hidden:
    """What was hidden.

    Attributes:
        name: in the catalogue; empty: nothing. values: path in the model -> value, SI. tests: that have it.
    """

    name: str = ""
    values: Mapping[str, float] = field(default_factory=dict)
    tests: tuple[str, ...] = ()

    def within(self, test: str, model: ts.Model) -> ts.Model:
        """The model of a test with it."""
        return with_effect(self.name, self.values, model) if test in self.tests else model

    def in_words(self, models: Mapping[str, ts.Model]) -> str:
        """``viscoelasticity (g1 = 0.12, tau1 = 14.1 s)``, by the models of the tests without it."""
        if not self.name:
            return "nothing"
        known = {path.removeprefix("material."): each
                 for path, each in parameters(self.within(self.tests[0], models[self.tests[0]])).items()}
        numbers = [number_in_words(Number(path=path, symbol=known[path].symbol, unit=known[path].declaration.unit,
                                          value=value)) for path, value in self.values.items()]
        return f"{CATALOGUE[self.name].title} ({', '.join(numbers)})"


def with_effect(name: str, values: Mapping[str, float], model: ts.Model) -> ts.Model:
    """A model with an effect of the catalogue; plates with friction have it on both sides."""
    model = CATALOGUE[name]().apply(model, values)
    if "experiment.friction" not in values:
        return model
    return replace(model, experiment=replace(model.experiment, friction_base=AS_TOOL))


@dataclass(frozen=True)
class Hideable:
    """An effect that a compression and a needle with a hold and a return can show, and how large it may be.

    Attributes:
        name: in the catalogue. sizes: path in the model -> lowest and highest value, SI. tests: that have it.
    """

    name: str
    sizes: Mapping[str, tuple[float, float]]
    tests: tuple[str, ...] = (PLATES, NEEDLE)

    def draw(self, random: np.random.Generator) -> Hidden:
        """Sizes evenly spread in their logarithm, three digits of each."""
        values = {path: float(f"{np.exp(random.uniform(*np.log(ends))):.3g}") for path, ends in self.sizes.items()}
        return Hidden(self.name, values, self.tests)


HIDEABLE = (
    Hideable("viscoelasticity", {"viscoelastic.terms[0].g": (0.05, 0.2), "viscoelastic.terms[0].tau": (5.0, 30.0)}),
    Hideable("softening", {"softening.loss": (0.05, 0.25), "softening.share": (0.7, 1.5)}),
    Hideable("plate_friction", {"experiment.friction": (0.02, 0.1)}, (PLATES,)),
    Hideable("machine_compliance", {"rig.compliance": (7e-5, 1.5e-4)}),
    Hideable("sensor_drift", {"rig.sensor_drift": (3e-4, 1.5e-3)}),
    Hideable("edge_rounding", {"experiment.tool.edge_radius": (1e-3, 2.5e-3)}, (NEEDLE,)),
    Hideable("backlash", {"rig.backlash": (5e-5, 2e-4)}))


def draw_hidden(seed: int) -> Hidden:
    """One of `HIDEABLE`, or nothing, each as likely; the same for the same seed."""
    random = np.random.default_rng(seed)
    number = int(random.integers(len(HIDEABLE) + 1))
    return HIDEABLE[number].draw(random) if number < len(HIDEABLE) else Hidden()


def judge_answer(hidden: Hidden, diagnosis: Diagnosis) -> tuple[bool, str]:
    """Whether a diagnosis found what was hidden, and that in a sentence."""
    named = [each.name for each in diagnosis.effects]
    among = [name.partition("@")[0] for name in diagnosis.indistinguishable]
    found = joined([effect_in_words(each) for each in diagnosis.effects])
    if not hidden.name:
        right = diagnosis.verdict == "NONE"
        return right, "Nothing was hidden, and nothing was found." if right else \
            f"A false alarm: nothing was hidden, and the diagnosis says {found or 'that something is missing'}."
    if diagnosis.verdict == "SET" and hidden.name in among:
        return True, f"Found, but not alone: it is one of {len(among)} effects that these tests cannot tell apart."
    if hidden.name in named:
        others = "" if len(named) == 1 else ", with another that was not there"
        form = "" if diagnosis.verdict == "NAMED" else ", its form unconfirmed"
        return len(named) == 1, f"Found{others}{form}: {found}."
    if diagnosis.verdict == "NONE":
        return False, "Missed: the diagnosis sees nothing."
    if diagnosis.verdict == "UNKNOWN":
        return False, "Half found: the diagnosis sees that something is missing, and does not know what."
    return False, f"Wrong: the diagnosis says {found}."
