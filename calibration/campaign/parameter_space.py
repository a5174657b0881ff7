"""Free and fixed parameters of a fit: names, bounds, priors, scopes, and the models built from parameter values."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from calibration.campaign.campaign import Campaign, Test
from calibration.campaign.parameters import PER_REPLICATE, PER_SPECIMEN, PER_TEST, SHARED, ScopedCampaignParameter
from tissue_sim.errors import InputError
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.laws import find_law
from tissue_sim.material.material import (
    Bulk,
    Material,
    get_law_parameter_declaration,
    make_material_from_numbers,
    with_softening_form,
)
from tissue_sim.material.softening import SofteningForm
from tissue_sim.model import Model
from tissue_sim.parameters import Declaration, make_display_symbol_of_parameter, with_values
from tissue_sim.rig.rig import Rig

#: Sum of the moduli in simulations whose forces are proportional to the moduli, Pa.
REFERENCE_MODULUS = 1000.0
#: Digits to which normalised moduli are rounded, so that stored simulations are found again.
_DIGITS = 12
#: I1 - 3 of the data for the starts of a law if no test is homogeneous; 0.5 is a uniaxial stretch of 0.65 or 1.47.
_STRAIN_IF_UNKNOWN = 0.5
#: Smallest typical size of a parameter, in units of files or of the shear modulus.
_MIN_SIZE = 0.1


@dataclass(frozen=True)
class FitParameter:
    """One free or fixed scalar parameter of a fit.

    Attributes:
        name: path, followed by ``@`` and the specimen, test or recording if the parameter has several values.
        path: path of the parameter, see `calibration.campaign.parameters.ScopedCampaignParameter`.
        declaration: unit, bounds and symbol of the parameter.
        is_law_parameter: whether it is a parameter of the law.
        is_material_parameter: whether it is a parameter of the material, including its law.
        tests: names of the tests to which the number applies; None: all tests.
        recording: name of the recording to which the number applies; None: all recordings.
        specimen: name of the specimen to which the number belongs; None: not specific to a specimen.
    """

    name: str
    path: str
    declaration: Declaration
    is_law_parameter: bool
    is_material_parameter: bool
    tests: tuple[str, ...] | None = None
    recording: str | None = None
    specimen: str | None = None

    def applies_to_recording(self, test: str | None, recording: str | None) -> bool:
        """Return whether the parameter applies to a recording of a test; None means any test or recording."""
        return ((self.tests is None or test is None or test in self.tests)
                and (self.recording is None or recording is None or recording == self.recording))

    @property
    def symbol(self) -> str:
        """Symbol in reports, such as ``g1`` or ``gs@needle``."""
        _, at, mark = self.name.partition("@")
        return make_display_symbol_of_parameter(self.path, self.declaration) + at + mark

    @property
    def is_modulus(self) -> bool:
        """Whether the parameter is a modulus of the material (unit Pa); forces scale with all moduli together."""
        return self.is_material_parameter and self.declaration.unit == "Pa"

    @property
    def is_dimensionless_law_parameter(self) -> bool:
        """Whether the parameter is a dimensionless parameter of the law, such as an exponent of Ogden's law."""
        return self.is_law_parameter and self.declaration.unit == "1"


@dataclass(frozen=True, eq=False)
class ParameterSpace:
    """Free and fixed parameters of the fit of one law, with bounds and priors.

    Attributes:
        law: name of the law.
        unknowns: all parameters, those of the law first.
        free: names of the p free parameters.
        fixed: values of the fixed parameters by name, SI.
        start: stated start values by name, SI.
        low: lower bounds of the free parameters, SI, shape (p,).
        high: upper bounds of the free parameters, SI, shape (p,).
        prior_mean: means of the priors of the free parameters, SI, shape (p,).
        prior_deviation: standard deviations of the priors, SI, shape (p,); inf without a prior.
        bulk: bulk response if no parameter states one.
        law_starts: starts of dimensionless parameters of the law by path, best first; the others are exponents.
    """

    law: str
    unknowns: tuple[FitParameter, ...]
    free: tuple[str, ...]
    fixed: dict[str, float]
    start: dict[str, float]
    low: np.ndarray
    high: np.ndarray
    prior_mean: np.ndarray
    prior_deviation: np.ndarray
    bulk: Bulk
    softening_form: SofteningForm = "tanh"
    law_starts: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    @classmethod
    def from_campaign(cls, law: str, campaign: Campaign,
                      recordings: Mapping[str, Sequence[str]] | None = None) -> ParameterSpace:
        """Create the parameter space of a law with the additional parameters that the campaign names.

        Args:
            law: name of the law.
            campaign: the campaign.
            recordings: names of the recordings of each test, for parameters with one value per recording.
        """
        settings, own = campaign.fit, find_law(law)
        all_tests = tuple(test.name for test in campaign.tests)
        parameters = [settings.named.get(name)
                      or ScopedCampaignParameter(name, get_law_parameter_declaration(own, name), True, SHARED,
                                                 all_tests)
                      for name in own.parameters]
        parameters += [settings.named[path] for path in settings.stated_non_law_parameter_paths]
        unknowns = [unknown for named in parameters
                    for unknown in _make_parameters_of_scope(named, campaign.tests, recordings or {})]
        fixed = {each.name: settings.fixed[each.path] for each in unknowns if each.path in settings.fixed}
        free = [each for each in unknowns if each.name not in fixed]
        bounds = np.array([settings.bounds.get(each.path, each.declaration.bounds) for each in free]).reshape(-1, 2)
        prior = np.array([settings.prior.get(each.path, (0.0, np.inf)) for each in free], dtype=float).reshape(-1, 2)
        start = {each.name: settings.start[each.path] for each in free if each.path in settings.start}
        return cls(law, tuple(unknowns), tuple(each.name for each in free), fixed, start, bounds[:, 0], bounds[:, 1],
                   prior[:, 0], prior[:, 1], settings.bulk, settings.softening_form)

    def with_ranges_of_data(self, largest_strain: float | None) -> ParameterSpace:
        """Return the space with the starts and bounds of the law's dimensionless parameters that the data give.

        Args:
            largest_strain: largest I1 - 3 of the data; None: unknown, so that the bounds stay as they are.

        Raises:
            InputError: stated bounds exclude all values that the data allow.
        """
        ranges = find_law(self.law).compute_fit_ranges(_STRAIN_IF_UNKNOWN if largest_strain is None else largest_strain)
        low, high = self.low.copy(), self.high.copy()
        for place, each in enumerate(self.free_parameters if largest_strain is not None else ()):
            if each.is_law_parameter and each.path in ranges:
                limits = ranges[each.path]
                low[place], high[place] = max(low[place], limits.low), min(high[place], limits.high)
                if low[place] >= high[place]:
                    raise InputError(f"bounds must include values from {limits.low:g} to {limits.high:g}, for which "
                                     f"{self.law} is defined at all strains of the data; got [{self.low[place]:g}, "
                                     f"{self.high[place]:g}]", field=f"fit.bounds.{each.path}")
        return replace(self, low=low, high=high, law_starts={path: each.starts for path, each in ranges.items()})

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters, those of the law first."""
        return tuple(each.name for each in self.unknowns)

    @property
    def symbols(self) -> dict[str, str]:
        """Symbols of all parameters by name; the name itself if two parameters have the same symbol."""
        counts = Counter(each.symbol for each in self.unknowns)
        return {each.name: each.symbol if counts[each.symbol] == 1 else each.name for each in self.unknowns}

    def format_symbols(self, names: Iterable[str]) -> str:
        """Return the symbols of these parameters as text, such as ``C10, g1``."""
        return ", ".join(self.symbols[name] for name in names)

    @cached_property
    def has_only_shared_material_parameters(self) -> bool:
        """Whether all parameters belong to the material and are the same in all tests."""
        return all(each.is_material_parameter and each.tests is None and each.recording is None
                   for each in self.unknowns)

    def get_recording_if_it_has_own_values(self, test: str, recording: str) -> str | None:
        """Return `recording` if any parameter has a separate value in this recording of the test, otherwise None."""
        return recording if any(each.recording == recording and each.applies_to_recording(test, recording)
                                for each in self.unknowns) else None

    def has_free_mesh_geometry_parameter(self, test: str) -> bool:
        """Return whether any free parameter that acts in a test changes the geometry of its mesh."""
        return any(each.declaration.shapes_mesh and each.applies_to_recording(test, None)
                   for each in self.free_parameters)

    def replace_geometry_by_start_values(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return the values with parameters of the geometry replaced by their start values.

        The mesh is generated for the start values; its nodes are then moved with the geometry.
        """
        return {**values, **{each.name: self.start[each.name] for each in self.unknowns
                             if each.declaration.shapes_mesh and each.name in self.start}}

    def with_all_fixed(self, values: Mapping[str, float]) -> ParameterSpace:
        """Return the space with all parameters fixed; `values` are those of the free parameters by name, SI."""
        empty = np.zeros(0)
        return replace(self, free=(), fixed={**self.fixed, **values}, low=empty, high=empty, prior_mean=empty,
                       prior_deviation=empty)

    def get_parameter_by_name(self, name: str) -> FitParameter:
        """Return the parameter with a name; raise `StopIteration` for an unknown name."""
        return next(each for each in self.unknowns if each.name == name)

    def with_parameters_for_unfitted_specimen(self, specimen: str, tests: Sequence[str]) -> ParameterSpace:
        """Return the space with additional parameters for a specimen without fitted tests.

        The space is returned unchanged if the specimen already has parameters or if no parameter differs between
        specimens.

        Args:
            specimen: name of the specimen.
            tests: names of the tests of the specimen.
        """
        per_specimen = [each for each in self.unknowns if each.is_material_parameter and each.specimen is not None]
        if any(each.specimen == specimen for each in per_specimen):
            return self
        added = {each.name: replace(each, name=f"{path}@{specimen}", tests=tuple(tests), specimen=specimen)
                 for path, each in {each.path: each for each in per_specimen}.items()}
        free = {name: each for name, each in added.items() if name in self.free}
        indices = [self.free.index(name) for name in free]
        low, high, mean, deviation = (np.append(each, each[indices]) for each in (
            self.low, self.high, self.prior_mean, self.prior_deviation))
        fixed = {each.name: self.fixed[name] for name, each in added.items() if name in self.fixed}
        return replace(self, unknowns=(*self.unknowns, *added.values()), fixed=self.fixed | fixed,
                       free=(*self.free, *(each.name for each in free.values())), low=low, high=high, prior_mean=mean,
                       prior_deviation=deviation)

    @cached_property
    def free_parameters(self) -> tuple[FitParameter, ...]:
        """Free parameters in the order of `free`."""
        return tuple(map(self.get_parameter_by_name, self.free))

    def get_values_by_name(self, theta: np.ndarray) -> dict[str, float]:
        """Return the values of all parameters by name, SI.

        Args:
            theta: values of the free parameters in the order of `free`, SI, shape (p,).
        """
        known = self.fixed | dict(zip(self.free, np.asarray(theta).tolist(), strict=True))
        return {name: known[name] for name in self.names}

    def select_law_parameter_values(self, values: Mapping[str, float], test: str | None = None) -> dict[str, float]:
        """Return the values of the parameters of the law in a test, SI, by their names in the law.

        Args:
            values: values of all parameters by name, SI.
            test: name of the test; None: the first value of each parameter.
        """
        acting = self._map_paths_to_acting_parameters(test, None)
        return {path: values[each.name] for path, each in acting.items() if each.is_law_parameter}

    def build_material(self, values: Mapping[str, float], density: float | None = None, name: str = "", *,
                       test: str | None = None, recording: str | None = None) -> Material:
        """Return the material with these values in a test and a recording.

        Args:
            values: values of all parameters by name, SI.
            density: density, kg/m3, or None.
            name: name of the material.
            test: name of the test; None: the first value of each parameter.
            recording: name of the recording; None: the first value of each parameter.

        Raises:
            InputError: the values are invalid for the material.
        """
        acting = self._map_paths_to_acting_parameters(test, recording)
        others = {path: values[each.name] for path, each in acting.items() if each.is_material_parameter
                  and not each.is_law_parameter}
        own = {path: values[each.name] for path, each in acting.items() if each.is_law_parameter}
        if len(own) < len(find_law(self.law).parameters):
            raise InputError("scope of a parameter of the law must give each test a fitted value; got a separate value "
                             f"in {test}, which no fitted test determines. Set the scope to 'shared'.",
                             field="fit.scope")
        material = make_material_from_numbers(self.law, own, others, self.bulk, density=density, name=name)
        return with_softening_form(material, self.softening_form)

    def build_model(self, values: Mapping[str, float], experiment: Experiment, rig: Rig, *, test: str,
                    recording: str | None = None) -> Model:
        """Return the model of a test: material, experiment and rig with these parameter values.

        Args:
            values: values of all parameters by name, SI.
            experiment: experiment without the fitted values.
            rig: rig without the fitted values.
            test: name of the test.
            recording: name of the recording; None: the first value of each parameter.

        Raises:
            InputError: the values are invalid for the model.
        """
        model = Model(experiment, self.build_material(values, test=test, recording=recording), rig)
        others = {path: values[each.name] for path,
                  each in self._map_paths_to_acting_parameters(test, recording).items()
                  if not each.is_material_parameter}
        return with_values(model, others) if others else model

    def select_values_under_prefix(self, values: Mapping[str, float], prefix: str, test: str,
                                   recording: str | None = None) -> dict[str, float]:
        """Return path without prefix -> value, SI, of the parameters in a recording whose path begins with `prefix`."""
        return {path.removeprefix(prefix): values[each.name] for path, each
                in self._map_paths_to_acting_parameters(test, recording).items() if path.startswith(prefix)}

    def _map_paths_to_acting_parameters(self, test: str | None, recording: str | None) -> dict[str, FitParameter]:
        """Return path -> parameter for the parameters that apply to a recording of a test; None: any."""
        acting: dict[str, FitParameter] = {}
        for each in self.unknowns:
            if each.applies_to_recording(test, recording):
                acting.setdefault(each.path, each)
        return acting

    def normalise_moduli_and_get_factor(self, values: Mapping[str, float]) -> tuple[dict[str, float], float]:
        """Scale all moduli to the sum `REFERENCE_MODULUS`, so that proportional simulations are reused.

        Returns:
            (values by name, SI, with scaled moduli; factor by which the moduli and the forces were divided).
        """
        moduli = [each.name for each in self.unknowns if each.is_modulus]
        factor = sum(abs(values[name]) for name in moduli) / REFERENCE_MODULUS
        if not (np.isfinite(factor) and factor > 0):
            return dict(values), 1.0
        return {name: float(f"{value / factor:.{_DIGITS}e}") if name in moduli else value
                for name, value in values.items()}, factor

    def compute_typical_parameter_sizes(self, values: Mapping[str, float]) -> np.ndarray:
        """Return the typical size of each free parameter for scaling, SI, shape (p,).

        The size is the absolute value, but at least a tenth of the shear modulus for a modulus and a tenth of the file
        unit for other parameters.
        """
        stiffness = abs(find_law(self.law).mu0(self.select_law_parameter_values(values)))
        floor = [_MIN_SIZE * (stiffness if each.is_modulus else each.declaration.factor)
                 for each in self.free_parameters]
        return np.maximum([abs(values[name]) for name in self.free], floor)


def _make_parameters_of_scope(named: ScopedCampaignParameter, tests: Sequence[Test],
                              recordings: Mapping[str, Sequence[str]]) -> list[FitParameter]:
    """Return one fit parameter, or one for each specimen, test or recording, by the scope of `named`."""
    def make_fit_parameter(owner: str = "", where: tuple[str, ...] | None = None, recording: str | None = None,
                           specimen: str | None = None) -> FitParameter:
        """Return a parameter with the path of `named`, named ``path@owner`` or without an owner ``path``."""
        name = f"{named.path}@{owner}" if owner else named.path
        return FitParameter(name, named.path, named.declaration, named.is_law_parameter, named.is_material_parameter,
                            where, recording,
                            specimen)

    own = [test for test in tests if test.name in named.tests and not test.hold_out]
    if named.scope == PER_TEST:
        tables: dict[str, list[str]] = {}
        for test in own:
            tables.setdefault(test.table_name or test.name, []).append(test.name)
        return [make_fit_parameter(table, tuple(names)) for table, names in tables.items()]
    if named.scope == PER_REPLICATE:
        return [make_fit_parameter(recording, (test.name,), recording)
                for test in own for recording in recordings.get(test.name, ())]
    if named.scope == PER_SPECIMEN:
        specimens = dict.fromkeys(test.specimen.name for test in own if test.specimen is not None)
        tests_of = {specimen: tuple(test.name for test in tests
                                    if test.specimen is not None and test.specimen.name == specimen)
                    for specimen in specimens}
        return [make_fit_parameter(specimen, where, specimen=specimen) for specimen, where in tests_of.items()]
    shared = named.scope if isinstance(named.scope, tuple) else None if named.is_material_parameter else named.tests
    return [make_fit_parameter(where=shared)]
