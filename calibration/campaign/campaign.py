"""Read a campaign file: specimens, tests, recordings and fit settings, converted to SI units."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from calibration.campaign.modulus_tables import convert_pre_strain_to_abscissa, list_moduli_of_table
from calibration.campaign.parameters import (
    OFFSET_DEFAULTS,
    PER_SPECIMEN,
    ScopedCampaignParameter,
    build_placeholder_material_with_effects,
    check_stated_bounds_and_completeness,
    get_experiment_and_rig_declarations_by_path,
    resolve_campaign_parameters_by_name,
)
from calibration.campaign.schema import (
    BY_PARAMETER,
    PRISM,
    CampaignTable,
    FitTable,
    NoiseTable,
    TestTable,
    decode_campaign_tables_bytes_and_defaults,
)
from calibration.campaign.tables import (
    check_bulk_of_confined_tests,
    check_bulk_ratio,
    check_compressible_laws,
    check_values_finite_and_consistent,
    find_and_check_specimen_or_none,
    find_recording_files,
    read_column_map_or_none,
    read_experiment_or_none_if_gripped,
    read_rig_without_noise,
    read_solver_name,
    read_specimens_by_name,
    read_stable_stretches,
    reject_fit_and_noise_keys_without_effect,
    require_analytical_support_of_fit_table,
    require_analytical_support_of_test_table,
    require_positive_if_stated,
)
from tissue_sim.errors import InputError, located_and_converted_errors
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.experiment.kinds.kind import DISPLACEMENT_FORCE, KINDS, TestKind
from tissue_sim.laws import LAWS
from tissue_sim.material.material import Bulk, Material
from tissue_sim.material.softening import SofteningForm
from tissue_sim.rig.modulus_readout import ModulusReadout
from tissue_sim.rig.rig import Rig
from tissue_sim.settings import make_shallow_read_only_copy
from tissue_sim.specimen import Specimen

#: Default number of starts of an inverse fit.
DEFAULT_STARTS = 3
#: Maximum number of starts of an inverse fit.
MAX_STARTS = 1000


def _freeze_mapping(values: Mapping | None = None) -> Mapping:
    """Return a read-only copy of a mapping; an empty mapping for None."""
    return make_shallow_read_only_copy(values or {})


@dataclass(frozen=True)
class Test:
    """One test with its replicate recordings.

    Attributes:
        name: name, unique in the campaign.
        kind: kind of test.
        specimen: tested specimen; None if the recordings contain stretch and stress.
        recordings: sorted paths of the recordings, at least one.
        reading: options for `tissue_sim.read_recordings`.
        max_strain: largest fitted nominal strain (shear strain for shear); None: all samples are fitted.
        hold_out: whether the test is predicted and not fitted.
        place: position of the test in the campaign file, such as ``test[0]``.
        experiment: experiment with a short placeholder motion; None for a gripped specimen.
        rig: test rig without noise and resolution.
        contact: displacement at contact, m; ``"recorded"``: the zero of the recording; ``"find"``: detected.
        failure: treatment of samples after a failure: ``"cut"``, ``"keep"`` or ``"refuse"``.
        control: quantity that the machine controls, ``"displacement"`` or ``"force"``; ``"find"``: detected.
        table_name: name of the table ``[[test]]``; empty: `name`. A table of a kind with several loads gives one test
            for each load.
        modulus: modulus of a table of storage and loss modulus that the test compares with the model; empty: the
            recordings have a motion.
        modulus_abscissa: stretch or shear strain about which the specimen oscillates in a table of moduli.
        protocol: motion of a planned test without recordings, as text.
        solver: name of the solver that simulates the test.
        leave_out: name of a recording -> numbers of the samples to leave out, counted from 1; the name ``""`` means
            the only recording. In recordings that are not listed, outliers are detected.
    """

    name: str
    kind: TestKind
    specimen: Specimen | None
    recordings: tuple[Path, ...]
    reading: Mapping[str, Any] = field(default_factory=_freeze_mapping)
    max_strain: float | None = None
    hold_out: bool = False
    place: str = "test"
    experiment: Experiment | None = None
    rig: Rig = field(default_factory=Rig)
    contact: float | Literal["recorded", "find"] = "recorded"
    failure: Literal["cut", "keep", "refuse"] = "cut"
    protocol: str | None = None
    solver: str = "axisymmetric"
    leave_out: Mapping[str, tuple[int, ...]] = field(default_factory=_freeze_mapping)
    control: Literal["find", "displacement", "force"] = "find"
    table_name: str = ""
    modulus: str = ""
    modulus_abscissa: float = 0.0

    @property
    def readout(self) -> ModulusReadout | None:
        """Readout of a table of moduli without effects of the instrument; None for recordings of a motion."""
        return ModulusReadout() if self.modulus else None

    @property
    def states_stress(self) -> bool:
        """Whether the curves of the test are strain and nominal stress: no specimen, or a kind without a force."""
        return self.specimen is None or DISPLACEMENT_FORCE not in self.kind.channels

    @property
    def reference_height(self) -> float:
        """Height that converts displacement to strain, m; 1 for a test of strain and stress (`MeasuredCurve`)."""
        return 1.0 if self.specimen is None or self.states_stress else self.specimen.height

    @property
    def reference_area(self) -> float:
        """Cross-section that converts force to stress, m2; 1 for a test of strain and stress.

        Raises:
            InputError: the specimen has no constant cross-section.
        """
        return 1.0 if self.specimen is None or self.states_stress else self.specimen.area


@dataclass(frozen=True)
class FitSettings:
    """Settings of a fit.

    Attributes:
        laws: names of the laws to fit, see `tissue_sim.laws.LAWS`.
        method: ``"analytical"`` (homogeneous tests, closed forms) or ``"inverse_fem"``.
        bulk: bulk response written to the material files; the analytical fit assumes an incompressible material.
        offset: ``"none"``, or ``"fit"`` to fit a contact offset and a force zero per replicate.
        offset_bound: half width of the bounds of a contact offset, m.
        offset_prior: standard deviation of the prior of a contact offset, m.
        offset_usual: names of the two fields above that have default values because the campaign does not state them.
        zero_bound: half width of the bounds of a force zero, N; None: ten times the prior.
        zero_prior: standard deviation of the prior of a force zero, N; None: five times the noise of the force.
        strain_points: number of evenly spaced strains to which each replicate is interpolated; None: no interpolation.
        starts: number of starts of an inverse fit.
        whole: whether holds and unloading are fitted also for a material without memory.
        named: parameters that the campaign names, by path; see `calibration.campaign.parameters`.
        start: start values by path, SI; they also define the parts of the material.
        fixed: fixed values by path, SI; they also define the parts of the material.
        prior: (mean, standard deviation) by path, SI.
        bounds: (low, high) by path, SI.
        softening_form: form of the softening on first load, see `tissue_sim.material.softening.Softening`.
        stable: whether the law is kept Drucker-stable over the stretches of the data; or (lowest, highest) stretch.
    """

    laws: tuple[str, ...]
    bulk: Bulk = field(default_factory=Bulk)
    offset: str = "none"
    offset_bound: float = OFFSET_DEFAULTS.contact_bound
    offset_prior: float = OFFSET_DEFAULTS.contact_prior
    offset_usual: tuple[str, ...] = ()
    zero_bound: float | None = None
    zero_prior: float | None = None
    strain_points: int | None = None
    starts: int = DEFAULT_STARTS
    method: str = "analytical"
    whole: bool = False
    named: Mapping[str, ScopedCampaignParameter] = field(default_factory=_freeze_mapping)
    start: Mapping[str, float] = field(default_factory=_freeze_mapping)
    fixed: Mapping[str, float] = field(default_factory=_freeze_mapping)
    prior: Mapping[str, tuple[float, float]] = field(default_factory=_freeze_mapping)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=_freeze_mapping)
    softening_form: SofteningForm = "tanh"
    stable: bool | tuple[float, float] = False

    @property
    def stated_non_law_parameter_paths(self) -> tuple[str, ...]:
        """Paths of the parameters in `start` or `fixed` that are not parameters of a law."""
        return tuple(path for path in (*self.start, *self.fixed) if path in self.named
                     and not self.named[path].is_law_parameter)

    @property
    def placeholder_material_with_effects(self) -> Material:
        """Neo-Hookean material with the effects that the campaign names, to query memory and layers; not for forces."""
        return build_placeholder_material_with_effects({**self.start, **self.fixed}, self.named)


@dataclass(frozen=True)
class Noise:
    """Stated standard deviations of the measurement.

    Attributes:
        force: noise of the force, N; None: estimated from the samples.
        nominal_stress: noise of the stress, Pa, for tests recorded as stress; None: estimated.
        modulus: noise of a storage or loss modulus relative to its value; None: estimated for each modulus.
        displacement: noise of the displacement, m, for recordings under force control; None: estimated.
        contact_jitter: scatter of the contact point between replicates, m; None: estimated (inverse fits).
        zero_jitter: scatter of the force zero between replicates, N; None: estimated (inverse fits).
        correlation_time: correlation time of the force noise, s; 0: white noise; None: estimated (inverse fits).
    """

    force: float | None = None
    nominal_stress: float | None = None
    contact_jitter: float | None = 0.0
    zero_jitter: float | None = 0.0
    correlation_time: float | None = None
    modulus: float | None = None
    displacement: float | None = None


@dataclass(frozen=True)
class Campaign:
    """Content of a campaign file; the recordings are listed but not read.

    Attributes:
        path: path of the campaign file.
        name: stem of the file name.
        specimens: specimens by name.
        tests: tests, at least one of them not held out.
        fit: settings of the fit.
        noise: stated standard deviations of the measurement.
        sha256: SHA-256 of the campaign file.
        density: density, kg/m3, if the specimens of all fitted tests have the same; otherwise None.
        prisms: names of the specimens of which only cross-section and height are known.
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
        """Name of the campaign: name of the campaign file without its suffix."""
        return self.path.stem


def load_campaign(path: str | Path, *, planned: bool = False) -> Campaign:
    """Read and check a campaign file.

    Patterns of recordings are expanded and sorted; the recordings are not read.

    Args:
        path: path of the campaign file.
        planned: whether tests may have a protocol instead of recordings.

    Raises:
        InputError: the file is invalid; the error states the file and the dotted field.
    """
    path = Path(path)
    table, data, defaults = decode_campaign_tables_bytes_and_defaults(path)
    try:
        with located_and_converted_errors(file=path):
            if table.questions:
                first = table.questions[0].partition("?")[0]
                raise InputError(f"{first}? Import again with the flag that answers the question, or delete this key "
                                 "to accept the assumed values", field="questions")
            tests = _read_tests(table, specimens := read_specimens_by_name(table, path.parent), path.parent, planned)
            prisms = frozenset(key for key, each in zip(specimens, table.specimen, strict=True) if each.shape == PRISM)
            return Campaign(path, _freeze_mapping(specimens), tests, _read_fit_settings(table.fit, table.noise, tests),
                            _convert_noise_table_to_si(table.noise, table.fit.method), hashlib.sha256(data).hexdigest(),
                            _find_common_density_of_fitted_tests(tests), prisms)
    except InputError as error:
        raise defaults.make_error_with_file_and_field(error, path) from None


def _find_common_density_of_fitted_tests(tests: tuple[Test, ...]) -> float | None:
    """Return the density of all fitted specimens, kg/m3; None if unknown or if it differs between them."""
    fitted = {None if test.specimen is None else test.specimen.density for test in tests if not test.hold_out}
    return fitted.pop() if len(fitted) == 1 else None


def _read_tests(table: CampaignTable, specimens: Mapping[str, Specimen], root: Path, planned: bool) -> tuple[Test, ...]:
    """Check the tables ``[[test]]`` and return the tests with the paths of their recordings and their experiments."""
    if not table.test:
        raise InputError("test must contain at least one table; got none. Add a [[test]].", field="test")
    tests: dict[str, Test] = {}
    for i, entry in enumerate(table.test):
        field = f"test[{i}]"
        same_kind = sum(other.kind == entry.kind for other in table.test) > 1
        name = entry.name if entry.name is not None else f"{entry.kind}_{i + 1}" if same_kind else entry.kind
        if name in (*tests, *(test.table_name for test in tests.values())):
            raise InputError(f"names of tests must be unique; got {name!r} twice", field=f"{field}.name")
        if table.fit.method == "analytical":
            require_analytical_support_of_test_table(entry, field)
        elif entry.protocol is not None and not planned:
            raise InputError("protocol must be absent in a test with recordings, which uses the recorded motion. Leave "
                             "out the protocol.", field=f"{field}.protocol")
        require_positive_if_stated(entry.speed_mm_s, f"{field}.speed_mm_s", " mm/s")
        require_positive_if_stated(entry.max_strain, f"{field}.max_strain")
        kind = KINDS[entry.kind]
        if entry.max_strain is not None and kind.sign < 0 and entry.max_strain >= 1:
            raise InputError(f"max_strain must be below 1 in compression; got {entry.max_strain:g}",
                             field=f"{field}.max_strain")
        if not isinstance(entry.contact, str) and not np.isfinite(entry.contact):
            raise InputError(f"contact must be a displacement in mm, 'recorded' or 'find'; got {entry.contact}",
                             field=f"{field}.contact")
        if entry.skip_lines is not None and entry.skip_lines < 0:
            raise InputError(f"skip_lines must be at least 0; got {entry.skip_lines}", field=f"{field}.skip_lines")
        for key in ("skip_lines", "delimiter", "decimal"):
            if getattr(entry, key) and entry.columns is None:
                raise InputError(f"{key} requires columns; state the columns too, or leave {key} out",
                                 field=f"{field}.{key}")
        _require_valid_delimiter_and_decimal_mark(entry, field)
        columns = read_column_map_or_none(entry, field)
        moduli = list_moduli_of_table(entry, columns, table.fit.method, field)
        specimen = None if moduli else find_and_check_specimen_or_none(entry, specimens, table, field)
        first = Test(
            name, kind.select_load(0), specimen, () if entry.protocol is not None and not entry.recordings else
            find_recording_files(entry.recordings, root, f"{field}.recordings"),
            _make_reader_keyword_arguments(entry, columns), entry.max_strain,
            entry.hold_out, field, read_experiment_or_none_if_gripped(entry, specimen, root, field),
            read_rig_without_noise(entry, root, field),
            entry.contact if isinstance(entry.contact, str) else 1e-3 * entry.contact, entry.failure, entry.protocol,
            read_solver_name(entry, specimen, field), _read_left_out_sample_numbers(entry, f"{field}.leave_out"),
            entry.control, name)
        names = [f"{name} {load}" for load in kind.load_names] or [name]
        tests |= {each: replace(first, name=each, kind=kind.select_load(i)) for i, each in enumerate(names)}
        if moduli:
            strain = convert_pre_strain_to_abscissa(entry, kind, field)
            del tests[name]
            tests |= {f"{name} {each}": replace(first, name=f"{name} {each}", modulus=each, modulus_abscissa=strain)
                      for each in moduli}
        if kind.load_count > 1 and entry.contact != "recorded":
            raise InputError(f"contact must be 'recorded' in {entry.kind}, which has several loads; got "
                             f"{entry.contact!r}. Leave contact out", field=f"{field}.contact")
    if all(test.hold_out for test in tests.values()):
        raise InputError("at least one test must be fitted, but all are held out; set hold_out = false for one",
                         field="test[0].hold_out")
    return tuple(tests.values())


def _require_valid_delimiter_and_decimal_mark(entry: TestTable, field: str) -> None:
    """Raise an `InputError` if a test states an invalid delimiter or decimal mark of its recordings."""
    if not entry.delimiter and entry.decimal is None:
        return
    # Imported on use, see `read_column_map_or_none`.
    from tissue_sim.recording.formats.columns import validate_decimal_mark, validate_delimiter

    if entry.delimiter:
        validate_delimiter(entry.delimiter, f"{field}.delimiter")
    if entry.decimal is not None:
        validate_decimal_mark(entry.decimal, f"{field}.decimal")


def _read_left_out_sample_numbers(entry: TestTable, field: str) -> Mapping[str, tuple[int, ...]]:
    """Return recording -> sample numbers, from 1, that a test table leaves out; see `Test.leave_out`."""
    stated = entry.leave_out
    if isinstance(stated, str):
        return _freeze_mapping()
    by_name = stated if isinstance(stated, dict) else {"": stated}
    for name, samples in by_name.items():
        for number in samples:
            if number < 1:
                raise InputError(f"sample number must be at least 1; got {number}. Count the samples from 1.",
                                 field=f"{field}.{name}" if name else field)
    return _freeze_mapping({name: tuple(samples) for name, samples in by_name.items()})


def _make_reader_keyword_arguments(entry: TestTable, columns: Mapping[str, Any] | None) -> Mapping[str, Any]:
    """Return the keyword arguments of `tissue_sim.read_recordings` that a test table states, SI."""
    stated = {"columns": columns, "skip_lines": entry.skip_lines, "delimiter": entry.delimiter, "sheet": entry.sheet,
              "curve": entry.curve, "decimal": entry.decimal,
              "speed": None if entry.speed_mm_s is None else entry.speed_mm_s * 1e-3}
    known = {key: value for key, value in stated.items() if value is not None}
    return _freeze_mapping({"format": entry.format, **known})


def _read_fit_settings(table: FitTable, noise: NoiseTable, tests: tuple[Test, ...]) -> FitSettings:
    """Convert the table ``[fit]`` to SI units and check it."""
    if not table.laws:
        raise InputError(f"laws must list at least one law; known laws: {', '.join(LAWS)}", field="fit.laws")
    for i, name in enumerate(table.laws):
        law = LAWS.find(name, f"fit.laws[{i}]")
        if any(law is LAWS[other] for other in table.laws[:i]):
            raise InputError(f"{name} is listed twice", field=f"fit.laws[{i}]")
    for key in ("bulk_ratio", "offset_bounds_mm", "offset_prior_mm", "zero_bounds_N", "zero_prior_N"):
        require_positive_if_stated(getattr(table, key), f"fit.{key}")
    check_bulk_ratio(table.bulk_ratio)
    if table.strain_points is not None and table.strain_points < 5:
        raise InputError(f"strain_points must be at least 5; got {table.strain_points}", field="fit.strain_points")
    if table.starts is not None and not 1 <= table.starts <= MAX_STARTS:
        raise InputError(f"starts must be 1 to {MAX_STARTS}; got {table.starts}", field="fit.starts")
    reject_fit_and_noise_keys_without_effect(table, noise)
    check_values_finite_and_consistent(table)
    around = {test.name: get_experiment_and_rig_declarations_by_path(
        None if test.specimen is None else test.experiment, test.rig, test.readout)
        for test in tests}
    regions = {test.name: () if test.specimen is None else test.specimen.region_names for test in tests}
    named = resolve_campaign_parameters_by_name(table, around, regions)
    check_stated_bounds_and_completeness(table, named)
    for name, parameter in named.items():
        bare = [test.name for test in tests
                if test.specimen is None and not test.hold_out and test.name in parameter.tests]
        if parameter.scope == PER_SPECIMEN and bare:
            raise InputError(f"the scope 'per_specimen' requires a specimen in each test; {', '.join(bare)} has none. "
                             "Add a [[specimen]], or use the scope 'per_test'", field=f"fit.scope.{name}")
    if table.method == "analytical":
        require_analytical_support_of_fit_table(table, named)
    check_compressible_laws(table, named, [test.kind for test in tests])
    check_bulk_of_confined_tests(table, named, [test.kind for test in tests])
    if isinstance(noise.force_N, float | int) and all(test.states_stress for test in tests):
        raise InputError(f"must be left out, because no test has a force; got {noise.force_N:g} N. State "
                         "nominal_stress_Pa, the noise of the stress (in torsion at the rim, 2 M / (pi a^3))",
                         field="noise.force_N")
    by_path = {parameter.path: parameter for parameter in named.values()}
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
        laws=tuple(map(LAWS.get_name_of_alias, table.laws)),
        bulk=Bulk() if table.bulk_ratio is None else Bulk("bulk_ratio", table.bulk_ratio),
        offset=table.offset, offset_prior=offset_prior or OFFSET_DEFAULTS.contact_prior, offset_usual=usual,
        offset_bound=OFFSET_DEFAULTS.contact_bound if table.offset_bounds_mm is None else table.offset_bounds_mm * 1e-3,
        zero_bound=table.zero_bounds_N, zero_prior=zero_prior, strain_points=table.strain_points, method=table.method,
        starts=table.starts or DEFAULT_STARTS, named=_freeze_mapping(by_path), start=_freeze_mapping(start),
        fixed=_freeze_mapping(fixed), prior=_freeze_mapping(prior), bounds=_freeze_mapping(bounds),
        softening_form=table.softening_form, stable=read_stable_stretches(table))


def _convert_noise_table_to_si(table: NoiseTable, method: str) -> Noise:
    """Convert the table ``[noise]`` to SI units and check it."""
    for key in ("force_N", "nominal_stress_Pa", "modulus_relative", "displacement_mm"):
        value = getattr(table, key)
        require_positive_if_stated(None if value == "estimate" else value, f"noise.{key}")
    known: dict[str, float | None] = {}
    for key in ("contact_jitter_mm", "zero_jitter_N", "correlation_time_s"):
        value = getattr(table, key)
        if method == "analytical":
            if value == "estimate":
                raise InputError('"estimate" requires fit.method = "inverse_fem"; state a standard deviation, or leave '
                                 f"{key} out", field=f"noise.{key}")
            if key == "correlation_time_s" and value:
                raise InputError(f'correlated noise requires fit.method = "inverse_fem"; leave {key} out',
                                 field=f"noise.{key}")
            value = value or 0.0
        # None: an inverse fit estimates the value.
        known[key] = None if value in (None, "estimate") else float(value)
        if value not in (None, "estimate") and not (np.isfinite(value) and value >= 0):
            raise InputError(f"{key} must be at least 0 and finite; got {value:g}", field=f"noise.{key}")
    contact = known["contact_jitter_mm"]
    return Noise(force=None if table.force_N == "estimate" else table.force_N,
                 nominal_stress=None if table.nominal_stress_Pa == "estimate" else table.nominal_stress_Pa,
                 contact_jitter=None if contact is None else contact * 1e-3, zero_jitter=known["zero_jitter_N"],
                 correlation_time=known["correlation_time_s"],
                 modulus=None if table.modulus_relative == "estimate" else table.modulus_relative,
                 displacement=None if table.displacement_mm == "estimate" else 1e-3 * table.displacement_mm)
