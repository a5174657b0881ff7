"""Effects that a plain model leaves out: what each is called, where it acts, and how a model gets it.

An effect is a class with a name, a room and two sentences; its `candidates` are the ways in which it could be in the
tests of a campaign. Everything else (score, refit, files that carry it) follows from the paths of the parameters that a
candidate names. Adding one is one file and one line in `calibration.effects.catalogue`, or an entry point of the group
``tissue_sim.diagnosis_effects`` of somebody else's package.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np

from calibration.campaign.campaign import Campaign, FitSettings, Test
from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameters import SHARED, NamedParameter, declared_around
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.frozen_mapping import read_only
from tissue_sim.laws import find_law
from tissue_sim.material.material import law_declaration
from tissue_sim.material.parts import find_declaration, with_parts
from tissue_sim.model import Model
from tissue_sim.parameters import Declaration, parameters, symbol_at, with_values

Room = Literal["tissue", "contact", "geometry", "rig", "population"]
#: What writes an effect down: material file, campaign, rig file, or nothing (scatter between specimens is no effect of
#: a model).
ROOMS: tuple[Room, ...] = ("tissue", "contact", "geometry", "rig", "population")


#: A tool has come back where it went this share of its largest displacement against its way.
RETURNED = 0.05


class NotTestableError(Exception):
    """These tests cannot hold an effect; the text says why, as the end of a sentence."""


@dataclass(frozen=True, eq=False)
class Situation:
    """What an effect has to know of the tests in which it is looked for.

    Attributes:
        campaign: what is asked, only tests that are fitted. measured: test -> its recordings. law: that is fitted.
    """

    campaign: Campaign
    measured: Mapping[str, Sequence[MeasuredCurve]]
    law: str

    @cached_property
    def tests(self) -> tuple[Test, ...]:
        """The tests that are fitted."""
        return tuple(test for test in self.campaign.tests if not test.hold_out)

    def simulated(self, keep: Callable[[Test], bool] = lambda _: True) -> tuple[Test, ...]:
        """Tests with a specimen and a tool, that the finite elements simulate, and that `keep` takes."""
        return tuple(test for test in self.tests if test.experiment is not None
                     and not self.measured[test.name][0].stressed and keep(test))

    def curves(self, tests: Iterable[Test] | None = None) -> list[MeasuredCurve]:
        """All recordings of some tests; None: of all."""
        return [curve for test in (self.tests if tests is None else tests) for curve in self.measured[test.name]]

    def depth(self, test: Test) -> float:
        """Largest displacement in a test, m (strain of one that was recorded as strain)."""
        return max(float(np.abs(curve.displacement).max()) for curve in self.measured[test.name])

    def force(self, test: Test) -> float:
        """Largest force in a test, N."""
        return max(float(np.abs(curve.force).max()) for curve in self.measured[test.name])

    @cached_property
    def timed(self) -> bool:
        """Whether every recording has a time that advances."""
        return all(curve.time is not None and np.ptp(curve.time) > 0 for curve in self.curves())

    @cached_property
    def times(self) -> tuple[float, float]:
        """The usual step and the length of the longest recording, s.

        Raises:
            NotTestableError: a recording has no time.
        """
        if not self.timed:
            raise NotTestableError("the recordings have no time")
        clocks = [curve.clock for curve in self.curves()]
        return float(np.median([np.median(np.diff(clock)) for clock in clocks])), \
            max(float(clock[-1] - clock[0]) for clock in clocks)

    @cached_property
    def modulus(self) -> float:
        """About the shear modulus of the tissue, Pa, for the size of what is tried first: the middle one of those that
        the largest force of each test gives in linear elasticity."""
        found = []
        for test in self.tests:
            force, depth = self.force(test), self.depth(test)
            if test.experiment is None or self.measured[test.name][0].stressed:
                area, height = (1.0, 1.0) if test.specimen is None else (test.specimen.area, test.specimen.height)
                found.append(force * height / (3.0 * area * depth))
            elif test.experiment.tool.is_plate:
                specimen = test.experiment.specimen
                area = specimen.area if specimen.is_prism else np.pi * specimen.margin() ** 2
                found.append(force * specimen.height / (3.0 * area * depth))
            else:
                found.append(force / (8.0 * self.contact_radius(test) * depth))
        return float(np.median(found))

    def contact_radius(self, test: Test) -> float:
        """About how wide the contact of a test with a tool is at its largest displacement, m."""
        experiment = experiment_of(test)
        return experiment.tool.contact_radius(self.depth(test), experiment.specimen.margin())

    def strain(self, test: Test) -> float:
        """About how much a test with a tool strains the tissue: its depth over the height, or the width of a needle."""
        experiment = experiment_of(test)
        size = experiment.specimen.height if experiment.tool.is_plate else 2.0 * self.contact_radius(test)
        return self.depth(test) / size

    def returns(self, test: Test) -> bool:
        """Whether the tool comes back in any recording of a test."""
        return any(float(np.max(np.maximum.accumulate(curve.displacement) - curve.displacement))
                   > RETURNED * self.depth(test) for curve in self.measured[test.name])

    def fastest(self, tests: Iterable[Test]) -> float:
        """Speed of the fastest loading, m/s.

        Raises:
            NotTestableError: the recordings have no time.
        """
        speeds = [curve.speed for curve in self.curves(tests) if self.timed and curve.speed]
        if not speeds:
            raise NotTestableError("the recordings have no time")
        return max(speeds)

    def require_new(self, path: str) -> None:
        """Refuse a number that the campaign fits or holds.

        Raises:
            NotTestableError: it does.
        """
        if path in self.campaign.fit.start or path in self.campaign.fit.fixed:
            raise NotTestableError("the campaign names it already, so it is fitted, or held where it was put")

    def relaxation_times(self, per_decade: float = 2.0) -> list[float]:
        """Times that these recordings could resolve, s, evenly on a logarithmic axis: from three samples to the
        longest recording."""
        step, longest = self.times
        shortest = min(3.0 * step, 0.1 * longest)
        count = max(2, int(np.ceil(per_decade * np.log10(longest / shortest))) + 1)
        return np.geomspace(shortest, longest, count).tolist()


@dataclass(frozen=True, eq=False)
class Candidate:
    """One way in which an effect could be in the tests: its numbers, and the campaign that has them.

    Attributes:
        effect: it belongs to.
        sizes: path in the model -> value at which it is tried first, SI: a usual size, for which the change of the
            force is far above the rounding of a simulation. These numbers have a value at which the effect is absent.
        absent: path -> that value, where it is not the one that the path declares.
        shape: path -> value, SI, of numbers that mean nothing where the effect is absent (a relaxation time); other
            candidates try other values, and a refit lets them free.
        bounds: path -> lowest and highest value that a refit may take, where they are narrower than declared.
        tests: names of those that have the numbers; None: all that could.
        scope: ``per_specimen`` or ``per_test`` where each of them has numbers of its own; else they share them.
        law: the wider law that has the numbers; None: the one that is fitted.
        prepare: a test -> the same with the part that the numbers belong to (an adhesion of no force).
        mark: what tells it from the effect's other candidates where that is no number: the name of a test.
        inverse: whether the change of the force is in proportion to one over the number, as it is to one over a
            stiffness.
        jump: path in `shape` of the displacement, m, at which the force jumps: no descent moves it, so that it is
            sought between the values of the other candidates before a refit.
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

    def sizes_at(self, absent: Mapping[str, float], factor: float) -> dict[str, float]:
        """Path -> value at which the change of the force is about `factor` times that of the size tried first.

        Args:
            absent: path -> value at which it is absent, SI.
        """
        if self.inverse:
            inverses = {path: (1.0 / absent[path], 1.0 / size) for path, size in self.sizes.items()}
            # Beyond its absence it would run away, and become negative.
            return {path: 1.0 / max(zero + factor * (one - zero), 0.5 * zero) for path, (zero, one) in inverses.items()}
        return {path: absent[path] + factor * (size - absent[path]) for path, size in self.sizes.items()}

    @property
    def name(self) -> str:
        """Of the effect, with the test where it acts in one only."""
        return f"{self.effect.name}@{self.mark}" if self.mark else self.effect.name

    @property
    def title(self) -> str:
        """Of the effect, for people, with the test where it acts in one only."""
        return f"{self.effect.title} in {self.mark}" if self.mark else self.effect.title

    @property
    def paths(self) -> frozenset[str]:
        """Of all of its numbers."""
        return frozenset({**self.sizes, **self.shape})

    def declaration(self, campaign: Campaign, path: str) -> Declaration:
        """What a number of it is.

        Raises:
            NotTestableError: no test has it.
        """
        if not path.startswith(("experiment.", "rig.")):
            law = None if self.law is None else find_law(self.law)
            if law is not None and path in law.parameters:
                return law_declaration(law, path)
            return find_declaration(path)[1]
        for test in campaign.tests:
            found = declared_around(test.experiment, test.rig).get(path)
            if found is not None and (self.tests is None or test.name in self.tests):
                return found
        raise NotTestableError("no test has it")

    def absent_value(self, campaign: Campaign, path: str) -> float:
        """The value at which it is absent, SI."""
        if path in self.absent:
            return self.absent[path]
        stated = self.declaration(self.prepared(campaign), path).absent
        if stated is None:
            raise TypeError(f"{self.effect.name}: {path} declares no value at which it is absent; give one")
        return stated

    def remeshes(self, campaign: Campaign) -> bool:
        """Whether its shape makes another mesh, even where it is absent."""
        campaign = self.prepared(campaign)
        return any(self.declaration(campaign, path).shapes_mesh for path in self.shape)

    def prepared(self, campaign: Campaign) -> Campaign:
        """The campaign whose tests have the parts that its numbers belong to."""
        if self.prepare is None:
            return campaign
        having = self.having(campaign)
        return replace(campaign, tests=tuple(
            self.prepare(test) if having is None or test.name in having else test for test in campaign.tests))

    def having(self, campaign: Campaign) -> tuple[str, ...] | None:
        """Names of the tests that have the numbers; None: all that could. Beside its own, where it belongs to no
        single one of them, those that the campaign holds out and that state the same: one rig, one specimen."""
        if self.tests is None or self.mark or not all(path.startswith(("experiment.", "rig.")) for path in self.sizes):
            return self.tests
        # Those of its own are alike in it; the first stands for them.
        stands = next(test for test in campaign.tests if test.name == self.tests[0])
        return (*self.tests, *(test.name for test in campaign.tests if test.hold_out and test.name not in self.tests
                               and test.experiment is not None and all(
                                   _stated(test, path) == _stated(stands, path) for path in self.sizes)))

    def added_to(self, campaign: Campaign, values: Mapping[str, float] | None = None, *,
                 free: bool) -> Campaign:
        """The campaign with the effect.

        Args:
            campaign: what is asked. values: path -> value, SI, of its numbers; None: those at which it is tried.
            free: whether a fit varies them, or holds them.

        Raises:
            NotTestableError: no test has its numbers.
        """
        tests = self.having(campaign)
        campaign = self.prepared(campaign)
        values = {**self.sizes, **self.shape, **(values or {})}
        settings, everywhere = campaign.fit, tuple(test.name for test in campaign.tests)
        named, bounds = dict(settings.named), dict(settings.bounds)
        wider = {} if self.law is None else dict.fromkeys(find_law(self.law).parameters, 0.0)
        for path in values:
            what = self.declaration(campaign, path)
            of_law = path in wider
            having = everywhere if not path.startswith(("experiment.", "rig.")) else tuple(
                test.name for test in campaign.tests if path in declared_around(test.experiment, test.rig))
            if tests is not None:
                having = tuple(name for name in tests if name in having)
            scope = self.scope if self.tests is None or self.scope != SHARED else having
            named[path] = NamedParameter(path, what, of_law, scope, having)
            if path in self.bounds:
                bounds[path] = self.bounds[path]
        # A wider law holds what neither it nor the campaign's own law has.
        held = {name: 0.0 for name in wider if name not in find_law(settings.laws[0]).parameters and name not in values}
        for name in held:
            named[name] = NamedParameter(name, law_declaration(find_law(str(self.law)), name), True, SHARED, everywhere)
        start, fixed = dict(settings.start), {**settings.fixed, **held}
        for path, value in values.items():
            here, elsewhere = (start, fixed) if free and path != self.jump else (fixed, start)
            here[path] = value
            elsewhere.pop(path, None)
        laws = settings.laws if self.law is None else (self.law,)
        changed: FitSettings = replace(settings, laws=laws, named=read_only(named), start=read_only(start),
                                       fixed=read_only(fixed), bounds=read_only(bounds))
        return replace(campaign, fit=changed)

    def symbols(self, campaign: Campaign) -> dict[str, str]:
        """Path -> symbol, of all of its numbers."""
        campaign = self.prepared(campaign)
        return {path: symbol_at(path, self.declaration(campaign, path)) for path in {**self.sizes, **self.shape}}


class Effect(ABC):
    """An effect by name.

    Attributes:
        name: in files, JSON and reports. room: where it belongs, one of `ROOMS`. title: for people.
        signature: sentence, what it leaves in a recording. separated_by: sentence, what tells it from others.
        known_twins: names of effects that no force and displacement tell from it.
        times: how often it may be added, each time with numbers of its own (terms of a series).
        like_moduli: whether it is a factor of every force, which no force tells from the moduli.
    """

    name: ClassVar[str]
    room: ClassVar[Room]
    title: ClassVar[str]
    signature: ClassVar[str]
    separated_by: ClassVar[str]
    known_twins: ClassVar[tuple[str, ...]] = ()
    times: ClassVar[int] = 1
    like_moduli: ClassVar[bool] = False
    #: The wider law that its numbers belong to; None: they belong to no law.
    law: ClassVar[str | None] = None

    @abstractmethod
    def candidates(self, situation: Situation) -> list[Candidate]:
        """The ways in which it could be in these tests; one a value of what means nothing in its absence.

        Raises:
            NotTestableError: these tests cannot hold it, and why.
        """

    def apply(self, model: Model, values: Mapping[str, float]) -> Model:
        """The model with the effect; parts that it does not have are made.

        Args:
            model: without it. values: path -> value, SI, all numbers of a part that is to be made.

        Raises:
            InputError: a path that no model has, or numbers that the parts refuse.
        """
        around = {path: value for path, value in values.items() if path.startswith(("experiment.", "rig."))}
        within = {path.removeprefix("material."): value for path, value in values.items() if path not in around}
        if self.law is not None:
            wider = {**dict.fromkeys(find_law(self.law).parameters, 0.0), **model.material.parameters}
            model = replace(model, material=replace(model.material, law=self.law, parameters=wider))
        if within:
            model = replace(model, material=with_parts(model.material, within))
        return with_values(model, around) if around else model


def _stated(test: Test, path: str) -> float | None:
    """What a test with a tool states of a number, SI; None where it has none."""
    part, _, inside = path.partition(".")
    stated = parameters(getattr(test, part)).get(inside)
    return None if stated is None else stated.value


def experiment_of(test: Test) -> Experiment:
    """What is done in a test with a tool."""
    assert test.experiment is not None, test.name
    return test.experiment
