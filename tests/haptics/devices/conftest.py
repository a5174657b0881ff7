"""The tests of the contracts are beside those of the back-ends, which subclass them."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
pytest.register_assert_rewrite("device_contracts")
