"""Format the numbers and names of a fit: parameters, moduli, stretches, titles of laws, common remarks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

from calibration.fit.fit import Fit, get_shared_and_population_mean_material
from calibration.report.content import Span
from calibration.report.quantities import (
    ReportUnits,
    format_interval,
    format_value_and_error,
    format_value_rounded_by_error,
)
from tissue_sim.laws import find_law

#: Relative step of a parameter for the finite-difference derivative of a modulus.
_STEP = 1e-4


def format_law_title(law_name: str) -> str:
    """Return the title of a law; ``N = 2`` stays on one line."""
    return find_law(law_name).title.replace("N = ", "N\u00a0=\u00a0")


def are_laws_ranked_by_prediction(fits: Iterable[Fit]) -> bool:
    """Return whether the laws are ranked by prediction error instead of the BIC."""
    return any(fit.left_out is not None for fit in fits)


def format_parameter_estimate(fit: Fit, name: str, units: ReportUnits) -> str:
    """Return the estimate of a parameter with its standard error, such as ``0.988 ± 0.023 kPa``.

    Without a standard error the text states the reason, or all values such as ``8 or -8`` if several optima fit equally
    well.
    """
    unit, error = units.choose_display_unit_of_si_unit(fit.units[name]), fit.standard_errors[name]
    known = "fixed" if error == 0 else "on its bound" if name in fit.on_bound else ""
    if error is None and fit.alternatives and not known:
        values = dict.fromkeys(f"{each[name] / unit.size:.4g}" for each in (
            fit.parameters, *(one.parameters for one in fit.alternatives)))
        return f"{' or '.join(values)} {unit.name}".strip()
    return format_value_and_error(fit.parameters[name] / unit.size, error and error / unit.size, unit.name, known=known)


def format_parameter_interval_without_unit(fit: Fit, name: str, units: ReportUnits) -> str:
    """Return the 95 % interval of a parameter in its display unit, without the unit, such as ``0.937 to 1.040``.

    The text is empty if the interval or the standard error is unknown.
    """
    unit = units.choose_display_unit_of_si_unit(fit.units[name])
    error, interval = fit.standard_errors[name], fit.intervals95[name]
    if interval is None or not error:
        return ""
    low, high = (end / unit.size for end in interval)
    return format_interval(low, high, error / unit.size, fit.parameters[name] / unit.size)


def compute_shear_modulus_error_or_none(fit: Fit) -> float | None:
    """Return the standard error of the initial shear modulus, Pa; see `_compute_modulus_error_or_none`."""
    return _compute_modulus_error_or_none(fit, find_law(fit.law).mu0)


def _compute_modulus_error_or_none(fit: Fit, compute_modulus: Callable[[Mapping[str, float]], float]) -> float | None:
    """Return the standard error of a modulus of the law, Pa, by linear propagation of the covariance.

    For specimens that differ the covariance of the mean material is used.

    Args:
        fit: fit of a law.
        compute_modulus: returns the modulus, Pa, of the parameters of the law.

    Returns:
        The standard error; None if a parameter of the law has no error or differs between tests.
    """
    law, material = find_law(fit.law), get_shared_and_population_mean_material(fit)
    values = {name: material.parameters[name] for name in law.parameters if name in material.parameters}
    if any(material.errors.get(name) is None for name in law.parameters):
        return None

    def differentiate_modulus_by_one_parameter(name: str) -> float:
        """Return the derivative of the modulus with respect to one parameter (central difference)."""
        step = _STEP * (abs(values[name]) or 1.0)
        ends = (compute_modulus({**values, name: values[name] + side * step}) for side in (1, -1))
        return (next(ends) - next(ends)) / (2 * step)

    rates = [differentiate_modulus_by_one_parameter(name) for name in law.parameters]
    order = list(material.parameters)
    indices = [order.index(name) for name in law.parameters]
    variance = sum(rates[a] * rates[b] * float(material.covariance[i, j])
                   for a, i in enumerate(indices) for b, j in enumerate(indices))
    return math.sqrt(variance) if variance > 0 else None


def format_young_and_shear_modulus_values(fit: Fit, units: ReportUnits) -> tuple[str, str]:
    """Return Young's modulus and the shear modulus as text, in the pressure unit of the report but without its name.

    Both are rounded to the precision of their standard errors, which are not written.
    """
    size, error = units.pressure.size, compute_shear_modulus_error_or_none(fit)
    young_error = _compute_modulus_error_or_none(fit, find_law(fit.law).E0)
    return (format_value_rounded_by_error(fit.E0 / size, young_error and young_error / size),
            format_value_rounded_by_error(fit.mu0 / size, error and error / size))


def format_young_modulus(fit: Fit, units: ReportUnits) -> str:
    """Return Young's modulus with its standard error, such as ``5.93 ± 0.14 kPa``."""
    size, error = units.pressure.size, _compute_modulus_error_or_none(fit, find_law(fit.law).E0)
    return format_value_and_error(fit.E0 / size, error and error / size, units.pressure.name)


def make_parameter_symbol(fit: Fit, name: str, mark: str = "symbol") -> Span:
    """Return the symbol of a parameter; a tooltip gives the name in the model if the name differs.

    Args:
        fit: the fit.
        name: name of the parameter.
        mark: ``"symbol"``, or ``"bad_symbol"`` for a warning.
    """
    symbol = fit.symbols[name]
    return Span(symbol, mark, title="" if symbol == name else name)


def format_stable_stretches(fit: Fit) -> str:
    """Return the range of stretches with Drucker stability in all three modes, such as ``0.3 to 3``."""
    nowhere = fit.mu0 <= 0 or fit.stable_from >= fit.stable_to
    return "nowhere" if nowhere else f"{fit.stable_from:.3g} to {fit.stable_to:.3g}"


def iterate_fit_groups_with_remarks(fits: Sequence[Fit],
                                    of: Callable[[Fit], Sequence[str]]) -> Iterator[tuple[tuple[Fit, ...], str]]:
    """Yield (fits, their common remarks joined by ``;``) for each group of fits, the largest group first.

    A remark that several laws share appears once.

    Args:
        fits: fits of all laws.
        of: returns the remarks of a fit.
    """
    laws: dict[str, tuple[Fit, ...]] = {}
    for fit in fits:
        for remark in of(fit):
            laws[remark] = (*laws.get(remark, ()), fit)
    remarks: dict[tuple[str, ...], list[str]] = {}
    for remark, having in laws.items():
        remarks.setdefault(tuple(fit.law for fit in having), []).append(remark)
    by_name = {fit.law: fit for fit in fits}
    for names in sorted(remarks, key=lambda names: -len(names)):
        yield tuple(by_name[name] for name in names), "; ".join(remarks[names])


def list_parameters_with_standard_errors(fit: Fit) -> list[str]:
    """Return the names of the parameters with a standard error: neither fixed nor at a bound, in covariance order."""
    return [name for name in fit.covariance.order if fit.standard_errors[name] not in (None, 0.0)]
