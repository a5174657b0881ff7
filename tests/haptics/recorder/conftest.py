"""Makes the virtual bench of this folder available to its tests."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
pytest.register_assert_rewrite("virtual_bench")


@pytest.fixture
def bench(tmp_path):
    from virtual_bench import VirtualBench

    return VirtualBench(tmp_path / "run")
