"""Resolve the parameter names in ``[fit]`` of a campaign; default priors and bounds of contact offsets and zeros."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.campaign.schema import BY_PARAMETER, FitTable
from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.laws import LAWS
from tissue_sim.material.material import (
    Material,
    find_parameter_path_and_declaration,
    find_region_name_or_none,
    get_law_parameter_declaration,
    make_material_from_numbers,
)
from tissue_sim.parameters import Declaration, parameters
from tissue_sim.rig.modulus_readout import ModulusReadout
from tissue_sim.rig.rig import Rig


@dataclass(frozen=True)
class OffsetDefaults:
    """Default priors and bounds of contact offsets and force zeros.

    A larger prior lets an offset explain more of a misfit, which increases the standard errors of the moduli. A
    smaller prior makes the moduli depend on the recorded contact.

    Attributes:
        contact_prior: standard deviation of the prior of a contact offset, m; reduced for tests with small
            displacements.
        contact_bound: half width of the bounds of a contact offset in an analytical fit, m; reduced in the same way.
        contact_fraction: largest standard deviation of a contact offset, as a fraction of the displacement of a test.
        strain_fraction: standard deviation of a contact offset, as a fraction of the strain of a test recorded as
            strain.
        zero_prior: standard deviation of the prior of a zero, in units of the noise of the force.
        zero_bound: half width of the bounds of a zero in an analytical fit, in standard deviations of its prior.
        first_zero: first value of the zero's standard deviation in an inverse fit, as a fraction of the largest force;
            it is kept if no test has two recordings.
    """

    contact_prior: float = 0.05e-3
    contact_bound: float = 0.5e-3
    contact_fraction: float = 0.02
    strain_fraction: float = 0.005
    zero_prior: float = 5.0
    zero_bound: float = 10.0
    first_zero: float = 0.002


OFFSET_DEFAULTS = OffsetDefaults()


#: Scope with one value for all tests that have the parameter.
SHARED = "shared"
#: Scope with one value for each specimen.
PER_SPECIMEN = "per_specimen"
#: Scope with one value for each test.
PER_TEST = "per_test"
#: Scope with one value for each recording.
PER_REPLICATE = "per_replicate"
#: All named scopes.
SCOPES = (SHARED, PER_SPECIMEN, PER_TEST, PER_REPLICATE)
#: Prefixes of paths that do not belong to the material.
NON_MATERIAL_PREFIXES = ("experiment.", "rig.", "readout.")


@dataclass(frozen=True)
class ScopedCampaignParameter:
    """Parameter that ``[fit]`` of a campaign names, with its scope.

    Attributes:
        path: path in `tissue_sim.parameters` without ``material.``, or the name of a parameter of the law.
        declaration: unit, bounds and symbol of the parameter.
        is_law_parameter: whether it is a parameter of the law.
        scope: one of `SCOPES`, or the names of the tests that share the value.
        tests: names of the tests whose model has the parameter.
    """

    path: str
    declaration: Declaration
    is_law_parameter: bool
    scope: str | tuple[str, ...]
    tests: tuple[str, ...]

    @property
    def is_material_parameter(self) -> bool:
        """Whether the parameter belongs to the material, including its law."""
        return not self.path.startswith(NON_MATERIAL_PREFIXES)


def get_experiment_and_rig_declarations_by_path(experiment: Experiment | None, rig: Rig,
                                                readout: ModulusReadout | None = None) -> dict[str, Declaration]:
    """Return path -> declaration of the parameters of an experiment and a rig, or of the readout of moduli."""
    parts: tuple[tuple[str, object], ...] = (("experiment", experiment), ("rig", rig)) if experiment is not None else ()
    if readout is not None:
        parts = (("readout", readout),)
    return {f"{part}.{path}": each.declaration for part, whole in parts for path, each in parameters(whole).items()}


def build_placeholder_material_with_effects(values: Mapping[str, float],
                                            named: Mapping[str, ScopedCampaignParameter]) -> Material:
    """Return a neo-Hookean placeholder material with the effects that these values (SI) define.

    The material shows whether the tissue has memory or layers; its modulus has no meaning.

    Raises:
        InputError: a part is incomplete or its values are invalid.
    """
    others = {name: value for name, value in values.items()
              if name in named and named[name].is_material_parameter and not named[name].is_law_parameter}
    return make_material_from_numbers("neo_hooke", {"C10": 1.0}, others)


def resolve_campaign_parameters_by_name(table: FitTable, around: Mapping[str, Mapping[str, Declaration]],
                                        regions: Mapping[str, Collection[str]]) -> dict[str, ScopedCampaignParameter]:
    """Find the parameter for each name in start, fixed, prior, bounds and scope of ``[fit]``.

    Args:
        table: table ``[fit]`` of the campaign.
        around: parameters of experiment and rig of each test, see `get_experiment_and_rig_declarations_by_path`.
        regions: names of the regions of the specimen of each test.

    Returns:
        The parameter for each name in the file.

    Raises:
        InputError: no model has the parameter, or its scope is ambiguous; the error states the field.
    """
    laws = {parameter: get_law_parameter_declaration(LAWS[law], parameter) for law in table.laws
            for parameter in LAWS[law].parameters}
    named: dict[str, ScopedCampaignParameter] = {}
    for key in (*BY_PARAMETER, "scope"):
        for name in getattr(table, key):
            if name not in named:
                named[name] = _resolve_campaign_parameter(name, f"fit.{key}.{name}", laws, around, regions, table)
    paths: dict[str, str] = {}
    for name, parameter in named.items():
        if paths.setdefault(parameter.path, name) != name:
            raise InputError(f"parameter must be named once; {name!r} is the same parameter as "
                             f"{paths[parameter.path]!r}. Keep one of the names.", field=f"fit.start.{name}")
    return named


def _resolve_campaign_parameter(name: str, field: str, laws: Mapping[str, Declaration],
                                around: Mapping[str, Mapping[str, Declaration]], regions: Mapping[str, Collection[str]],
                                table: FitTable) -> ScopedCampaignParameter:
    """Return the parameter with a name in the campaign file, with its path, scope and tests."""
    scope = table.scope.get(name)
    everywhere = tuple(around)
    path = name.removeprefix("material.")
    if path in laws:
        return ScopedCampaignParameter(path, laws[path], True, _read_scope(name, scope, everywhere, SHARED), everywhere)
    if path.startswith(NON_MATERIAL_PREFIXES):
        own = {test: found for test, known in around.items()
               if (found := _find_path_by_file_key_or_none(path, known)) is not None}
        if not own:
            known = sorted({path for each in around.values() for path in each})
            raise InputError(
                f"no test has a parameter {name!r} that is a number"
                f"{make_hint_with_similar_or_known_words(name, known)}",
                field=field)
        first = next(iter(own))
        return ScopedCampaignParameter(own[first], around[first][own[first]], False,
                                       _read_scope(name, scope, tuple(own),
                                                   SHARED if path.startswith("readout.") else None),
                                       tuple(own))
    if "." not in path:
        hint = (make_hint_with_similar_or_known_words(name, laws)
                + '; write other parameters as paths in quotes, such as "viscoelastic.terms[0].g"')
        raise InputError(f"none of the listed laws has a parameter {name!r}{hint}", field=field)
    try:
        full, declaration = find_parameter_path_and_declaration(path)
    except InputError as error:
        raise InputError(error.problem, field=field) from None
    if (region := find_region_name_or_none(full)) is not None:
        having = tuple(test for test, found in regions.items() if region in found)
        if not having:
            known = list(dict.fromkeys(each for found in regions.values() for each in found))
            hint = make_hint_with_similar_or_known_words(region, known) if known \
                else "; the mesh of a specimen names its regions"
            raise InputError(f"no specimen has a region {region!r}{hint}", field=field)
        # Tests of homogeneous specimens do not have the region: the shared value applies to the other tests only.
        where = _read_scope(name, scope, having, SHARED)
        return ScopedCampaignParameter(full, declaration, False, having if where == SHARED else where, having)
    return ScopedCampaignParameter(full, declaration, False, _read_scope(name, scope, everywhere, SHARED), everywhere)


def _find_path_by_file_key_or_none(path: str, known: Mapping[str, Declaration]) -> str | None:
    """Return the known path that equals this path, or whose file key equals its last part; None without a match."""
    if path in known:
        return path
    parent, _, last = path.rpartition(".")
    return next((full for full, each in known.items() if full.rpartition(".")[0] == parent and each.key == last), None)


def _read_scope(name: str, stated: str | list[str] | None, tests: Sequence[str],
                default: str | None) -> str | tuple[str, ...]:
    """Return the scope of a parameter: a keyword, or the tests that share the value."""
    if stated is None:
        if default is None and len(tests) > 1:
            raise InputError(f"{len(tests)} tests have this parameter ({', '.join(tests)}); state in [fit.scope] one "
                             f"of {', '.join(map(repr, SCOPES))}, or list the tests that share the value",
                             field=f"fit.scope.{name}")
        return default or SHARED
    if isinstance(stated, str):
        if stated not in SCOPES:
            raise InputError(f"scope must be one of {', '.join(map(repr, SCOPES))}, or a list of tests; got "
                             f"{stated!r}{make_hint_with_similar_or_known_words(stated, SCOPES)}",
                             field=f"fit.scope.{name}")
        return stated
    for test in stated:
        if test not in tests:
            raise InputError(f"no test {test!r} has this parameter{make_hint_with_similar_or_known_words(test, tests)}",
                             field=f"fit.scope.{name}")
    return tuple(stated)


def check_stated_bounds_and_completeness(table: FitTable, named: Mapping[str, ScopedCampaignParameter]) -> None:
    """Require stated values within their bounds, and complete effects of the material (all parameters stated).

    Raises:
        InputError: a value is outside its bounds or a part is incomplete; the error states the field.
    """
    stated = {**table.start, **table.fixed}
    for key in ("prior", "bounds"):
        for name in getattr(table, key):
            if not named[name].is_law_parameter and named[name].is_material_parameter and name not in stated:
                raise InputError(f"{name} requires a value in fit.start or fit.fixed, which defines the part of the "
                                 "material", field=f"fit.{key}.{name}")
    for name, value in stated.items():
        declaration = named[name].declaration
        # The law checks its own parameters.
        widest = (-np.inf, np.inf) if named[name].is_law_parameter \
            else tuple(end / declaration.factor for end in declaration.bounds)
        low, high = table.bounds.get(name, widest)
        if low < widest[0] - 1e-12 * abs(widest[0]) or high > widest[1] + 1e-12 * abs(widest[1]):
            raise InputError(f"bounds must be within [{widest[0]:g}, {widest[1]:g}]; got [{low:g}, {high:g}]",
                             field=f"fit.bounds.{name}")
        if not low <= value <= high:
            field = "start" if name in table.start else "fixed"
            raise InputError(f"{field} must be within its bounds [{low:g}, {high:g}]; got {value:g}",
                             field=f"fit.{field}.{name}")
    bulk = [name for name in stated if named[name].path.startswith("bulk.")]
    if bulk and (table.bulk_ratio is not None or len(bulk) > 1):
        other = "fit.bulk_ratio" if table.bulk_ratio is not None else bulk[0]
        raise InputError(f"{bulk[-1]} and {other} both state the bulk response; keep one of them",
                         field=f"fit.{'start' if bulk[-1] in table.start else 'fixed'}.{bulk[-1]}")
    try:
        build_placeholder_material_with_effects({name: value * named[name].declaration.factor for name,
                                                 value in stated.items()}, named)
    except InputError as error:
        # A missing parameter is reported in fit.start, where the other parameters of the part are.
        field = f"fit.start.{_format_parameter_path_with_file_key(error.field or '')}".replace(".[", "[")
        raise InputError(error.problem.replace("add it", "add it to fit.start or fit.fixed"), field=field) from None


def _format_parameter_path_with_file_key(path: str) -> str:
    """Return a parameter path whose last part is the key used in files; unchanged for an unknown path."""
    try:
        full, declaration = find_parameter_path_and_declaration(path)
    except InputError:
        return path
    return f"{full.rpartition('.')[0]}.{declaration.key}"
