"""Make the test classes of the contracts importable by the tests of the back-ends in this folder."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
pytest.register_assert_rewrite("device_contracts")
