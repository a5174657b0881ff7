"""The settings in the name of a device."""

import pytest

import tissue_sim as ts
from haptics.devices.settings import parse_number_settings


def test_settings_are_read_by_name_with_defaults():
    assert parse_number_settings(" rate_hz = 500 ,", rate_hz=1000.0, count=3) == {"rate_hz": 500.0, "count": 3}


@pytest.mark.parametrize(("text", "field", "words"), [
    ("rate_hz", "settings", "must be NAME=NUMBER"), ("rate=5", "rate", "rate_hz"),
    ("count=1.5", "count", "whole number"),
    ("rate_hz=inf", "rate_hz", "finite"), ("rate_hz=nan", "rate_hz", "finite"),
    ("count=" + "9" * 400, "count", "finite"), ("count=" + "9" * 9999, "count", "whole number"),
])
def test_invalid_settings_are_refused_by_name(text, field, words):
    with pytest.raises(ts.InputError, match=words) as caught:
        parse_number_settings(text, rate_hz=1000.0, count=3)
    assert caught.value.field == field
