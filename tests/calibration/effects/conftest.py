"""Fixtures of the tests of effects."""

import pytest
from virtual_campaign import fitted, measured_campaign


@pytest.fixture(scope="session")
def plain(tmp_path_factory):
    """Three virtual tests without any effect."""
    return fitted(measured_campaign(tmp_path_factory.mktemp("plain")))
