"""Parameters of the model as a campaign names them in ``[fit]``.

Those of a law go by their names, all others by the path of `tissue_sim.parameters`; ``material.`` may be left out, and
the last part may be the key of a file: ``viscoelastic.terms[0].tau_s``. Numbers in the file are in the unit of that
key (mm, mm/N, degrees); inside everything is SI, under the path of the attribute.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.campaign.schema import BY_PARAMETER, FitTable
from tissue_sim.errors import InputError, nearest
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.laws import LAWS
from tissue_sim.material.material import Material, law_declaration
from tissue_sim.material.parts import find_declaration, make_material, region_of
from tissue_sim.parameters import Declaration, parameters
from tissue_sim.rig.rig import Rig

#: What a scope says in words: one value for all tests that have the parameter, or one for each specimen, test or
#: recording.
SHARED, PER_SPECIMEN, PER_TEST, PER_REPLICATE = "shared", "per_specimen", "per_test", "per_replicate"
SCOPES = (SHARED, PER_SPECIMEN, PER_TEST, PER_REPLICATE)
#: How paths begin that are no part of the material.
_AROUND = ("experiment.", "rig.")


@dataclass(frozen=True)
class Named:
    """A parameter that a campaign names.

    Attributes:
        path: of `tissue_sim.parameters`, without ``material.``; the name of the law's parameter.
        declaration: what it is.
        of_law: whether it is one of the law's.
        scope: one of `SCOPES`, or names of the tests that share it.
        tests: names of the tests whose model has it.
    """

    path: str
    declaration: Declaration
    of_law: bool
    scope: str | tuple[str, ...]
    tests: tuple[str, ...]

    @property
    def of_material(self) -> bool:
        """Whether it belongs to the material, its law's included."""
        return not self.path.startswith(_AROUND)


def declared_around(experiment: Experiment | None, rig: Rig) -> dict[str, Declaration]:
    """Path in the model -> what it is, of what a test has beside the material; nothing of one that knows no tool."""
    if experiment is None:
        return {}
    return {f"{part}.{path}": each.declaration for part, whole in (("experiment", experiment), ("rig", rig))
            for path, each in parameters(whole).items()}


def stated_material(values: Mapping[str, float], named: Mapping[str, Named]) -> Material:
    """A material with the parts that these numbers make, SI, of whatever law: to ask whether it ages, or has layers.

    Raises:
        InputError: an incomplete part, or numbers that it refuses.
    """
    others = {name: value for name, value in values.items()
              if name in named and named[name].of_material and not named[name].of_law}
    return make_material("neo_hooke", {"C10": 1.0}, others)


def find_named(table: FitTable, around: Mapping[str, Mapping[str, Declaration]],
               regions: Mapping[str, Collection[str]]) -> dict[str, Named]:
    """Name in the file -> what it names, of everything in start, fixed, prior, bounds and scope.

    Args:
        table: of the file. around: test -> what its model has beside the material, see `declared_around`.
        regions: test -> names of the regions that its specimen has.

    Raises:
        InputError: a name that no model has, or whose scope is not clear; with the field.
    """
    laws = {parameter: law_declaration(LAWS[law], parameter) for law in table.laws
            for parameter in LAWS[law].parameters}
    named: dict[str, Named] = {}
    for key in (*BY_PARAMETER, "scope"):
        for name in getattr(table, key):
            if name not in named:
                named[name] = _named(name, f"fit.{key}.{name}", laws, around, regions, table)
    paths: dict[str, str] = {}
    for name, what in named.items():
        if paths.setdefault(what.path, name) != name:
            raise InputError(f"is the same parameter as {paths[what.path]!r}; name it once", field=f"fit.start.{name}")
    return named


def _named(name: str, field: str, laws: Mapping[str, Declaration], around: Mapping[str, Mapping[str, Declaration]],
           regions: Mapping[str, Collection[str]], table: FitTable) -> Named:
    scope = table.scope.get(name)
    everywhere = tuple(around)
    path = name.removeprefix("material.")
    if path in laws:
        return Named(path, laws[path], True, _scope(name, scope, everywhere, SHARED), everywhere)
    if path.startswith(_AROUND):
        own = {test: found for test, known in around.items() if (found := _find(path, known)) is not None}
        if not own:
            known = sorted({path for each in around.values() for path in each})
            raise InputError(f"no test has a parameter {name!r} that is a number{nearest(name, known)}", field=field)
        first = next(iter(own))
        return Named(own[first], around[first][own[first]], False, _scope(name, scope, tuple(own), None), tuple(own))
    if "." not in path:
        hint = nearest(name, laws) + '; other parameters of the model are paths in quotes, "viscoelastic.terms[0].g"'
        raise InputError(f"none of the listed laws has a parameter {name!r}{hint}", field=field)
    try:
        full, declaration = find_declaration(path)
    except InputError as error:
        raise InputError(error.problem, field=field) from None
    if (region := region_of(full)) is not None:
        having = tuple(test for test, found in regions.items() if region in found)
        if not having:
            known = list(dict.fromkeys(each for found in regions.values() for each in found))
            hint = nearest(region, known) if known else "; the mesh of a specimen names its regions"
            raise InputError(f"no specimen has a region {region!r}{hint}", field=field)
        # What is one material everywhere else, such as a sample of it, knows nothing of the region.
        where = _scope(name, scope, having, SHARED)
        return Named(full, declaration, False, having if where == SHARED else where, having)
    return Named(full, declaration, False, _scope(name, scope, everywhere, SHARED), everywhere)


def _find(path: str, known: Mapping[str, Declaration]) -> str | None:
    """The known path that is this one, or whose last part files write like this."""
    if path in known:
        return path
    place, _, last = path.rpartition(".")
    return next((full for full, each in known.items() if full.rpartition(".")[0] == place and each.key == last), None)


def _scope(name: str, stated: str | list[str] | None, tests: Sequence[str],
           default: str | None) -> str | tuple[str, ...]:
    if stated is None:
        if default is None and len(tests) > 1:
            raise InputError(f"{len(tests)} tests have it ({', '.join(tests)}): say in [fit.scope] whether it is "
                             f"{', '.join(map(repr, SCOPES))}, or name the tests that share it",
                             field=f"fit.scope.{name}")
        return default or SHARED
    if isinstance(stated, str):
        if stated not in SCOPES:
            raise InputError(f"unknown scope {stated!r}{nearest(stated, SCOPES)}", field=f"fit.scope.{name}")
        return stated
    for test in stated:
        if test not in tests:
            raise InputError(f"no test {test!r} has it{nearest(test, tests)}", field=f"fit.scope.{name}")
    return tuple(stated)


def check_values(table: FitTable, named: Mapping[str, Named]) -> None:
    """Refuse numbers outside what a model may have, and parts of a material that are incomplete; with the field.

    Raises:
        InputError: as said.
    """
    stated = {**table.start, **table.fixed}
    for key in ("prior", "bounds"):
        for name in getattr(table, key):
            if not named[name].of_law and named[name].of_material and name not in stated:
                raise InputError(f"give {name} a start too (or fix it), so that the material has it",
                                 field=f"fit.{key}.{name}")
    for name, value in stated.items():
        what = named[name].declaration
        # A law itself says what it takes.
        widest = (-np.inf, np.inf) if named[name].of_law else tuple(end / what.factor for end in what.bounds)
        low, high = table.bounds.get(name, widest)
        if low < widest[0] - 1e-12 * abs(widest[0]) or high > widest[1] + 1e-12 * abs(widest[1]):
            raise InputError(f"[{low:g}, {high:g}] is wider than what a model may have; give bounds within "
                             f"[{widest[0]:g}, {widest[1]:g}]", field=f"fit.bounds.{name}")
        if not low <= value <= high:
            field = "start" if name in table.start else "fixed"
            raise InputError(f"{value:g} is outside its bounds [{low:g}, {high:g}]", field=f"fit.{field}.{name}")
    bulk = [name for name in stated if named[name].path.startswith("bulk.")]
    if bulk and (table.bulk_ratio is not None or len(bulk) > 1):
        other = "fit.bulk_ratio" if table.bulk_ratio is not None else bulk[0]
        raise InputError(f"{bulk[-1]} and {other} both state the bulk response; keep one of them",
                         field=f"fit.{'start' if bulk[-1] in table.start else 'fixed'}.{bulk[-1]}")
    try:
        stated_material({name: value * named[name].declaration.factor for name, value in stated.items()}, named)
    except InputError as error:
        # Incomplete parts are missed where the others stand.
        place = f"fit.start.{_in_file(error.field or '')}".replace(".[", "[")
        raise InputError(error.problem.replace("add it", "add it to fit.start or fit.fixed"), field=place) from None


def _in_file(path: str) -> str:
    """The path as files write it."""
    try:
        full, declaration = find_declaration(path)
    except InputError:
        return path
    return f"{full.rpartition('.')[0]}.{declaration.key}"
