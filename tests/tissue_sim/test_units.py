"""Units as they stand in headers and keys."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tissue_sim import InputError
from tissue_sim.units import UNITS, get_si_factor_and_offset, split_header_with_brackets


@pytest.mark.parametrize(("unit", "quantity", "value", "si"), [
    ("mm", "length", 8.0, 8e-3), ("um", "length", 3.0, 3e-6), ("µm", "length", 3.0, 3e-6), ("μm", None, 3.0, 3e-6),
    ("mN", "force", 20.0, 0.02), ("ms", "time", 1.0, 1e-3), ("min", "time", 2.0, 120.0),
    (" kPa ", "stress", 1.5, 1500.0),
    ("N/mm²", "stress", 0.1, 1e5), ("N.mm", "torque", 5.0, 5e-3), ("%", "ratio", 14.0, 0.14), ("-", "ratio", 2.0, 2.0),
    ("degC", "temperature", 37.0, 310.15), ("°C", "temperature", 0.0, 273.15), ("K", "temperature", 300.0, 300.0)])
def test_si(unit, quantity, value, si):
    factor, offset = get_si_factor_and_offset(unit, quantity)
    assert value * factor + offset == pytest.approx(si, rel=1e-15)


@pytest.mark.parametrize(("unit", "quantity", "si"), [
    ("us", "time", 1e-6), ("h", "time", 3600.0), ("cm", "length", 1e-2), ("nm", "length", 1e-9),
    ("in", "length", 0.0254), ("mil", "length", 2.54e-5), ("kN", "force", 1e3), ("uN", "force", 1e-6),
    ("nN", "force", 1e-9), ("pN", "force", 1e-12), ("cN", "force", 1e-2), ("dyn", "force", 1e-5),
    ("g", "force", 9.80665e-3), ("gf", "force", 9.80665e-3), ("mg", "force", 9.80665e-6), ("kg", "force", 9.80665),
    ("kgf", "force", 9.80665), ("lb", "force", 4.4482216152605), ("lbf", "force", 4.4482216152605),
    ("ozf", "force", 0.27801385095378125), ("Nm", "torque", 1.0), ("mNm", "torque", 1e-3), ("uNm", "torque", 1e-6),
    ("Nmm", "torque", 1e-3), ("Pa", "stress", 1.0), ("MPa", "stress", 1e6), ("GPa", "stress", 1e9),
    ("N/mm^2", "stress", 1e6), ("N/mm2", "stress", 1e6), ("N/cm2", "stress", 1e4), ("N/m2", "stress", 1.0),
    ("bar", "stress", 1e5), ("psi", "stress", 6894.757293168361), ("ksi", "stress", 6894757.293168361),
    ("g/mm2", "stress", 9806.65), ("kgf/cm2", "stress", 98066.5)])
def test_factors_are_those_of_nist(unit, quantity, si):
    """NIST Special Publication 811 (2008), appendix B."""
    assert get_si_factor_and_offset(unit, quantity) == (pytest.approx(si, rel=1e-12), 0.0)


@pytest.mark.parametrize(("unit", "quantity", "message"), [
    ("mmm", None, "did you mean 'mm'"), ("lbx", "force", "unknown unit 'lbx'"), ("", None, "unknown unit ''"),
    ("mm", "force", "unit 'mm' is a length, expected a force (N, kN, mN, uN, nN, pN, cN, "
     "dyn, g, gf, mg, kg, kgf, lb, lbf, ozf)"),
    ("n", "force", "unknown unit 'n'"), ("MM", "length", "unknown unit 'MM'")])
def test_what_is_no_unit_here(unit, quantity, message):
    with pytest.raises(InputError) as caught:
        get_si_factor_and_offset(unit, quantity)
    assert message in str(caught.value)


@pytest.mark.parametrize(("header", "parts"), [
    ("Load (N)", ("Load", "N")), ("time [s]", ("time", "s")), (" Way[mm] ", ("Way", "mm")),
    ("Stretch", ("Stretch", None)),
    ("Strain (true) [%]", ("Strain (true)", "%")), ("Load ( N )", ("Load", "N")), ("[mm]", ("", "mm")),
    ("Load (N) corrected", ("Load (N) corrected", None)), ("", ("", None)), ("Load ()", ("Load", ""))])
def test_headers(header, parts):
    assert split_header_with_brackets(header) == parts


plain = st.text(st.characters(exclude_characters="[]()", categories=["L", "N", "P"]), min_size=1)


@given(name=plain, unit=st.sampled_from(sorted(UNITS)), brackets=st.sampled_from(["[]", "()"]),
       gap=st.sampled_from(["", " "]))
def test_any_header_is_taken_apart(name, unit, brackets, gap):
    assert split_header_with_brackets(f"{name}{gap}{brackets[0]}{unit}{brackets[1]}") == (name, unit)
    assert split_header_with_brackets(name) == (name, None)
