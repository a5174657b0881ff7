"""Folders that tests share."""

import os
from pathlib import Path

import pytest

# Before numpy comes: threads help no matrix as small as ours, and on a busy machine they wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def root() -> Path:
    """The repository."""
    return ROOT


@pytest.fixture(scope="session")
def reference() -> Path:
    """Reference curves from independent solvers."""
    return ROOT / "tests" / "reference"


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Measured data of others; not part of the repository."""
    folder = Path(os.environ.get("TISSUE_SIM_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("compares with measurements that other people have published, of which this repository holds no "
                    f"copy, and there is no folder {folder}; docs/calibration.md, docs/measured_silicones.md and "
                    "docs/viscoelasticity.md say where they are; set TISSUE_SIM_DATA to the folder that holds "
                    "ecoflex_compression and the others")
    return folder
