"""Strain-energy laws: base classes, and everything that is derived from the energy.

A law states its energy once, as a Python expression that works on symbols. Sympy differentiates it, so that the closed
forms, the derivatives with respect to parameters, the moduli, the stability check, the printed formula and the compiled
functions of the finite elements all belong to the same formula.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.laws.derivation import load_or_derive_function, load_or_format_text
from tissue_sim.laws.domain import list_domain_conditions
from tissue_sim.laws.modes import STRETCH_MODES
from tissue_sim.public_names import LazyModule, rename_old_members_of_subclass, with_old_names

if TYPE_CHECKING:
    import sympy as sp
else:
    sp = LazyModule("sympy")


@dataclass(frozen=True)
class KernelEnergy:
    """Symbolic energy from which the kernels of the finite elements are compiled.

    Laws with the same `key` share one compiled kernel and differ in their coefficients only.

    Attributes:
        key: name of the compiled kernel.
        family: ``"invariants"`` (energy of I1, I2), ``"stretches"`` (energy of one isochoric stretch, summed over
            three) or ``"stretches and volume"`` (energy of one full stretch and J, summed over three).
        variables: symbols of the family: (I1, I2), (stretch,) or (stretch, J).
        coefficients: symbols of the coefficients.
        energy: the symbolic energy.
    """

    key: str
    family: str
    variables: tuple[sp.Symbol, ...]
    coefficients: tuple[sp.Symbol, ...]
    energy: sp.Expr

    @property
    def coefficient_count(self) -> int:
        """Number of coefficients of the energy."""
        return len(self.coefficients)

    @cached_property
    def domain_conditions(self) -> tuple[sp.Expr, ...]:
        """Expressions that are positive inside the domain of the energy; see `list_domain_conditions`."""
        rest = 3 if self.family == "invariants" else 1
        return list_domain_conditions(self.energy, dict.fromkeys(self.variables, rest), includes_overflow=True)

    @property
    def cache_key(self) -> tuple | None:
        """Key of derived functions in the cache, see `load_or_derive_function`; None: not cached."""
        return None


#: Exponents (i, j) of the monomials (I1-3)^i (I2-3)^j in the kernel that polynomial laws share.
POWERS = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))


def make_invariant_symbols() -> tuple[sp.Symbol, ...]:
    """Return the symbols I1 and I2."""
    return tuple(sp.symbols("I1 I2", positive=True))


class _PolynomialKernelEnergy(KernelEnergy):
    """Energy of the kernel that polynomial laws share; the symbols are made on demand, since sympy imports slowly."""

    def __init__(self):
        object.__setattr__(self, "key", "polynomial")
        object.__setattr__(self, "family", "invariants")

    def __eq__(self, other):
        return isinstance(other, _PolynomialKernelEnergy)

    def __hash__(self):
        return hash(self.key)

    @cached_property
    def variables(self) -> tuple[sp.Symbol, ...]:
        return make_invariant_symbols()

    @cached_property
    def coefficients(self) -> tuple[sp.Symbol, ...]:
        return tuple(sp.Symbol(f"C{i}{j}", real=True) for i, j in POWERS)

    @cached_property
    def energy(self) -> sp.Expr:
        I1, I2 = self.variables
        return sum(c * (I1 - 3)**i * (I2 - 3)**j for c, (i, j) in zip(self.coefficients, POWERS, strict=True))

    @property
    def coefficient_count(self) -> int:
        return len(POWERS)

    @property
    def domain_conditions(self) -> tuple[sp.Expr, ...]:
        return ()

    @property
    def cache_key(self) -> tuple | None:
        return (self.key,)


#: Energy of the kernel that polynomial laws share.
POLYNOMIAL_KERNEL_ENERGY = _PolynomialKernelEnergy()


@dataclass(frozen=True)
class ParameterRange:
    """Range of a dimensionless parameter in a fit.

    Attributes:
        low: lower bound, 1.
        high: upper bound, 1.
        starts: values from which fits start, 1.
    """

    low: float
    high: float
    starts: tuple[float, ...]


def compute_first_invariant(abscissa, mode: str) -> np.ndarray:
    """Return I1 of a homogeneous deformation, shape of `abscissa`: a stretch, or gamma in ``"simple_shear"``."""
    abscissa = np.asarray(abscissa, dtype=float)
    if mode == "simple_shear":
        return 3.0 + abscissa**2
    return np.sum(STRETCH_MODES[mode].compute_principal_stretches(abscissa)**2, axis=-1)


#: Members that laws of plug-ins may still define by their old names: old name -> new name.
_OLD_MEMBERS = {"as_array": "convert_parameters_to_array", "as_mapping": "convert_parameters_to_mapping",
                "nominal_stress_derivatives": "nominal_stress_parameter_derivatives",
                "describe_parameters_at_limit": "describe_limiting_cases"}


@with_old_names(**_OLD_MEMBERS)
class Law:
    """Strain-energy density W, Pa, of an incompressible solid, or the isochoric part of a nearly incompressible one.

    A subclass defines `name`, `title`, `units` (parameter -> unit) and its energy; see `InvariantLaw` and `StretchLaw`.
    Parameters are a mapping name -> value in SI, or an array in the order of `parameters`.

    The domain of a law is the set of deformations at which its formula is defined; it follows from the formula (see
    `list_domain_conditions`). Outside the domain stresses are NaN, and a step of the finite elements is shortened.

    Attributes:
        parameter_bounds: name -> smallest and largest value of a parameter in a material, SI; parameters without an
            entry may have any value.
        is_compressible: whether the law states the volumetric response as well, see `CompressibleLaw`. Such a material
            has no other bulk response.
    """

    name: str
    title: str
    units: Mapping[str, str]
    parameter_bounds: Mapping[str, tuple[float, float]] = MappingProxyType({})
    is_compressible: bool = False

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        rename_old_members_of_subclass(cls, _OLD_MEMBERS)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters in order."""
        return tuple(self.units)

    @cached_property
    def symbols(self) -> tuple[sp.Symbol, ...]:
        """Symbols of the parameters in order."""
        return tuple(sp.Symbol(name, real=True) for name in self.parameters)

    def energy_of_stretches(self, l1, l2, l3, parameters) -> sp.Expr:
        """Return W, Pa, as an expression of three principal stretches with l1 l2 l3 = 1 (symbols or numbers)."""
        raise TypeError(f"{type(self).__name__} must derive from InvariantLaw or StretchLaw")

    def list_domain_conditions_of_stretches(self, l1, l2, l3) -> list[sp.Expr]:
        """Return expressions of three principal stretches that are positive inside the domain; none: no limit."""
        raise TypeError(f"{type(self).__name__} must derive from InvariantLaw or StretchLaw")

    def compute_fit_ranges(self, largest_strain: float) -> Mapping[str, ParameterRange]:
        """Return name -> range of dimensionless parameters in a fit; the others have exponents as starts.

        Args:
            largest_strain: largest I1 - 3 of the data.
        """
        return {}

    @property
    def cache_key(self) -> tuple | None:
        """Key of derived functions in the cache, see `load_or_derive_function`; None for a law of another package."""
        kind = type(self)
        return (kind.__name__, self.name) if kind.__module__.startswith("tissue_sim.laws.") else None

    def compile_cached_function(self, what: str, derive):
        """Return the compiled function of the formula that `derive` returns, from the cache under the name `what`."""
        return load_or_derive_function(derive, cache_key=None if self.cache_key is None else (*self.cache_key, what))

    @property
    def kernel_energy(self) -> KernelEnergy:
        """Symbolic energy from which the kernels are compiled."""
        raise TypeError(f"{type(self).__name__} must derive from InvariantLaw or StretchLaw")

    def kernel_coefficients(self, values) -> np.ndarray:
        """Return the values of the coefficients of `kernel_energy` for parameters, shape (number of coefficients,)."""
        return self.convert_parameters_to_array(values)

    def convert_parameters_to_array(self, values) -> np.ndarray:
        """Convert parameters to an array in the order of `parameters`, SI, shape (m,).

        Raises:
            InputError: a missing or unknown name, or a value that is not finite.

        Examples:
            >>> from tissue_sim.laws import find_law
            >>> find_law("mooney_rivlin").convert_parameters_to_array({"C01": 200.0, "C10": 1000.0})
            array([1000.,  200.])
        """
        if isinstance(values, Mapping):
            for name in values:
                if name not in self.units:
                    hint = make_hint_with_similar_or_known_words(name, self.parameters)
                    raise InputError(f"law {self.name} has no parameter {name!r}{hint}", field=f"parameters.{name}")
            for name in self.parameters:
                if name not in values:
                    raise InputError(f"law {self.name} needs {', '.join(self.parameters)}; {name} is missing. State "
                                     "its value", field=f"parameters.{name}")
            values = [values[name] for name in self.parameters]
        array = np.asarray(values, dtype=float)
        if array.shape != (len(self.parameters),):
            raise InputError(f"must be {len(self.parameters)} numbers for law {self.name}; got shape {array.shape}. "
                             f"Give {', '.join(self.parameters)} in this order, or by name", field="parameters")
        for name, value in zip(self.parameters, array, strict=True):
            if not np.isfinite(value):
                raise InputError(f"must be finite; got {value}. State a number in SI units", field=f"parameters.{name}")
        return array

    def require_values_within_bounds(self, values: Mapping[str, float]) -> None:
        """Raise an error if a parameter is outside `parameter_bounds`; values by name, SI.

        Raises:
            InputError: a value outside its bounds.
        """
        for name, (low, high) in self.parameter_bounds.items():
            if not low <= values[name] <= high:
                raise InputError(f"must be within [{low:g}, {high:g}]; got {values[name]:g}. Check the unit, or use "
                                 "another law", field=f"parameters.{name}")

    def describe_limiting_cases(self, values) -> list[str]:
        """Return a sentence for each parameter at a limit, where the formula takes another form; none by default."""
        return []

    def convert_parameters_to_mapping(self, values) -> dict[str, float]:
        """Convert parameters to name -> value, without replacements of values at which the formula has a limit."""
        return dict(zip(self.parameters, Law.convert_parameters_to_array(self, values).tolist(), strict=True))

    def _evaluate_stress_slope_and_derivatives(self, mode, stretch, values) -> np.ndarray:
        """Return stress, its slopes and its parameter derivatives for each load, shape (*points, loads, 1 + k + m).

        The last axis has the stress, the derivatives with respect to the k stretches, and those with respect to the m
        parameters. `stretch` has the shape (*points) for k = 1, and (*points, k) otherwise.
        """
        stretch, count = np.asarray(stretch, dtype=float), _count_stretches(mode)
        parts = (stretch,) if count == 1 else tuple(np.moveaxis(stretch, -1, 0))
        if len(parts) != count:
            raise InputError(f"must have {count} values at each point; got {len(parts)}. Give an array whose last axis "
                             f"has length {count}", field="stretch")
        items = _evaluate_inside_domain(_compile_mode_stress_function(self, mode),
                                        count * (1 + count + len(self.parameters)), parts[0].shape, *parts,
                                        *self.convert_parameters_to_array(values))
        return np.stack(items, axis=-1).reshape(*parts[0].shape, count, -1)

    def compute_principal_stretches(self, stretch, values, mode: str = "uniaxial") -> np.ndarray:
        """Return the principal stretches of a homogeneous test, shape (..., 3).

        Args:
            stretch: prescribed stretch, shape (...); two of them: shape (..., 2).
            values: parameters, SI.
            mode: ``uniaxial``, ``planar``, ``equibiaxial`` or ``biaxial``.
        """
        return STRETCH_MODES[mode].compute_principal_stretches(stretch)

    def nominal_stress(self, stretch, values, mode: str = "uniaxial") -> np.ndarray:
        """First Piola-Kirchhoff stress of an incompressible solid, Pa, negative in compression.

        Args:
            stretch: any shape; the shear strain gamma for ``mode="simple_shear"``; for ``mode="biaxial"`` both
                stretches, shape (..., 2).
            values: parameters, SI.
            mode: ``uniaxial`` (equations 4 to 7 of the reference study), ``planar``, ``equibiaxial``, ``biaxial``,
                ``simple_shear``.

        Returns:
            The shape of `stretch`; in the mode ``biaxial`` the stresses along both axes. NaN or infinite outside the
            domain of the law.

        Source: P = dW/dlambda along the mode (Holzapfel, Nonlinear Solid Mechanics, 2000, section 6.5).

        Examples:
            >>> from tissue_sim.laws import find_law
            >>> find_law("neo_hooke").nominal_stress([0.9, 1.0, 1.1], {"C10": 1000.0}).round(1)
            array([-669.1,    0. ,  547.1])
            >>> find_law("neo_hooke").nominal_stress([1.1, 1.0], {"C10": 1000.0}, "biaxial").round(1)
            array([697.4, 347.1])
        """
        stress = self._evaluate_stress_slope_and_derivatives(mode, stretch, values)[..., 0]
        return stress[..., 0] if _count_stretches(mode) == 1 else stress

    def nominal_stress_slope(self, stretch, values, mode: str = "uniaxial") -> np.ndarray:
        """d(nominal stress)/d(stretch), Pa, shape of `stretch`; arguments as in `nominal_stress`.

        In the mode ``biaxial``: derivative of each stress (second last axis) with respect to each stretch (last axis).
        """
        count = _count_stretches(mode)
        slope = self._evaluate_stress_slope_and_derivatives(mode, stretch, values)[..., 1:1 + count]
        return slope[..., 0, 0] if count == 1 else slope

    def nominal_stress_parameter_derivatives(self, stretch, values, mode: str = "uniaxial") -> np.ndarray:
        """d(nominal stress)/d(parameter), shape (*stretch.shape, m); arguments as in `nominal_stress`."""
        count = _count_stretches(mode)
        derivatives = self._evaluate_stress_slope_and_derivatives(mode, stretch, values)[..., 1 + count:]
        return derivatives[..., 0, :] if count == 1 else derivatives

    def compute_energy_and_kirchhoff_stresses(self, stretches, values) -> tuple[np.ndarray, np.ndarray]:
        """Return energy density and deviatoric Kirchhoff stresses tau_i = l_i dW/dl_i of the isochoric part.

        Args:
            stretches: principal stretches, shape (..., 3), with product J > 0; the energy is that of
                stretches / J^(1/3).
            values: parameters, SI.

        Returns:
            W in J/m3, shape (...), and the deviatoric principal Kirchhoff stresses in Pa, shape (..., 3); NaN or
            infinite outside the domain of the law.

        Source: Holzapfel, Nonlinear Solid Mechanics, 2000, section 6.4.
        """
        stretches = np.asarray(stretches, dtype=float)
        bar = stretches * np.prod(stretches, axis=-1, keepdims=True) ** (-1.0 / 3.0)
        energy, *slopes = _evaluate_inside_domain(
            _compile_energy_and_log_stretch_slopes(self), 4, bar.shape[:-1], *np.moveaxis(bar, -1, 0),
            *self.convert_parameters_to_array(values))
        tau = np.stack(slopes, axis=-1)
        return np.array(energy), tau - tau.mean(axis=-1, keepdims=True)

    def compute_log_strain_hessian(self, stretches, values) -> np.ndarray:
        """Return d2W/(de_i de_j) with the logarithmic strains e, Pa, shape (..., 3, 3); compressible laws only."""
        raise TypeError(f"{type(self).__name__} does not state the energy of a change of volume")

    def K0(self, values) -> float:
        """Initial bulk modulus, Pa; infinite for a law without volumetric response."""
        return np.inf

    def mu0(self, values) -> float:
        """Initial shear modulus, Pa: slope of the shear stress at rest."""
        return float(self.nominal_stress_slope(0.0, values, "simple_shear"))

    def E0(self, values) -> float:
        """Initial Young's modulus, Pa; 3 mu0 of an incompressible solid."""
        return float(self.nominal_stress_slope(1.0, values))

    def formula(self) -> str:
        """Energy as one line of text."""
        return "W = " + self._format_formula("sstr").replace("**", "^")

    def latex(self) -> str:
        """Return the formula of the energy in LaTeX, for reports."""
        return "W = " + self._format_formula("latex")

    def _format_formula(self, by: str) -> str:
        """Return the energy as text, from the printer function of sympy with the name `by`: "sstr" or "latex"."""
        return load_or_format_text(lambda: self._format_in_parameter_order(getattr(sp, by)),
                                   cache_key=None if self.cache_key is None else (*self.cache_key, by))

    def _format_in_parameter_order(self, write) -> str:
        """Return the energy as text by the function `write`, with its terms in the order of the parameters."""
        def find_first_parameter_index(term):
            return min((i for i, p in enumerate(self.symbols) if term.has(p)), default=len(self.symbols))

        terms = sorted(sp.Add.make_args(self.formula_expression()), key=find_first_parameter_index)
        return " + ".join(write(term) for term in terms).replace("+ -", "- ")

    def formula_expression(self) -> sp.Expr:
        """Return the symbolic energy that `formula` and `latex` print."""
        raise TypeError(f"{type(self).__name__} must derive from InvariantLaw or StretchLaw")


def _evaluate_inside_domain(function, count: int, shape: tuple[int, ...], *arguments) -> list[np.ndarray]:
    """Return the first `count` results of a compiled function, NaN where one of the other results is not positive.

    The other results are the conditions of the domain. Overflow gives infinite or undefined numbers without a warning.

    Returns:
        Results, each with the shape `shape`.
    """
    with np.errstate(all="ignore"):
        results = function(*arguments)
        found = [np.broadcast_to(np.asarray(item, dtype=float), shape) for item in results[:count]]
        if len(results) > count:
            inside = np.all([np.broadcast_to(condition > 0, shape) for condition in results[count:]], axis=0)
            found = [np.where(inside, item, np.nan) for item in found]
    return found


def _count_stretches(mode: str) -> int:
    """Return the number of prescribed stretches of a mode; 1 in simple shear."""
    return STRETCH_MODES[mode].stretch_count if mode in STRETCH_MODES else 1


@lru_cache
def _compile_mode_stress_function(law: Law, mode: str):
    """Return one compiled function: stretches, parameters -> see `_derive_mode_stress_and_derivatives`."""
    return law.compile_cached_function(mode, lambda: _derive_mode_stress_and_derivatives(law, mode))


def _derive_mode_stress_and_derivatives(law: Law, mode: str):
    """Return symbols (*stretches, *parameters), and for each load [nominal stress, slopes, *parameter derivatives].

    The conditions of the domain follow; see `Law.list_domain_conditions_of_stretches`.
    """
    if mode == "simple_shear":
        # Principal stretches of simple shear gamma: l and 1/l with l - 1/l = gamma.
        s = sp.Symbol("gamma", real=True)
        l1 = s / 2 + sp.sqrt(1 + s**2 / 4)
        prescribed, stretches = (s,), (l1, 1 / l1, sp.Integer(1))
        directions: tuple[int, ...] = (1,)
    else:
        path = STRETCH_MODES[mode]
        names = ["lambda"] if path.stretch_count == 1 else [f"lambda{i + 1}" for i in range(path.stretch_count)]
        prescribed, directions = tuple(sp.Symbol(name, positive=True) for name in names), path.directions
        stretches = tuple(sp.Mul(*(s**sp.Rational(e.numerator, e.denominator)
                                   for s, e in zip(prescribed, row, strict=True))) for row in path.exponents)
    energy = law.energy_of_stretches(*stretches, law.symbols)
    entries = []
    for s, count in zip(prescribed, directions, strict=True):
        stress = sp.diff(energy, s) / count
        entries += [stress, *(sp.diff(stress, variable) for variable in (*prescribed, *law.symbols))]
    return (*prescribed, *law.symbols), [*entries, *law.list_domain_conditions_of_stretches(*stretches)]


@lru_cache
def _compile_energy_and_log_stretch_slopes(law: Law):
    """Return one compiled function: three stretches, parameters -> [energy, derivatives by ln(stretch), conditions]."""
    return law.compile_cached_function("principal", lambda: _derive_energy_and_log_stretch_slopes(law))


def _derive_energy_and_log_stretch_slopes(law: Law):
    """Return symbols (*stretches, *parameters), and expressions [energy, *derivatives by ln(stretch), *domain]."""
    l1, l2, l3 = stretches = sp.symbols("l1:4", positive=True)
    energy = law.energy_of_stretches(l1, l2, l3, law.symbols)
    slopes = [s * sp.diff(energy, s) for s in stretches]
    return (*stretches, *law.symbols), [energy, *slopes, *law.list_domain_conditions_of_stretches(l1, l2, l3)]


def _compute_invariants(l1, l2, l3) -> tuple:
    """Return I1 and I2 of three principal stretches whose product is 1."""
    return l1**2 + l2**2 + l3**2, l1**-2 + l2**-2 + l3**-2


class InvariantLaw(Law):
    """Law of the isochoric invariants: a subclass defines `energy(I1, I2, *parameters)`.

    I1 = l1^2 + l2^2 + l3^2 and I2 = l1^-2 + l2^-2 + l3^-2. Polynomials of (I1 - 3, I2 - 3) up to degree three share
    one compiled kernel; the kernel of any other smooth formula is compiled on first use.
    """

    def energy(self, I1, I2, *parameters):
        """Return W as an expression of the invariants and the parameters."""
        raise TypeError(f"{type(self).__name__} must state energy(I1, I2, *parameters)")

    def energy_of_stretches(self, l1, l2, l3, parameters) -> sp.Expr:
        """Return W as an expression of the isochoric principal stretches; see `Law.energy_of_stretches`."""
        return sp.sympify(self.energy(*_compute_invariants(l1, l2, l3), *parameters))

    def list_domain_conditions_of_stretches(self, l1, l2, l3) -> list[sp.Expr]:
        """Return the conditions of I1 and I2, as expressions of the stretches; see `Law`."""
        symbols = make_invariant_symbols()
        values = dict(zip(symbols, _compute_invariants(l1, l2, l3), strict=True))
        conditions = list_domain_conditions(self.formula_expression(), dict.fromkeys(symbols, 3))
        return [condition.subs(values) for condition in conditions]

    def formula_expression(self) -> sp.Expr:
        """Return the symbolic energy W of I1, I2 and the parameters."""
        return sp.sympify(self.energy(*make_invariant_symbols(), *self.symbols))

    def _derive_polynomial_coefficients_or_none(self):
        """Return symbols, and coefficients of (I1-3)^i (I2-3)^j as expressions of them; None for another formula."""
        x, y = sp.symbols("x y", real=True)
        try:
            polynomial = sp.Poly(sp.sympify(self.energy(x + 3, y + 3, *self.symbols)), x, y)
        except sp.PolynomialError:
            return None
        terms = dict(polynomial.terms())
        if any(power not in (*POWERS, (0, 0)) for power in terms):
            return None
        return self.symbols, [sp.sympify(terms.get(power, 0)) for power in POWERS]

    @cached_property
    def _polynomial_coefficient_function_or_none(self):
        """Compiled function: parameters -> coefficients of the polynomial; None for another formula."""
        return self.compile_cached_function("polynomial", self._derive_polynomial_coefficients_or_none)

    @cached_property
    def kernel_energy(self) -> KernelEnergy:
        """Energy of the kernel; polynomials up to degree three share one kernel."""
        if self._polynomial_coefficient_function_or_none is not None:
            return POLYNOMIAL_KERNEL_ENERGY
        return KernelEnergy(self.name, "invariants", make_invariant_symbols(), self.symbols, self.formula_expression())

    def kernel_coefficients(self, values) -> np.ndarray:
        """Return the coefficients of the kernel for the parameters, shape (coefficients,)."""
        found, array = self._polynomial_coefficient_function_or_none, self.convert_parameters_to_array(values)
        return array if found is None else np.array(found(*array), dtype=float)


class StretchLaw(Law):
    """Separable law W = w(l1) + w(l2) + w(l3): a subclass defines `energy_of_stretch(stretch, *parameters)`."""

    def energy_of_stretch(self, stretch, *parameters):
        """Return w as an expression of one stretch and the parameters."""
        raise TypeError(f"{type(self).__name__} must state energy_of_stretch(stretch, *parameters)")

    def energy_of_stretches(self, l1, l2, l3, parameters) -> sp.Expr:
        """Return W as the sum of w over the isochoric principal stretches."""
        return sp.Add(*(sp.sympify(self.energy_of_stretch(s, *parameters)) for s in (l1, l2, l3)))

    def list_domain_conditions_of_stretches(self, l1, l2, l3) -> list[sp.Expr]:
        """Return the conditions of w at each of the stretches; see `Law`."""
        stretch = sp.Symbol("lambda", positive=True)
        conditions = list_domain_conditions(self.formula_expression(), {stretch: 1})
        return [condition.subs(stretch, s) for condition in conditions for s in (l1, l2, l3)]

    def formula_expression(self) -> sp.Expr:
        """Symbolic energy w of one stretch."""
        return sp.sympify(self.energy_of_stretch(sp.Symbol("lambda", positive=True), *self.symbols))

    def formula(self) -> str:
        """Return the formula of W and w as text."""
        return f"W = w(lambda_1) + w(lambda_2) + w(lambda_3), {super().formula().replace('W', 'w', 1)}"

    def latex(self) -> str:
        """Return the formula of W and w in LaTeX."""
        return r"W = w(\lambda_1) + w(\lambda_2) + w(\lambda_3), \quad " + super().latex().replace("W", "w", 1)

    @cached_property
    def kernel_energy(self) -> KernelEnergy:
        """Energy of the kernel, w of one stretch."""
        stretch = sp.Symbol("stretch", positive=True)
        return KernelEnergy(self.name, "stretches", (stretch,), self.symbols,
                            sp.sympify(self.energy_of_stretch(stretch, *self.symbols)))
