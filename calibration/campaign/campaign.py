"""A campaign: which specimens were tested how, where the recordings are, and how to fit them. SI inside."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from calibration.campaign.checks import (
    check_available,
    check_bulk_ratio,
    check_closed,
    check_parameters,
    check_unused,
    find_recordings,
    read_columns_key,
    require_positive,
)
from calibration.campaign.experiments import read_experiment, read_rig, read_solver
from calibration.campaign.parameters import (
    PER_SPECIMEN,
    Named,
    check_values,
    declared_around,
    find_named,
    stated_material,
)
from calibration.campaign.schema import (
    BY_PARAMETER,
    PRISM,
    CampaignTable,
    FitTable,
    NoiseTable,
    TestTable,
    decode_campaign,
)
from calibration.campaign.specimens import find_specimen, read_specimens
from tissue_sim.errors import InputError, located, nearest
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.experiment.kinds.kind import KINDS, TestKind
from tissue_sim.frozen_mapping import read_only
from tissue_sim.laws import LAWS
from tissue_sim.material.material import Bulk, Material
from tissue_sim.recording.formats.columns import check_decimal, check_delimiter
from tissue_sim.rig.rig import Rig
from tissue_sim.specimen import Specimen

#: Prior standard deviation of a contact offset when neither the fit nor the noise states one, m; that of a short test
#: is smaller.
DEFAULT_OFFSET_PRIOR = 0.05e-3
#: Half width of the bounds of a contact offset of an analytical fit where the campaign does not say, m; the same.
DEFAULT_OFFSET_BOUND = 0.5e-3
#: Starts of an inverse fit where the campaign does not say.
DEFAULT_STARTS = 3
MOST_STARTS = 1000


def _read_only(values: Mapping | None = None) -> Mapping:
    return read_only(values or {})


@dataclass(frozen=True)
class Test:
    """One test and its replicates.

    Attributes:
        name: unique in the campaign.
        kind: what it is.
        specimen: None where the recordings are stretch and stress already.
        recordings: files, sorted, at least one.
        reading: how to read them, the options of `tissue_sim.read_recordings`.
        max_strain: fitted window of the nominal strain (shear strain for shear), or None for everything.
        hold_out: predicted, not fitted. place: where it stands in the campaign file, such as ``test[0]``.
        experiment: everything but the motion, which is a short one here; None of a gripped specimen.
        rig: what stands between the tissue and the recordings; without noise and resolution.
        contact: displacement at which it touches, m; ``"recorded"``: the recording's own zero; ``"find"``: found.
        failure: what becomes of a recording from its failure on: ``"cut"``, ``"keep"`` or ``"refuse"``.
        control: quantity that the machine controls, ``"displacement"`` or ``"force"``; ``"find"``: by the signals.
        protocol: its motion, where it is planned and has no recordings. solver: name of what simulates it.
        leave_out: name of a recording -> numbers of the samples that are left out, from 1; the name ``""`` is that of
            the only recording. Outliers of the other recordings are found.
    """

    name: str
    kind: TestKind
    specimen: Specimen | None
    recordings: tuple[Path, ...]
    reading: Mapping[str, Any] = field(default_factory=_read_only)
    max_strain: float | None = None
    hold_out: bool = False
    place: str = "test"
    experiment: Experiment | None = None
    rig: Rig = field(default_factory=Rig)
    contact: float | Literal["recorded", "find"] = "recorded"
    failure: Literal["cut", "keep", "refuse"] = "cut"
    protocol: str | None = None
    solver: str = "axisymmetric"
    leave_out: Mapping[str, tuple[int, ...]] = field(default_factory=_read_only)
    control: Literal["find", "displacement", "force"] = "find"


@dataclass(frozen=True)
class FitSettings:
    """How to fit.

    Attributes:
        laws: names in `tissue_sim.laws.LAWS`.
        method: ``"analytical"`` (homogeneous tests, closed forms) or ``"inverse_fem"``.
        bulk: bulk response that goes into the material files; the analytical fit itself is incompressible.
        offset: ``"none"`` or ``"fit"``: a contact offset and a zero per replicate.
        offset_bound, offset_prior: m, half width of the bounds and standard deviation of the prior.
        offset_usual: which of these two nobody stated.
        zero_bound, zero_prior: N; None: ten times the prior, which is five times the noise of the force.
        strain_points: evenly spaced strains that every replicate is interpolated to, or None for its own samples.
        starts: how many an inverse fit tries.
        whole: whether holds and returns are compared with a material that does not remember, too.
        named: path -> what it is, of every parameter that the campaign names; see `calibration.campaign.parameters`.
        start, fixed: path -> value, SI; parts of the material that they name it then has. prior: path -> (mean,
            standard deviation). bounds: (low, high).
    """

    laws: tuple[str, ...]
    bulk: Bulk = field(default_factory=Bulk)
    offset: str = "none"
    offset_bound: float = DEFAULT_OFFSET_BOUND
    offset_prior: float = DEFAULT_OFFSET_PRIOR
    offset_usual: tuple[str, ...] = ()
    zero_bound: float | None = None
    zero_prior: float | None = None
    strain_points: int | None = None
    starts: int = DEFAULT_STARTS
    method: str = "analytical"
    whole: bool = False
    named: Mapping[str, Named] = field(default_factory=_read_only)
    start: Mapping[str, float] = field(default_factory=_read_only)
    fixed: Mapping[str, float] = field(default_factory=_read_only)
    prior: Mapping[str, tuple[float, float]] = field(default_factory=_read_only)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=_read_only)

    @property
    def others(self) -> tuple[str, ...]:
        """Paths of the parameters that are fitted or stated beside those of the laws."""
        return tuple(path for path in (*self.start, *self.fixed) if path in self.named and not self.named[path].of_law)

    @property
    def material(self) -> Material:
        """A material of whatever law with the parts that the campaign names: to ask what it does."""
        return stated_material({**self.start, **self.fixed}, self.named)


@dataclass(frozen=True)
class Noise:
    """What is known about the scatter of the measurement, as standard deviations.

    Attributes:
        force: N; None: estimated from the samples.
        nominal_stress: Pa, for tests that are recorded as stress; None: estimated.
        contact_jitter: m, of the contact point between replicates; None: estimated (inverse fits).
        zero_jitter: N, of the zero between replicates; None: estimated (inverse fits).
        correlation_time: s, of the force noise; 0 is white; None: estimated (inverse fits).
    """

    force: float | None = None
    nominal_stress: float | None = None
    contact_jitter: float | None = 0.0
    zero_jitter: float | None = 0.0
    correlation_time: float | None = None


@dataclass(frozen=True)
class Campaign:
    """Everything that a calibration depends on, apart from the content of the recordings.

    Attributes:
        path: the campaign file.
        name: its stem.
        specimens: by name.
        tests: at least one that is not held out.
        sha256: of the campaign file.
        density: kg/m3, where all fitted tests state the same for their specimens; None otherwise.
        prisms: names of the specimens that are known by their cross-section and height only.
    """

    path: Path
    specimens: Mapping[str, Specimen]
    tests: tuple[Test, ...]
    fit: FitSettings
    noise: Noise
    sha256: str
    density: float | None = None
    prisms: frozenset[str] = frozenset()

    @property
    def name(self) -> str:
        return self.path.stem


def load_campaign(path: str | Path, *, planned: bool = False) -> Campaign:
    """Read and check a campaign file; recordings are resolved (globs expanded, sorted) but not read. Tests of a
    `planned` one may have a protocol instead.

    Raises:
        InputError: anything wrong in the file, with the file and the dotted field.
    """
    path = Path(path)
    table, data, defaults = decode_campaign(path)
    try:
        with located(file=path):
            if table.questions:
                first = table.questions[0].partition("?")[0]
                raise InputError(f"{first}? Import again with the flag that decides, or delete this key to accept the "
                                 "assumed values", field="questions")
            tests = _tests(table, specimens := read_specimens(table, path.parent), path.parent, planned)
            prisms = frozenset(name for name, entry in zip(specimens, table.specimen, strict=True)
                               if entry.shape == PRISM)
            return Campaign(path, _read_only(specimens), tests, _fit_settings(table.fit, table.noise, tests),
                            _noise(table.noise, table.fit.method), hashlib.sha256(data).hexdigest(), _density(tests),
                            prisms)
    except InputError as error:
        raise defaults.located(error, path) from None


def _density(tests: tuple[Test, ...]) -> float | None:
    fitted = {None if test.specimen is None else test.specimen.density for test in tests if not test.hold_out}
    return fitted.pop() if len(fitted) == 1 else None


def _tests(table: CampaignTable, specimens: Mapping[str, Specimen], folder: Path, planned: bool) -> tuple[Test, ...]:
    if not table.test:
        raise InputError("a campaign needs at least one [[test]]", field="test")
    tests: dict[str, Test] = {}
    for i, entry in enumerate(table.test):
        field = f"test[{i}]"
        same_kind = sum(other.kind == entry.kind for other in table.test) > 1
        name = entry.name if entry.name is not None else f"{entry.kind}_{i + 1}" if same_kind else entry.kind
        if name in tests:
            raise InputError(f"the name {name!r} is taken by another test; names must be unique", field=f"{field}.name")
        if table.fit.method == "analytical":
            check_available(entry, field)
        elif entry.protocol is not None and not planned:
            raise InputError("the motion of a test is that of its recordings; leave the protocol out",
                             field=f"{field}.protocol")
        require_positive(entry.speed_mm_s, f"{field}.speed_mm_s", " mm/s")
        require_positive(entry.max_strain, f"{field}.max_strain")
        kind = KINDS[entry.kind]
        if entry.max_strain is not None and kind.sign < 0 and entry.max_strain >= 1:
            raise InputError(f"{entry.max_strain:g} is not below 1, where the specimen would have no height left",
                             field=f"{field}.max_strain")
        if not isinstance(entry.contact, str) and not np.isfinite(entry.contact):
            raise InputError(f"{entry.contact} is no place; give a number of mm, 'recorded' or 'find'",
                             field=f"{field}.contact")
        if entry.skip_lines is not None and entry.skip_lines < 0:
            raise InputError(f"{entry.skip_lines} is negative; give a number of lines", field=f"{field}.skip_lines")
        for key in ("skip_lines", "delimiter", "decimal"):
            if getattr(entry, key) and entry.columns is None:
                raise InputError(f"{key} is for files whose columns are named; give columns too, or leave it out",
                                 field=f"{field}.{key}")
        if entry.delimiter:
            check_delimiter(entry.delimiter, f"{field}.delimiter")
        if entry.decimal is not None:
            check_decimal(entry.decimal, f"{field}.decimal")
        specimen = find_specimen(entry, specimens, table, field)
        tests[name] = Test(
            name, kind, specimen, () if entry.protocol is not None and not entry.recordings else
            find_recordings(entry.recordings, folder, f"{field}.recordings"),
            _reading(entry, read_columns_key(entry, field)), entry.max_strain, entry.hold_out, field,
            read_experiment(entry, specimen, folder, field), read_rig(entry, folder, field),
            entry.contact if isinstance(entry.contact, str) else 1e-3 * entry.contact, entry.failure, entry.protocol,
            read_solver(entry, specimen, field), _leave_out(entry, f"{field}.leave_out"), entry.control)
    if all(test.hold_out for test in tests.values()):
        raise InputError("every test is held out, so there is nothing to fit; set hold_out = false on one",
                         field="test[0].hold_out")
    return tuple(tests.values())


def _leave_out(entry: TestTable, field: str) -> Mapping[str, tuple[int, ...]]:
    """`Test.leave_out` of a table."""
    stated = entry.leave_out
    if isinstance(stated, str):
        return _read_only()
    by_name = stated if isinstance(stated, dict) else {"": stated}
    for name, samples in by_name.items():
        for number in samples:
            if number < 1:
                raise InputError(f"the numbers of samples must be at least 1; got {number}",
                                 field=f"{field}.{name}" if name else field)
    return _read_only({name: tuple(samples) for name, samples in by_name.items()})


def _reading(entry: TestTable, columns: Mapping[str, Any] | None) -> Mapping[str, Any]:
    """Options of `tissue_sim.read_recordings`, those that the test states."""
    stated = {"columns": columns, "skip_lines": entry.skip_lines, "delimiter": entry.delimiter, "sheet": entry.sheet,
              "curve": entry.curve, "decimal": entry.decimal,
              "speed": None if entry.speed_mm_s is None else entry.speed_mm_s * 1e-3}
    return _read_only({"format": entry.format, **{key: value for key, value in stated.items() if value is not None}})


def _fit_settings(table: FitTable, noise: NoiseTable, tests: tuple[Test, ...]) -> FitSettings:
    if not table.laws:
        raise InputError(f"name at least one law; known: {', '.join(LAWS)}", field="fit.laws")
    for i, name in enumerate(table.laws):
        if name not in LAWS:
            raise InputError(f"unknown law {name!r}{nearest(name, LAWS)}", field=f"fit.laws[{i}]")
        if name in table.laws[:i]:
            raise InputError(f"{name} is listed twice", field=f"fit.laws[{i}]")
    for key in ("bulk_ratio", "offset_bounds_mm", "offset_prior_mm", "zero_bounds_N", "zero_prior_N"):
        require_positive(getattr(table, key), f"fit.{key}")
    check_bulk_ratio(table.bulk_ratio)
    if table.strain_points is not None and table.strain_points < 5:
        raise InputError(f"{table.strain_points} points are too few; give at least 5", field="fit.strain_points")
    if table.starts is not None and not 1 <= table.starts <= MOST_STARTS:
        raise InputError(f"{table.starts} starts; give 1 to {MOST_STARTS}", field="fit.starts")
    check_unused(table, noise)
    check_parameters(table)
    named = find_named(table, {test.name: declared_around(None if test.specimen is None else test.experiment, test.rig)
                               for test in tests},
                       {test.name: () if test.specimen is None else test.specimen.region_names for test in tests})
    check_values(table, named)
    for name, what in named.items():
        bare = [test.name for test in tests if test.specimen is None and not test.hold_out and test.name in what.tests]
        if what.scope == PER_SPECIMEN and bare:
            raise InputError(f"{', '.join(bare)} names no specimen, so none has a value of its own; add a "
                             "[[specimen]], or give the scope 'per_test'", field=f"fit.scope.{name}")
    if table.method == "analytical":
        check_closed(table, named)
    by_path = {what.path: what for what in named.values()}
    start, fixed, prior, bounds = (
        {named[name].path: tuple(factor * end for end in value) if isinstance(value, tuple) else factor * value
         for name, value in getattr(table, key).items() for factor in (named[name].declaration.factor,)}
        for key in BY_PARAMETER)
    offset_prior = next((value * 1e-3 for value in (table.offset_prior_mm, noise.contact_jitter_mm)
                         if isinstance(value, float | int) and value > 0), None)
    usual = (*(["offset_prior"] if offset_prior is None else []),
             *(["offset_bound"] if table.offset_bounds_mm is None else []))
    zero_prior = next((float(value) for value in (table.zero_prior_N, noise.zero_jitter_N)
                       if isinstance(value, float | int) and value > 0), None)
    return FitSettings(
        laws=tuple(table.laws), bulk=Bulk() if table.bulk_ratio is None else Bulk("bulk_ratio", table.bulk_ratio),
        offset=table.offset, offset_prior=offset_prior or DEFAULT_OFFSET_PRIOR, offset_usual=usual,
        offset_bound=DEFAULT_OFFSET_BOUND if table.offset_bounds_mm is None else table.offset_bounds_mm * 1e-3,
        zero_bound=table.zero_bounds_N, zero_prior=zero_prior, strain_points=table.strain_points,
        starts=table.starts or DEFAULT_STARTS, method=table.method,
        named=_read_only(by_path), start=_read_only(start), fixed=_read_only(fixed), prior=_read_only(prior),
        bounds=_read_only(bounds))


def _noise(table: NoiseTable, method: str) -> Noise:
    for key in ("force_N", "nominal_stress_Pa"):
        value = getattr(table, key)
        require_positive(None if value == "estimate" else value, f"noise.{key}")
    known: dict[str, float | None] = {}
    for key in ("contact_jitter_mm", "zero_jitter_N", "correlation_time_s"):
        value = getattr(table, key)
        if method == "analytical":
            if value == "estimate":
                raise InputError('"estimate" needs fit.method = "inverse_fem"; state a standard deviation or leave it '
                                 "out", field=f"noise.{key}")
            if key == "correlation_time_s" and value:
                raise InputError('coloured noise needs fit.method = "inverse_fem"; leave it out', field=f"noise.{key}")
            value = value or 0.0
        # What an inverse fit estimates unless it is stated.
        known[key] = None if value in (None, "estimate") else float(value)
        if value not in (None, "estimate") and not (np.isfinite(value) and value >= 0):
            raise InputError(f"{value:g} is negative; give 0 or more", field=f"noise.{key}")
    contact = known["contact_jitter_mm"]
    return Noise(
        force=None if table.force_N == "estimate" else table.force_N,
        nominal_stress=None if table.nominal_stress_Pa == "estimate" else table.nominal_stress_Pa,
        contact_jitter=None if contact is None else contact * 1e-3, zero_jitter=known["zero_jitter_N"],
        correlation_time=known["correlation_time_s"])
