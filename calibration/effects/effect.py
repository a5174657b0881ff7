"""Base classes of effects that a diagnosis tests (`Effect` and its `Candidate`s), their registry, and the tested data.

An effect is a class with a name, a category and two sentences for reports. Its method `Effect.candidates` returns the
parametrisations of the effect in the tests of a campaign. Score, refit and output files follow from the parameter paths
of a candidate. A new effect needs a class in the module of its category and one line in `CATALOGUE`; another package
registers its effects through the entry point group ``tissue_sim.diagnosis_effects``. Trial values and largest values of
an effect are attributes of its class, so that a subclass can change them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np

from calibration.campaign.campaign import Campaign, FitSettings, Test
from calibration.campaign.loads import compute_neo_hookean_stress
from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameters import (
    NON_MATERIAL_PREFIXES,
    SHARED,
    ScopedCampaignParameter,
    get_experiment_and_rig_declarations_by_path,
)
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.laws import find_law
from tissue_sim.material.material import (
    BULK_RATIOS,
    Bulk,
    find_parameter_path_and_declaration,
    get_law_parameter_declaration,
    with_changed_or_added_parameters,
)
from tissue_sim.model import Model
from tissue_sim.parameters import Declaration, make_display_symbol_of_parameter, parameters, with_values
from tissue_sim.public_names import OldName, make_getattr_for_old_names, rename_old_members_of_subclass, with_old_names
from tissue_sim.registry import Registry
from tissue_sim.settings import make_shallow_read_only_copy

#: Smallest decrease of the displacement that counts as unloading, as a fraction of the largest displacement.
UNLOADING_FRACTION = 0.05


class NotTestableError(Exception):
    """No test of a campaign can show an effect; the message gives the reason without a capital letter or full stop."""


@with_old_names(fitted_curves="list_recordings", relaxation_times="list_resolvable_relaxation_times")
@dataclass(frozen=True, eq=False)
class DiagnosisData:
    """Tests and recordings in which a diagnosis tests an effect, with estimates for trial values.

    Attributes:
        campaign: campaign with the fitted tests.
        measured: name of a test -> its recordings.
        law: name of the fitted law.
    """

    campaign: Campaign
    measured: Mapping[str, Sequence[MeasuredCurve]]
    law: str

    @cached_property
    def tests(self) -> tuple[Test, ...]:
        """Tests of the campaign that are fitted, which are all tests that are not held out."""
        return tuple(test for test in self.campaign.tests if not test.hold_out)

    def simulated_tests(self, condition: Callable[[Test], bool] = lambda _: True) -> tuple[Test, ...]:
        """Return the fitted tests that finite elements simulate: those with a specimen, a tool, and recorded forces.

        Args:
            condition: function that selects among these tests.
        """
        return tuple(test for test in self.tests if test.experiment is not None
                     and not self.measured[test.name][0].stressed and condition(test))

    simulated = OldName("simulated_tests")
    fastest_speed = OldName("find_largest_loading_speed")
    curves = OldName("list_recordings")
    step_and_duration = OldName("sampling_interval_and_duration")
    require_new = OldName("require_unused_parameter")
    depth = OldName("largest_displacement")
    force = OldName("largest_force")
    strain = OldName("largest_strain")
    modulus = OldName("estimated_shear_modulus")
    shear_modulus = OldName("estimated_shear_modulus")
    has_unloading = OldName("test_has_unloading")

    def list_recordings(self, tests: Iterable[Test] | None = None) -> list[MeasuredCurve]:
        """Return the recordings of `tests` in one list; None: of all fitted tests."""
        return [curve for test in (self.tests if tests is None else tests) for curve in self.measured[test.name]]

    def largest_displacement(self, test: Test) -> float:
        """Return the largest displacement in a test, m; the largest strain if the test was recorded as strain."""
        return max(float(np.abs(curve.displacement).max()) for curve in self.measured[test.name])

    def largest_force(self, test: Test) -> float:
        """Return the largest force in a test, N."""
        return max(float(np.abs(curve.force).max()) for curve in self.measured[test.name])

    @cached_property
    def has_time(self) -> bool:
        """Whether every recording of a motion has a time channel that advances, and there is such a recording."""
        motions = self._list_recordings_of_motions()
        return bool(motions) and all(curve.time is not None and np.ptp(curve.time) > 0 for curve in motions)

    def _list_recordings_of_motions(self) -> list[MeasuredCurve]:
        """Return the recordings of the fitted tests except tables of moduli."""
        return [curve for curve in self.list_recordings() if not curve.test.modulus]

    @cached_property
    def sampling_interval_and_duration(self) -> tuple[float, float]:
        """Median sampling interval and duration of the longest recording, s.

        Raises:
            NotTestableError: a recording has no time.
        """
        if not self.has_time:
            raise NotTestableError("the recordings have no time")
        clocks = [curve.sample_times for curve in self._list_recordings_of_motions()]
        return float(np.median([np.median(np.diff(clock)) for clock in clocks])), \
            max(float(clock[-1] - clock[0]) for clock in clocks)

    @cached_property
    def estimated_shear_modulus(self) -> float:
        """Estimate of the shear modulus mu for trial values, Pa.

        The estimate is the median over the tests of the modulus that linear elasticity assigns to the largest force F
        at the largest displacement d: mu = F h / (c A d) on a specimen of height h and area A, where c mu is the
        initial slope of the closed form of the test (c = 3 for plates) plus the bulk modulus between lateral walls, and
        mu = F / (8 a d) for an indenter with contact radius a on an incompressible material. One of several loads is
        compared with the largest load of a neo-Hookean material in the same motion, since its initial slope depends on
        the other motions, or is zero (axial force in torsion).
        """
        found = []
        for test in self.tests:
            force, depth = self.largest_force(test), self.largest_displacement(test)
            if test.modulus:
                # The curves are logarithms of moduli: G in shear, E = 3 G otherwise.
                factor = 3.0 if test.kind.require_closed_form().rest else 1.0
                found.append(float(np.exp(force)) / factor)
            elif test.kind.load_count > 1:
                found.append(force / max(float(np.abs(compute_neo_hookean_stress(
                    test.kind, curve.displacement, curve.motions)).max()) for curve in self.measured[test.name]))
            elif test.experiment is None or self.measured[test.name][0].stressed:
                height, area = test.reference_height, test.reference_area
                found.append(self._convert_initial_slope_to_shear_modulus(test, force * height / (area * depth)))
            elif test.experiment.tool.is_plate:
                specimen = test.experiment.specimen
                area = specimen.area if specimen.is_prism else np.pi * specimen.margin() ** 2
                slope = force * specimen.height / (area * depth)
                found.append(self._convert_initial_slope_to_shear_modulus(test, slope))
            else:
                found.append(force / (8.0 * self.contact_radius(test) * depth))
        return float(np.median(found))

    def _convert_initial_slope_to_shear_modulus(self, test: Test, slope: float) -> float:
        """Return the shear modulus, Pa, for an initial slope of nominal stress over strain, Pa; see the estimate."""
        form, fit = test.kind.closed_form, self.campaign.fit
        shear = 3.0 if form is None else float(form.slope(find_law("neo_hooke"), np.array([form.rest]), [0.5])[0])
        if form is None or not form.needs_bulk:
            return slope / shear
        stated = {**fit.fixed, **fit.start}
        bulk = next((Bulk(path.removeprefix("bulk."), value) for path, value in stated.items()
                     if path.startswith("bulk.")), fit.bulk)
        if bulk.kind == "bulk_ratio":
            return slope / (shear + bulk.modulus(1.0))
        # Where the stated bulk modulus leaves nothing, the material is taken as the most compressible one.
        return max((slope - bulk.modulus(1.0)) / shear, 0.0) or slope / (shear + BULK_RATIOS[0])

    def contact_radius(self, test: Test) -> float:
        """Return an estimate of the contact radius of a tool at the largest displacement of a test, m."""
        experiment = get_experiment(test)
        return experiment.tool.contact_radius(self.largest_displacement(test), experiment.specimen.margin())

    def largest_strain(self, test: Test) -> float:
        """Return an estimate of the largest strain in a test with a tool.

        The estimate is the displacement divided by the specimen's height (plates) or by the contact diameter (needles).
        """
        experiment = get_experiment(test)
        size = experiment.specimen.height if experiment.tool.is_plate else 2.0 * self.contact_radius(test)
        return self.largest_displacement(test) / size

    def test_has_unloading(self, test: Test) -> bool:
        """Return whether any recording of a test has an unloading above `UNLOADING_FRACTION`."""
        return any(float(np.max(np.maximum.accumulate(curve.displacement) - curve.displacement))
                   > UNLOADING_FRACTION * self.largest_displacement(test) for curve in self.measured[test.name])

    def find_largest_loading_speed(self, tests: Iterable[Test]) -> float:
        """Return the largest loading speed in some tests, m/s.

        Raises:
            NotTestableError: the recordings have no time.
        """
        speeds = [curve.mean_loading_speed for curve in self.list_recordings(tests) if self.has_time
                  and curve.mean_loading_speed]
        if not speeds:
            raise NotTestableError("the recordings have no time")
        return max(speeds)

    def require_unused_parameter(self, path: str) -> None:
        """Raise an error if the campaign already fits or fixes a parameter.

        Args:
            path: path of the parameter in the model.

        Raises:
            NotTestableError: the campaign fits or fixes the parameter.
        """
        if path in self.campaign.fit.start or path in self.campaign.fit.fixed:
            raise NotTestableError("the campaign fits or fixes this parameter already")

    def list_resolvable_relaxation_times(self, per_decade: float = 2.0) -> list[float]:
        """Return relaxation times that the recordings can resolve, s, evenly spaced on a logarithmic axis.

        The times extend from three sampling intervals to the duration of the longest recording.

        Args:
            per_decade: number of times per decade.
        """
        step, longest = self.sampling_interval_and_duration
        shortest = min(3.0 * step, 0.1 * longest)
        count = max(2, int(np.ceil(per_decade * np.log10(longest / shortest))) + 1)
        return np.geomspace(shortest, longest, count).tolist()


def get_experiment(test: Test) -> Experiment:
    """Return `test.experiment`; raise an `AssertionError` for a gripped test, which has no tool and no experiment."""
    assert test.experiment is not None, test.name
    return test.experiment


__getattr__ = make_getattr_for_old_names(__name__, {"experiment_of": "get_experiment", "Situation": "DiagnosisData"})

#: Part of the model that an effect belongs to.
Category = Literal["tissue", "contact", "geometry", "rig", "readout", "population"]
#: All categories in the order of reports. The category determines the output file of a found effect: tissue -> material
#: file, contact, geometry and readout -> campaign, rig -> rig file, population -> none.
CATEGORIES: tuple[Category, ...] = ("tissue", "contact", "geometry", "rig", "readout", "population")


@dataclass(frozen=True, eq=False)
class Candidate:
    """One parametrisation of an effect: parameters, trial values, and the tests in which they act.

    Attributes:
        effect: effect that the candidate belongs to.
        sizes: path in the model -> trial value, SI. The value is of typical size, and the change of the force is far
            above the rounding error of a simulation. Each of these parameters has a value at which the effect is
            absent.
        absent: path -> value at which the effect is absent, SI, if it differs from the declared one.
        shape: path -> trial value, SI, of parameters without influence while the effect is absent, such as a relaxation
            time. Other candidates try other values; a refit frees these parameters.
        bounds: path -> lowest and highest value in a refit, SI, if narrower than the declared bounds.
        tests: names of the tests in which the effect acts; None: all tests that have the parameters.
        scope: ``per_specimen`` or ``per_test`` if each specimen or test has its own values; otherwise the tests share
            them.
        law: name of the wider law that has the parameters; None: the fitted law.
        prepare: function that adds to a test the part which the parameters belong to, such as an adhesion with force 0.
        mark: name of the test or specimen that distinguishes the candidate from others of its effect; empty if the
            parameters distinguish it.
        inverse: whether the change of the force is proportional to the inverse of the parameter, as for a stiffness.
        jump: path in `shape` of the displacement, m, at which the force jumps. Gradient descent cannot move a jump, so
            a search between the values of the other candidates precedes the refit.
    """

    effect: Effect
    sizes: Mapping[str, float]
    absent: Mapping[str, float] = field(default_factory=dict)
    shape: Mapping[str, float] = field(default_factory=dict)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    tests: tuple[str, ...] | None = None
    scope: str = SHARED
    law: str | None = None
    prepare: Callable[[Test], Test] | None = None
    mark: str = ""
    inverse: bool = False
    jump: str = ""

    def scale_trial_values(self, absent: Mapping[str, float], factor: float) -> dict[str, float]:
        """Return the parameter values at which the effect changes the force by `factor` times the trial change.

        Args:
            absent: path -> value at which the effect is absent, SI.
            factor: dimensionless amplitude of the effect; 0 is absence, 1 the trial values.

        Returns:
            Path -> value, SI.
        """
        if self.inverse:
            inverses = {path: (1.0 / absent[path], 1.0 / size) for path, size in self.sizes.items()}
            # The lower limit keeps the inverse positive for negative factors.
            return {path: 1.0 / max(zero + factor * (one - zero), 0.5 * zero) for path, (zero, one) in inverses.items()}
        return {path: absent[path] + factor * (size - absent[path]) for path, size in self.sizes.items()}

    @property
    def name(self) -> str:
        """Name of the effect; followed by ``@`` and the test or specimen if the candidate acts in only one."""
        return f"{self.effect.name}@{self.mark}" if self.mark else self.effect.name

    @property
    def title(self) -> str:
        """Title of the effect for reports, with the test or specimen if the candidate acts in only one."""
        return f"{self.effect.title} in {self.mark}" if self.mark else self.effect.title

    @property
    def parameter_paths(self) -> frozenset[str]:
        """Paths of all parameters of the candidate: of its sizes and of its shape parameters."""
        return frozenset({**self.sizes, **self.shape})

    def find_parameter_declaration(self, campaign: Campaign, path: str) -> Declaration:
        """Return the declaration (symbol, unit, bounds) of a parameter of the candidate.

        Args:
            campaign: campaign whose tests have the parameter.
            path: path of the parameter.

        Raises:
            NotTestableError: no test of the candidate has the parameter.
        """
        if not path.startswith(NON_MATERIAL_PREFIXES):
            law = None if self.law is None else find_law(self.law)
            if law is not None and path in law.parameters:
                return get_law_parameter_declaration(law, path)
            return find_parameter_path_and_declaration(path)[1]
        for test in campaign.tests:
            found = get_experiment_and_rig_declarations_by_path(test.experiment, test.rig, test.readout).get(path)
            if found is not None and (self.tests is None or test.name in self.tests):
                return found
        raise NotTestableError(f"no test of the candidate has the parameter {path}, so this effect is not tested")

    def find_value_without_effect(self, campaign: Campaign, path: str) -> float:
        """Return the value of a parameter at which the effect is absent, SI.

        Raises:
            TypeError: neither the candidate nor the parameter's declaration gives this value.
        """
        if path in self.absent:
            return self.absent[path]
        stated = self.find_parameter_declaration(self.make_campaign_with_prepared_tests(campaign), path).absent
        if stated is None:
            raise TypeError(f"{self.effect.name}: absent must give the value of {path} without the effect; got no "
                            "value. Declare it at the parameter or in Candidate.absent.")
        return stated

    def has_mesh_changing_shape_parameter(self, campaign: Campaign) -> bool:
        """Return whether a parameter of `shape` changes the mesh, even while the effect is absent."""
        campaign = self.make_campaign_with_prepared_tests(campaign)
        return any(self.find_parameter_declaration(campaign, path).shapes_mesh for path in self.shape)

    def make_campaign_with_prepared_tests(self, campaign: Campaign) -> Campaign:
        """Return the campaign with `prepare` applied to the tests in which the effect acts.

        `prepare` adds the component that has the parameters, such as an adhesion without force.
        """
        if self.prepare is None:
            return campaign
        names = self.find_acting_test_names_or_none_for_all(campaign)
        return replace(campaign, tests=tuple(
            self.prepare(test) if names is None or test.name in names else test for test in campaign.tests))

    def find_acting_test_names_or_none_for_all(self, campaign: Campaign) -> tuple[str, ...] | None:
        """Return the names of the tests in which the effect acts; None: all tests that have the parameters.

        An effect of a rig or specimen also acts in held-out tests that state the same values, because they share this
        rig or specimen. Candidates of a single test (`mark`) act in this test only.
        """
        if self.tests is None or self.mark or not all(path.startswith(NON_MATERIAL_PREFIXES) for path in self.sizes):
            return self.tests
        # All tests of the candidate state the same values, so the first represents them.
        first = next(test for test in campaign.tests if test.name == self.tests[0])
        shared = [test.name for test in campaign.tests if test.hold_out and test.name not in self.tests
                  and test.experiment is not None and all(
                      _read_test_value_or_none_if_lacking(test, path)
                      == _read_test_value_or_none_if_lacking(first, path) for path in self.sizes)]
        return (*self.tests, *shared)

    def add_to_campaign(self, campaign: Campaign, values: Mapping[str, float] | None = None, *, free: bool) -> Campaign:
        """Return the campaign with the parameters of the candidate as free or fixed parameters of its fit.

        Args:
            campaign: campaign without the effect.
            values: path -> value, SI; parameters without a value get their trial value.
            free: whether a fit varies the parameters or holds them fixed.

        Raises:
            NotTestableError: no test has the parameters.
        """
        tests = self.find_acting_test_names_or_none_for_all(campaign)
        campaign = self.make_campaign_with_prepared_tests(campaign)
        values = {**self.sizes, **self.shape, **(values or {})}
        settings, everywhere = campaign.fit, tuple(test.name for test in campaign.tests)
        named, bounds = dict(settings.named), dict(settings.bounds)
        wider = {} if self.law is None else dict.fromkeys(find_law(self.law).parameters, 0.0)
        for path in values:
            declaration = self.find_parameter_declaration(campaign, path)
            of_law = path in wider
            names = everywhere if not path.startswith(NON_MATERIAL_PREFIXES) else tuple(
                test.name for test in campaign.tests if path in get_experiment_and_rig_declarations_by_path(
                    test.experiment, test.rig, test.readout))
            if tests is not None:
                names = tuple(name for name in tests if name in names)
            scope = self.scope if self.tests is None or self.scope != SHARED else names
            named[path] = ScopedCampaignParameter(path, declaration, of_law, scope, names)
            if path in self.bounds:
                bounds[path] = self.bounds[path]
        # Parameters of the wider law that belong neither to the candidate nor to the fitted law stay 0.
        held = {name: 0.0 for name in wider if name not in find_law(settings.laws[0]).parameters and name not in values}
        for name in held:
            named[name] = ScopedCampaignParameter(name, get_law_parameter_declaration(find_law(str(self.law)), name),
                                                  True, SHARED, everywhere)
        start, fixed = dict(settings.start), {**settings.fixed, **held}
        for path, value in values.items():
            target, other = (start, fixed) if free and path != self.jump else (fixed, start)
            target[path] = value
            other.pop(path, None)
        laws = settings.laws if self.law is None else (self.law,)
        changed: FitSettings = replace(settings, laws=laws, named=make_shallow_read_only_copy(named),
                                       start=make_shallow_read_only_copy(start),
                                       fixed=make_shallow_read_only_copy(fixed),
                                       bounds=make_shallow_read_only_copy(bounds))
        return replace(campaign, fit=changed)

    def make_symbols_by_path(self, campaign: Campaign) -> dict[str, str]:
        """Return path -> symbol for all parameters of the candidate."""
        campaign = self.make_campaign_with_prepared_tests(campaign)
        return {path: make_display_symbol_of_parameter(path, self.find_parameter_declaration(campaign, path))
                for path in {**self.sizes, **self.shape}}


class Effect(ABC):
    """Effect that a diagnosis can test and add to a model.

    Subclasses that name their category ``room`` are accepted with a `DeprecationWarning`.

    Attributes:
        name: name in files, JSON and reports.
        category: part of the model that the effect belongs to, one of `CATEGORIES`.
        title: name in reports.
        signature: sentence: change of a recording by the effect.
        separated_by: phrase: test or measurement that separates the effect from others.
        known_twins: names of effects that force and displacement cannot separate from this one.
        max_instances: how often the effect may be added, each time with its own parameters (terms of a series).
        scales_all_forces: whether the effect is a common factor of all forces, which forces cannot separate from the
            moduli.
        law: name of the wider law that has the parameters; None: the parameters belong to no law.
    """

    name: ClassVar[str]
    category: ClassVar[Category]
    room = OldName("category")
    title: ClassVar[str]
    signature: ClassVar[str]
    separated_by: ClassVar[str]
    known_twins: ClassVar[tuple[str, ...]] = ()
    max_instances: ClassVar[int] = 1
    scales_all_forces: ClassVar[bool] = False
    law: ClassVar[str | None] = None

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        rename_old_members_of_subclass(cls, {"room": "category"})

    @abstractmethod
    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates of the effect in the tests, one for each trial value of the shape parameters.

        Args:
            situation: campaign and recordings.

        Raises:
            NotTestableError: no test can show the effect; the message gives the reason.
        """

    def apply(self, model: Model, values: Mapping[str, float]) -> Model:
        """Return the model with the effect; components that the model lacks are created.

        Args:
            model: model without the effect.
            values: path -> value, SI; for a missing component all of its parameters.

        Raises:
            InputError: a path does not exist in the model, or the values are invalid.
        """
        # Parameters of the readout of moduli do not change the model.
        around = {path: value for path, value in values.items() if path.startswith(("experiment.", "rig."))}
        within = {path.removeprefix("material."): value for path, value in values.items()
                  if not path.startswith(NON_MATERIAL_PREFIXES)}
        if self.law is not None:
            wider = {**dict.fromkeys(find_law(self.law).parameters, 0.0), **model.material.parameters}
            model = replace(model, material=replace(model.material, law=self.law, parameters=wider))
        if within:
            model = replace(model, material=with_changed_or_added_parameters(model.material, within))
        return with_values(model, around) if around else model


def _read_test_value_or_none_if_lacking(test: Test, path: str) -> float | None:
    """Return the value that a test with a tool states for a parameter, SI; None if the test lacks the parameter."""
    part, _, inside = path.partition(".")
    whole = getattr(test, part)
    stated = None if whole is None else parameters(whole).get(inside)
    return None if stated is None else stated.value


#: Name -> class, ordered by category: tissue, contact, geometry, rig, readout, population.
CATALOGUE: Registry[type[Effect]] = Registry("effect", "tissue_sim.diagnosis_effects", {
    "strain_stiffening": "calibration.effects.tissue:StrainStiffening",
    "i2_term": "calibration.effects.tissue:I2Term",
    "compressibility": "calibration.effects.tissue:Compressibility",
    "viscoelasticity": "calibration.effects.tissue:Viscoelasticity",
    "poroelasticity": "calibration.effects.tissue:Poroelasticity",
    "softening": "calibration.effects.tissue:Softening",
    "layer": "calibration.effects.tissue:Layer",
    "puncture": "calibration.effects.tissue:Puncture",
    "session_scale": "calibration.effects.tissue:SessionScale",
    "plate_friction": "calibration.effects.contact:PlateFriction",
    "partial_slip": "calibration.effects.contact:PartialSlip",
    "adhesion": "calibration.effects.contact:Adhesion",
    "self_weight": "calibration.effects.geometry:SelfWeight",
    "edge_rounding": "calibration.effects.geometry:EdgeRounding",
    "radius_error": "calibration.effects.geometry:RadiusError",
    "height_error": "calibration.effects.geometry:HeightError",
    "tilt": "calibration.effects.geometry:Tilt",
    "contact_offset": "calibration.effects.rig:ContactOffset",
    "machine_compliance": "calibration.effects.rig:MachineCompliance",
    "displacement_gain": "calibration.effects.rig:DisplacementGain",
    "backlash": "calibration.effects.rig:Backlash",
    "step_loss": "calibration.effects.rig:StepLoss",
    "zero_offset": "calibration.effects.rig:ZeroOffset",
    "sensor_drift": "calibration.effects.rig:SensorDrift",
    "sensor_gain": "calibration.effects.rig:SensorGain",
    "latency": "calibration.effects.rig:Latency",
    "guide_friction": "calibration.effects.rig:GuideFriction",
    "rate_damping": "calibration.effects.rig:RateDamping",
    "inertia": "calibration.effects.rig:Inertia",
    "readout_inertia": "calibration.effects.readout:ReadoutInertia",
    "readout_compliance": "calibration.effects.readout:ReadoutCompliance",
    "readout_delay": "calibration.effects.readout:ReadoutDelay",
    "population": "calibration.effects.population:Population",
}, accepts=lambda kind: isinstance(kind, type) and issubclass(kind, Effect),
    expected="a class that derives from calibration.effects.effect.Effect")
