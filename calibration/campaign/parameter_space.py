"""The unknown parameters of a fit: names, bounds, priors, where each of them acts, and the models that they make."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calibration.campaign.campaign import Campaign, Test
from calibration.campaign.parameters import PER_REPLICATE, PER_SPECIMEN, PER_TEST, SHARED, Named
from tissue_sim.errors import InputError
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.laws import find_law
from tissue_sim.material.material import Bulk, Material, law_declaration
from tissue_sim.material.parts import make_material
from tissue_sim.model import Model
from tissue_sim.parameters import Declaration, symbol_at, with_values
from tissue_sim.rig.rig import Rig

#: Sum of the moduli, Pa, at which a material is simulated whose force is proportional to them.
REFERENCE_MODULUS = 1000.0
#: Digits of the ratios of the moduli by which a simulation is found again.
_DIGITS = 12
#: A number this small, in the unit of files, counts as this large where its own size is asked for.
_LEAST = 0.1


@dataclass(frozen=True)
class Unknown:
    """One number of a fit, free or fixed.

    Attributes:
        name: its path, with ``@`` and the specimen, test or recording where there are several of it.
        path: see `calibration.campaign.parameters.Named`. declaration: what it is. of_law: whether it is the law's.
        of_material: whether it is the material's, its law's included.
        tests: names of the tests in which it acts; None: all. recording: the one in which it acts; None: all.
        specimen: whose it is; None: of no single one.
    """

    name: str
    path: str
    declaration: Declaration
    of_law: bool
    of_material: bool
    tests: tuple[str, ...] | None = None
    recording: str | None = None
    specimen: str | None = None

    def acts_in(self, test: str | None, recording: str | None) -> bool:
        """Whether it acts in a recording of a test; None stands for any of them."""
        return ((self.tests is None or test is None or test in self.tests)
                and (self.recording is None or recording is None or recording == self.recording))

    @property
    def symbol(self) -> str:
        """As reports write it: ``g1``, ``gs@needle``."""
        _, at, mark = self.name.partition("@")
        return symbol_at(self.path, self.declaration) + at + mark

    @property
    def is_modulus(self) -> bool:
        """Whether it is a pressure, to which all forces are proportional together with the others."""
        return self.of_material and self.declaration.unit == "Pa"

    @property
    def is_exponent(self) -> bool:
        """Whether it is a number of the law without unit."""
        return self.of_law and self.declaration.unit == "1"


@dataclass(frozen=True, eq=False)
class ParameterSpace:
    """What a fit of one law varies.

    Attributes:
        law: its name. unknowns: all numbers, those of the law first.
        free: names of the unknown ones. fixed: name -> value of the others. start: name -> stated start.
        low, high, prior_mean, prior_deviation: of the free ones, SI, shape (p,); deviation inf where there is no prior.
        bulk: bulk response where no path states one.
    """

    law: str
    unknowns: tuple[Unknown, ...]
    free: tuple[str, ...]
    fixed: dict[str, float]
    start: dict[str, float]
    low: np.ndarray
    high: np.ndarray
    prior_mean: np.ndarray
    prior_deviation: np.ndarray
    bulk: Bulk

    @classmethod
    def of(cls, law: str, campaign: Campaign, recordings: Mapping[str, Sequence[str]] | None = None) -> ParameterSpace:
        """The parameters of a law and those that the campaign adds to its models.

        Args:
            law: its name. campaign: what is asked.
            recordings: test -> names of its recordings, for what has a value in each of them.
        """
        settings, own = campaign.fit, find_law(law)
        everywhere = tuple(test.name for test in campaign.tests)
        asked = [settings.named.get(name) or Named(name, law_declaration(own, name), True, SHARED, everywhere)
                 for name in own.parameters]
        asked += [settings.named[path] for path in settings.others]
        unknowns = [unknown for named in asked for unknown in _spread(named, campaign.tests, recordings or {})]
        fixed = {each.name: settings.fixed[each.path] for each in unknowns if each.path in settings.fixed}
        free = [each for each in unknowns if each.name not in fixed]
        bounds = np.array([settings.bounds.get(each.path, each.declaration.bounds) for each in free]).reshape(-1, 2)
        prior = np.array([settings.prior.get(each.path, (0.0, np.inf)) for each in free], dtype=float).reshape(-1, 2)
        start = {each.name: settings.start[each.path] for each in free if each.path in settings.start}
        return cls(law, tuple(unknowns), tuple(each.name for each in free), fixed, start, bounds[:, 0], bounds[:, 1],
                   prior[:, 0], prior[:, 1], settings.bulk)

    @property
    def names(self) -> tuple[str, ...]:
        """Of all parameters, those of the law first."""
        return tuple(each.name for each in self.unknowns)

    @property
    def symbols(self) -> dict[str, str]:
        """Name -> symbol, of all parameters; the name itself where two have the same symbol."""
        how_often = Counter(each.symbol for each in self.unknowns)
        return {each.name: each.symbol if how_often[each.symbol] == 1 else each.name for each in self.unknowns}

    def in_symbols(self, names: Iterable[str]) -> str:
        """Symbols of parameters, such as ``C10, g1``."""
        return ", ".join(self.symbols[name] for name in names)

    @cached_property
    def of_material_alone(self) -> bool:
        """Whether all of them are the material's, the same in all tests."""
        return all(each.of_material and each.tests is None and each.recording is None for each in self.unknowns)

    def mark(self, test: str, recording: str) -> str | None:
        """The recording where something has a value of its own in it; None where it is like the others of its test."""
        return recording if any(each.recording == recording and each.acts_in(test, recording)
                                for each in self.unknowns) else None

    def shapes_mesh(self, test: str) -> bool:
        """Whether a free number of a test moves the nodes of its mesh."""
        return any(each.declaration.shapes_mesh and each.acts_in(test, None) for each in self.varied)

    def before_moving(self, values: Mapping[str, float]) -> dict[str, float]:
        """Values with the geometry that the fit begins with, whose mesh is moved."""
        return {**values, **{each.name: self.start[each.name] for each in self.unknowns
                             if each.declaration.shapes_mesh and each.name in self.start}}

    def held(self, values: Mapping[str, float]) -> ParameterSpace:
        """The space in which nothing is free; `values`: of what was, by name."""
        nothing = np.zeros(0)
        return replace(self, free=(), fixed={**self.fixed, **values}, low=nothing, high=nothing, prior_mean=nothing,
                       prior_deviation=nothing)

    def unknown(self, name: str) -> Unknown:
        """The number of that name."""
        return next(each for each in self.unknowns if each.name == name)

    def with_specimen(self, specimen: str, tests: Sequence[str]) -> ParameterSpace:
        """With numbers for a specimen that no fitted test has, after the others; itself where nothing is the
        specimen's own.

        Args:
            specimen: its name. tests: names of its tests.
        """
        theirs = [each for each in self.unknowns if each.of_material and each.specimen is not None]
        if any(each.specimen == specimen for each in theirs):
            return self
        added = {each.name: replace(each, name=f"{path}@{specimen}", tests=tuple(tests), specimen=specimen)
                 for path, each in {each.path: each for each in theirs}.items()}
        free = {name: each for name, each in added.items() if name in self.free}
        places = [self.free.index(name) for name in free]
        low, high, mean, deviation = (np.append(each, each[places]) for each in (
            self.low, self.high, self.prior_mean, self.prior_deviation))
        fixed = {each.name: self.fixed[name] for name, each in added.items() if name in self.fixed}
        return replace(self, unknowns=(*self.unknowns, *added.values()), fixed=self.fixed | fixed,
                       free=(*self.free, *(each.name for each in free.values())), low=low, high=high, prior_mean=mean,
                       prior_deviation=deviation)

    @cached_property
    def varied(self) -> tuple[Unknown, ...]:
        """The free numbers."""
        return tuple(map(self.unknown, self.free))

    def values(self, theta: np.ndarray) -> dict[str, float]:
        """All parameters by name; `theta` are the free ones, shape (p,)."""
        known = self.fixed | dict(zip(self.free, np.asarray(theta).tolist(), strict=True))
        return {name: known[name] for name in self.names}

    def of_law(self, values: Mapping[str, float], test: str | None = None) -> dict[str, float]:
        """Parameters of the law, by their names in the law, as they are in a test (None: the first of those that differ
        between tests)."""
        return {path: values[each.name] for path, each in self._acting(test, None).items() if each.of_law}

    def material(self, values: Mapping[str, float], density: float | None = None, name: str = "", *,
                 test: str | None = None, recording: str | None = None) -> Material:
        """The material of these values, as it is in a test and a recording (None: in the first of them).

        Raises:
            InputError: values that no material has.
        """
        acting = self._acting(test, recording)
        others = {path: values[each.name] for path, each in acting.items() if each.of_material and not each.of_law}
        own = {path: values[each.name] for path, each in acting.items() if each.of_law}
        if len(own) < len(find_law(self.law).parameters):
            raise InputError(f"{test} has a value of its own for a parameter of the law, and nothing tells it; give it "
                             "the scope 'shared'", field="fit.scope")
        return make_material(self.law, own, others, self.bulk, density=density, name=name)

    def model(self, values: Mapping[str, float], experiment: Experiment, rig: Rig, *, test: str,
              recording: str | None = None) -> Model:
        """The model of a test: its experiment and its rig with what is fitted of them.

        Raises:
            InputError: values that no model has.
        """
        model = Model(experiment, self.material(values, test=test, recording=recording), rig)
        around = {path: values[each.name] for path, each in self._acting(test, recording).items()
                  if not each.of_material}
        return with_values(model, around) if around else model

    def _acting(self, test: str | None, recording: str | None) -> dict[str, Unknown]:
        """Path -> the number that acts there."""
        acting: dict[str, Unknown] = {}
        for each in self.unknowns:
            if each.acts_in(test, recording):
                acting.setdefault(each.path, each)
        return acting

    def normalised(self, values: Mapping[str, float]) -> tuple[dict[str, float], float]:
        """Values with moduli that add up to `REFERENCE_MODULUS`, and the factor that was taken out of them."""
        moduli = [each.name for each in self.unknowns if each.is_modulus]
        factor = sum(abs(values[name]) for name in moduli) / REFERENCE_MODULUS
        if not (np.isfinite(factor) and factor > 0):
            return dict(values), 1.0
        return {name: float(f"{value / factor:.{_DIGITS}e}") if name in moduli else value
                for name, value in values.items()}, factor

    def sizes(self, values: Mapping[str, float]) -> np.ndarray:
        """How large a change of each free parameter is a whole one, shape (p,): a modulus that happens to be small
        counts as a tenth of the shear modulus, another small number as a tenth of the unit of files."""
        stiffness = abs(find_law(self.law).mu0(self.of_law(values)))
        floor = [_LEAST * (stiffness if each.is_modulus else each.declaration.factor) for each in self.varied]
        return np.maximum([abs(values[name]) for name in self.free], floor)


def _spread(named: Named, tests: Sequence[Test], recordings: Mapping[str, Sequence[str]]) -> list[Unknown]:
    """The numbers that a named parameter stands for: one, or one for each specimen, test or recording."""
    def one(mark: str = "", where: tuple[str, ...] | None = None, recording: str | None = None,
            specimen: str | None = None) -> Unknown:
        name = f"{named.path}@{mark}" if mark else named.path
        return Unknown(name, named.path, named.declaration, named.of_law, named.of_material, where, recording, specimen)

    own = [test for test in tests if test.name in named.tests and not test.hold_out]
    if named.scope == PER_TEST:
        return [one(test.name, (test.name,)) for test in own]
    if named.scope == PER_REPLICATE:
        return [one(recording, (test.name,), recording) for test in own for recording in recordings.get(test.name, ())]
    if named.scope == PER_SPECIMEN:
        specimens = dict.fromkeys(test.specimen.name for test in own if test.specimen is not None)
        return [one(specimen, tuple(test.name for test in tests
                                    if test.specimen is not None and test.specimen.name == specimen), specimen=specimen)
                for specimen in specimens]
    shared = named.scope if isinstance(named.scope, tuple) else None if named.of_material else named.tests
    return [one(where=shared)]
