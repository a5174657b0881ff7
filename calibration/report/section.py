"""Sections of a report, and the results that they show."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

from calibration.campaign.campaign import Campaign, Test
from calibration.campaign.measured import MeasuredCurve
from calibration.diagnosis.design import Design
from calibration.diagnosis.diagnosis import CandidateResult, Diagnosis
from calibration.diagnosis.evidence import FitEvidence
from calibration.effects.effect import Effect
from calibration.fit.curves import TestCurves
from calibration.fit.fit import Fit
from calibration.fit.result import CalibrationResult
from calibration.report.content import Block, Text
from calibration.report.drawing import FigureEmbedder
from calibration.report.quantities import ReportUnits
from tissue_sim.laws import find_law

#: Shear modulus, Pa, from which the display unit is chosen if the specimens of a design have different materials.
_DEFAULT_MODULUS = 1e3


@dataclass(frozen=True, eq=False)
class CalibrationReport:
    """Content of the report of a calibration.

    Attributes:
        result: result of the calibration, fits best first.
        curves: law -> recorded and fitted curves of each test, including held-out tests.
        methods: methods text for a paper.
        pictures: destination of the figures; None: the report has no figures.
    """

    result: CalibrationResult
    curves: Mapping[str, Sequence[TestCurves]]
    methods: str
    pictures: FigureEmbedder | None
    kind: ClassVar[str] = "calibration"

    @property
    def campaign_name(self) -> str:
        """Name of the campaign."""
        return self.result.campaign.name

    @property
    def has_figures(self) -> bool:
        """Whether the report has figures."""
        return self.pictures is not None

    @cached_property
    def units(self) -> ReportUnits:
        """Display units of the report."""
        return ReportUnits.choose_for_best_fit(self.result)

    @property
    def fits(self) -> Sequence[Fit]:
        """Fits of all laws, best first."""
        return self.result.fits

    @property
    def campaign(self) -> Campaign:
        """The campaign."""
        return self.result.campaign

    @cached_property
    def tests(self) -> dict[str, Test]:
        """Name -> test."""
        return {test.name: test for test in self.campaign.tests}

    @cached_property
    def recordings(self) -> dict[str, Sequence[MeasuredCurve]]:
        """Name of each test -> its recordings."""
        return {each.test.name: each.measured for each in next(iter(self.curves.values()))}


@dataclass(frozen=True, eq=False)
class DiagnosisReport:
    """Content of the report of a diagnosis.

    Attributes:
        diagnosis: the result of the diagnosis.
        before: the fit without the added effects.
        after: the fit with the added effects; None if no effect was added.
        effects: catalogue of effects by name.
        recordings: name of each test -> its recordings.
        pictures: destination of the figures; None: the report has no figures.
    """

    diagnosis: Diagnosis
    before: FitEvidence
    after: FitEvidence | None
    effects: Mapping[str, Effect]
    recordings: Mapping[str, Sequence[MeasuredCurve]]
    pictures: FigureEmbedder | None
    kind: ClassVar[str] = "diagnosis"

    @property
    def campaign_name(self) -> str:
        """Name of the campaign."""
        return self.diagnosis.campaign

    @property
    def candidates(self) -> Sequence[CandidateResult]:
        """All candidate effects."""
        return self.diagnosis.candidates

    @property
    def has_figures(self) -> bool:
        """Whether the report has figures."""
        return self.pictures is not None

    @cached_property
    def units(self) -> ReportUnits:
        """Display units of the report."""
        return ReportUnits.choose_for_fit(self.diagnosis.fit_before)


@dataclass(frozen=True, eq=False)
class DesignReport:
    """Content of the report of a design.

    Attributes:
        design: the result of the design.
        curves: name of the figure of each planned test -> its noise-free recordings; empty on the terminal.
        pictures: destination of the figures; None: the report has no figures.
    """

    design: Design
    curves: Mapping[str, TestCurves] = field(default_factory=dict)
    pictures: FigureEmbedder | None = None
    kind: ClassVar[str] = "design"

    @property
    def campaign_name(self) -> str:
        """Name of the campaign."""
        return self.design.campaign

    @property
    def candidates(self) -> Sequence[CandidateResult]:
        """All candidate effects."""
        return self.design.candidates

    @property
    def has_figures(self) -> bool:
        """Whether the report has figures."""
        return self.pictures is not None

    @cached_property
    def units(self) -> ReportUnits:
        """Display units of the report, which suit the largest depth and force, and the shear modulus."""
        design, law = self.design, find_law(self.design.law)
        modulus = law.mu0({name: design.parameters[name] for name in law.parameters}) \
            if all(name in design.parameters for name in law.parameters) else _DEFAULT_MODULUS
        return ReportUnits.choose_for_typical_sizes(1e-3 * max(test.depth_mm for test in design.tests),
                                                    max(test.force_N for test in design.tests), modulus)


class Section(ABC):
    """One section of a report. A report shows it if it has content.

    Derived classes state the attributes and define `iterate_blocks`. A class belongs to the registry
    `calibration.report.sections.SECTIONS`, whose order is the order of the page.

    Attributes:
        name: name in the registry.
        reports: kinds of report that have the section: ``"calibration"``, ``"diagnosis"``, ``"design"`` or several.
        title: title; empty: the content follows without a title.
        needs_figures: whether the section is omitted in a report without figures.
        before: name of the section that follows; empty: the order of the registry.
    """

    name: ClassVar[str]
    reports: ClassVar[tuple[str, ...]] = ("calibration",)
    title: ClassVar[Text] = ""
    needs_figures: ClassVar[bool] = False
    before: ClassVar[str] = ""

    def make_title(self, report) -> Text:
        """Return the title in this report (`CalibrationReport`, `DiagnosisReport` or `DesignReport`)."""
        return self.title

    @abstractmethod
    def iterate_blocks(self, report) -> Iterable[Block]:
        """Yield the content in this report (see `make_title`); nothing: no section."""
