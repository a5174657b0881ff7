"""Traps in the kind of test: less usual kinds and tests without a kind, with their own mechanics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.raw_files.drafts import Column, Draft
from benchmarks.raw_files.trap import PLAIN, Trap
from benchmarks.raw_files.truth import COMPRESSION, SHEAR, TENSION, Test, equibiaxial_stress, planar_stress

_GROUPS = frozenset({"title", "history", "names", "sizes", "blocks", "flags"})


@dataclass(frozen=True)
class _OtherTest:
    """Test other than tension, compression and simple shear.

    Attributes:
        titles: that name it. reasons: words of a refusal that is to the point. base: kind whose layout is used.
        force: test -> force, N, at its displacements. keeps_modulus: whether its modulus is that of `Test.mu`.
        sizes: test -> rows of sizes, mm. stress: whether it may be written as stress over stretch.
        wants_right: whether each title names a kind of the program, so that a modulus is wanted.
    """

    titles: tuple[str, ...]
    reasons: tuple[str, ...]
    base: str
    force: Callable[[Test], np.ndarray]
    keeps_modulus: bool
    sizes: Callable[[Test], list[list[str]]]
    stress: bool = False
    wants_right: bool = False


def _strip_sizes(test: Test) -> list[list[str]]:
    specimen = test.specimen
    return [["Width", f"{1e3 * specimen.width:.4g}", "mm"], ["Thickness", f"{1e3 * specimen.thickness:.4g}", "mm"],
            ["Gauge length", f"{1e3 * specimen.length:.4g}", "mm"]]


def _round_sizes(test: Test) -> list[list[str]]:
    return [["Diameter", f"{1e3 * test.specimen.diameter:.4g}", "mm"],
            ["Thickness", f"{1e3 * test.specimen.length:.4g}", "mm"]]


def _bending_sizes(test: Test) -> list[list[str]]:
    specimen = test.specimen
    return [["Width", f"{1e3 * specimen.width:.4g}", "mm"], ["Thickness", f"{1e3 * specimen.thickness:.4g}", "mm"],
            ["Span", f"{1e3 * specimen.length:.4g}", "mm"]]


def _bent(test: Test) -> np.ndarray:
    """Return the force of a simply supported Euler-Bernoulli beam loaded at midspan: F = 48 E I w / L^3, E = 3 mu."""
    specimen = test.specimen
    inertia = specimen.width * specimen.thickness**3 / 12
    return 48 * 3 * test.mu * inertia * test.motion / specimen.length**3


def _confined(test: Test) -> np.ndarray:
    """Return a linear force with the aggregate modulus H = 25 mu of a drained tissue."""
    return 25 * test.mu * test.specimen.area(COMPRESSION) * test.motion / test.specimen.length


def _peeled(test: Test) -> np.ndarray:
    """Return the force of a peel test: a short rise, then a plateau with waves."""
    plateau = test.mu * test.specimen.area(TENSION)
    return plateau * (1 - np.exp(-test.motion / 0.5e-3)) * (1 + 0.05 * np.sin(test.motion / 1e-3))


_OTHER_TESTS = {
    "planar tension": _OtherTest(
        ("Planar tension test", "Planar tension", "Pure shear test", "Pure shear (planar tension)",
         "Planarer Zugversuch", "Constrained tension"),
        ("planar", "pure shear", "constrained", "no such kind"), TENSION,
        lambda test: test.specimen.area(TENSION) * planar_stress(test.mu, test.stretch), True, _strip_sizes, True,
        True),
    "equibiaxial tension": _OtherTest(
        ("Equibiaxial tension", "Biaxial tensile test", "Equi-biaxial extension test", "Biaxialer Zugversuch",
         "Bulge inflation and biaxial tension"),
        ("biaxial", "bulge", "inflation", "no such kind"), TENSION,
        lambda test: test.specimen.area(TENSION) * equibiaxial_stress(test.mu, test.stretch), True, _strip_sizes, True),
    "confined compression": _OtherTest(
        ("Confined compression test", "Confined compression, porous platen", "Oedometer test, compression",
         "Compression in a confining chamber", "Druckversuch, seitlich eingeschlossen"),
        ("confine", "oedometer", "confining", "eingeschlossen", "no such kind"), COMPRESSION, _confined, False,
        _round_sizes),
    "three-point bending": _OtherTest(
        ("Three-point bending test", "3-point bend", "Flexural test", "Dreipunkt-Biegeversuch", "Flexion trois points"),
        ("bend", "flex", "biege", "no such kind"), TENSION, _bent, False, _bending_sizes),
    "peel": _OtherTest(("Peel test", "T-peel test, tension", "180 degree peel", "Schälversuch", "Peeling tensile test"),
                       ("peel", "schäl", "no such kind"), TENSION, _peeled, False, _strip_sizes),
    "tear": _OtherTest(("Tear test", "Trouser tear test, tension", "Weiterreißversuch"),
                       ("tear", "reiß", "no such kind"), TENSION, _peeled, False, _strip_sizes),
    "lap shear": _OtherTest(("Lap shear test", "Single lap shear of an adhesive joint", "Zugscherversuch"),
                            (r"\blap\b", "adhesive", "zugscher", "no such kind"), TENSION,
                            lambda test: 0.4 * test.elastic_force(test.motion), False, _strip_sizes),
}


def _on_test(other: _OtherTest):
    def apply(test: Test, rng: np.random.Generator) -> tuple[Test, tuple[float, ...]]:
        return replace(test, force=other.force(test)), (test.mu,) if other.keeps_modulus else ()
    return apply


def _on_draft(other: _OtherTest):
    def apply(draft: Draft, rng: np.random.Generator) -> None:
        title = str(rng.choice(other.titles))
        draft.stated_kind, draft.stated_sizes, draft.encoding = None, False, "utf-8"
        draft.sizes = [[name, number.replace(".", draft.decimal), unit] for name, number, unit in
                       other.sizes(draft.test)]
        start = [row for row in draft.head if row[0].startswith(("Bluehill", "Mecmesin"))]
        place = str(rng.choice(("first line", "method", "file name")))
        if place == "file name":
            draft.head, draft.name = start, f"{title.replace(' ', '_').replace(',', '')}_01.csv"
        else:
            draft.head = [*start, [title] if place == "first line" else ["Test method", title]]
        if other.stress and draft.layout == "table" and rng.random() < 0.4:
            stress = draft.test.nominal_stress / 1e3
            draft.tables[0].columns = [Column.of("strain", "Stretch", "-", draft.test.stretch, 6),
                                       Column.of("stress", "Nominal stress", "kPa", stress, 6)]
    return apply


def _torsion(draft: Draft, rng: np.random.Generator) -> None:
    """Return the torque over angle of a cylinder: T = mu J theta / L."""
    test, specimen = draft.test, draft.test.specimen
    title = str(rng.choice(("Torsion test", "Torsional shear of a cylinder", "Torsionsversuch")))
    draft.head, draft.stated_kind, draft.encoding, draft.truths = [[title]], None, "utf-8", (test.mu,)
    angle = test.motion / specimen.length
    torque = test.mu * np.pi * specimen.diameter**4 / 32 * angle / specimen.length
    time = draft.tables[0].column("time")
    draft.tables[0].columns = [time, Column.of("size", "Angle", "deg", np.degrees(angle), 6),
                               Column.of("size", "Torque", "N mm", 1e3 * torque, 6)]


def _moduli_table(draft: Draft, rng: np.random.Generator) -> None:
    """Replace the recording by storage and loss moduli over frequency or amplitude."""
    mu, size = draft.test.mu, 25
    draft.truths, draft.sizes, draft.stated_kind, draft.stated_sizes = (), [], None, False
    swept = np.geomspace(0.1, 30, size)
    amplitude = bool(rng.random() < 0.5)
    strain = swept if amplitude else np.full(size, 1.0)
    storage = mu * (1 / (1 + (swept / 20)**2) if amplitude else swept**0.1)
    stress = strain / 100 * storage * 1.02
    columns = [Column.of("size", "Frequency", "Hz", swept, 5)] * (not amplitude) + [
        Column.of("strain", "Oscillation strain", "%", strain, 5),
        Column.of("stress", "Storage modulus", "Pa", storage, 6),
        Column.of("stress", "Loss modulus", "Pa", 0.15 * storage, 6),
        Column.of("stress", "Oscillation stress", "Pa", stress, 6)]
    draft.head = [["Amplitude sweep, 1 Hz" if amplitude else "Frequency sweep, strain 1 %"]]
    draft.tables[0].columns = columns
    if rng.random() < 0.4:
        draft.stated_kind = SHEAR


#: A file whose title names no kind of the program leaves the kind open.
_OPEN = "the kind of test"
KIND_TRAPS = (
    *(Trap(name, "meaning", _GROUPS, (*other.reasons, _OPEN), other.wants_right, on_test=_on_test(other),
           on_draft=_on_draft(other), kinds=(other.base,), layouts=PLAIN) for name, other in _OTHER_TESTS.items()),
    Trap("torsion", "meaning", _GROUPS | {"numbers"}, ("torsion", "torque", "angle", "no such kind"), True,
         on_draft=_torsion, kinds=(COMPRESSION,), layouts=("table",)),
    Trap("sweep of frequency or amplitude", "meaning", _GROUPS | {"numbers", "defect", "air"},
         ("sweep", "frequency", "amplitude", "oscillat", "moduli"), False, on_draft=_moduli_table,
         kinds=(SHEAR,), layouts=("table",)),
)
