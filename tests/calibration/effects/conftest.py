"""What tests of the effects share."""

import pytest
from virtual_campaign import fitted, measured_campaign


@pytest.fixture(scope="session")
def plain(tmp_path_factory):
    """Three tests in which nothing is hidden."""
    return fitted(measured_campaign(tmp_path_factory.mktemp("plain")))
