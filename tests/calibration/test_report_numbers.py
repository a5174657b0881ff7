"""Numbers of a report: digits by the uncertainty, one unit for each quantity, symbols as papers set them."""

from types import SimpleNamespace

import pytest

from calibration.report.content import Paragraph, Span
from calibration.report.fit_text import (
    compute_shear_modulus_error_or_none,
    format_young_and_shear_modulus_values,
    format_young_modulus,
    iterate_fit_groups_with_remarks,
)
from calibration.report.outputs import render_page
from calibration.report.quantities import (
    ReportUnits,
    format_error,
    format_interval,
    format_mathtext_symbol,
    format_odds_number,
    format_plain_symbol,
    format_value_and_error,
    use_minus_signs,
)


@pytest.mark.parametrize(("value", "error", "text"), [
    # The examples of the Particle Data Group's rule, and its edges.
    (0.827, 0.119, "0.83 ± 0.12"), (0.827, 0.367, "0.8 ± 0.4"), (1.2345, 0.0354, "1.234 ± 0.035"),
    (1.2345, 0.0355, "1.23 ± 0.04"), (1.2345, 0.0949, "1.23 ± 0.09"), (1.2345, 0.0951, "1.23 ± 0.10"),
    (12.3, 99.6, "10 ± 100"), (988.28, 23.1, "988 ± 23"), (463011.0, 45261.0, "460000 ± 50000"),
    (-0.0699, 0.018, "-0.070 ± 0.018"), (-0.0003, 0.007, "0.000 ± 0.007"),
    (6e-7, 1.1e-6, "(0.6 ± 1.1) × 10⁻⁶"), (1.23e7, 3e4, "(1.2300 ± 0.0030) × 10⁷")])
def test_an_error_leaves_one_or_two_digits(value, error, text):
    assert format_value_and_error(value, error) == text


def test_without_an_error_four_digits_stay_and_a_reason_stands_there():
    assert format_value_and_error(1.234567, None, "kPa", known="on its bound") == "1.235 kPa (on its bound)"
    assert format_value_and_error(1.234567, 0.0, "s", known="fixed") == "1.235 s (fixed)"


def test_an_interval_ends_where_the_error_does_or_where_its_own_width_does():
    assert format_interval(0.9372, 1.0401, 0.0231, 0.988) == "0.937 to 1.040"
    # A share that nothing determines, cut by its bounds 0 and 1.
    assert format_interval(1e-6, 1.0, 331.0, 0.0) == "0.00 to 1.00"
    assert format_interval(1.0, 2.0, None) == "1 to 2"
    assert format_error(0.00531) == "0.005" and format_error(0.012) == "0.012" and format_error(3e-7) == "3e-07"


def test_the_error_of_a_modulus_follows_from_the_covariance():
    """mu0 = mu1 + mu2 of Ogden; of a reduced polynomial it is 2 C10."""
    ogden = SimpleNamespace(
        law="ogden_2", parameters={"mu1": 500.0, "alpha1": 2.0, "mu2": 300.0, "alpha2": -3.0}, E0=2400.0, mu0=800.0,
        material_of=[], population=None,
        standard_errors=dict.fromkeys(("mu1", "alpha1", "mu2", "alpha2"), 1.0), covariance=SimpleNamespace(
            order=["mu1", "alpha1", "mu2", "alpha2"],
            matrix=[[100.0, 3.0, -90.0, 0.0], [3.0, 1.0, 0.0, 0.0], [-90.0, 0.0, 144.0, 0.0], [0.0, 0.0, 0.0, 1.0]]))
    assert compute_shear_modulus_error_or_none(ogden) == pytest.approx((100 + 144 - 180)**0.5)
    units = ReportUnits.choose_for_best_fit(SimpleNamespace(best=SimpleNamespace(mu0=800.0, RMSE_N=None,
                                                                                 regions=[])))
    assert format_young_modulus(ogden, units) == "2400 ± 24 Pa"
    assert format_young_and_shear_modulus_values(ogden, units) == ("2400", "800")
    ogden.standard_errors["mu2"] = None
    assert compute_shear_modulus_error_or_none(ogden) is None and format_young_and_shear_modulus_values(ogden, units) \
        == ("2400", "800")


def test_symbols():
    page = render_page("", [("", [Paragraph(Span("mu1@cast <A>", "symbol"))])], None)
    assert "<p><i>μ</i><sub>1</sub> (cast &lt;A&gt;)</p>" in page
    assert format_mathtext_symbol("tau2") == r"$\tau_{2}$" and format_mathtext_symbol("C10@A") == "$C_{10}$ (A)"
    assert format_plain_symbol("alpha1@B") == "α1 (B)" and format_plain_symbol("rig.compliance") == "rig.compliance"


def test_minus_signs_are_those_of_numbers():
    assert use_minus_signs("-0.07 to -1, Mooney-Rivlin, cast-1, 1e-06") == "−0.07 to −1, Mooney-Rivlin, cast-1, 1e-06"


@pytest.mark.parametrize(("mu0", "RMSE", "end", "names"), [
    (1977.0, 0.14, 9.0, ("kPa", "N", "mm")), (463e3, None, 9.0, ("kPa", "N", "mm")),
    (800.0, 4e-9, 2e-3, ("Pa", "µN", "µm")), (2.1e6, 2e-4, 0.4, ("MPa", "mN", "mm"))])
def test_one_unit_of_each_quantity(mu0, RMSE, end, names):
    best = SimpleNamespace(mu0=mu0, RMSE_N=RMSE, regions=[SimpleNamespace(end=end)])
    units = ReportUnits.choose_for_best_fit(SimpleNamespace(best=best))
    assert (units.pressure.name, units.force.name, units.length.name) == names
    assert units.choose_display_unit_of_si_unit("Pa") is units.pressure \
        and units.choose_display_unit_of_si_unit("1").name == ""
    assert units.force.format_axis_label("force") == f"force [{names[1]}]"


def test_what_laws_share_is_said_once():
    fits = [SimpleNamespace(law=law, warnings=warnings) for law, warnings in (
        ("a", ["assumed", "far off"]), ("b", ["assumed", "on a bound"]), ("c", ["assumed", "far off"]))]
    told = [([fit.law for fit in having], words) for having,
            words in iterate_fit_groups_with_remarks(fits, lambda fit: fit.warnings)]
    assert told == [(["a", "b", "c"], "assumed"), (["a", "c"], "far off"), (["b"], "on a bound")]


@pytest.mark.parametrize(("ratio", "text"), [(1.26, "1.3"), (12.93, "13"), (338.2, "338"), (48644.0, "48\u202f600"),
                                             (3e7, "> 10⁶")])
def test_odds_have_few_digits(ratio, text):
    assert format_odds_number(ratio) == text
