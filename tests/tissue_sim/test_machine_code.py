"""Machine code of the band factorisation: neighbouring numbers are loaded as vectors."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

CPU = Path("/proc/cpuinfo")
FACTORISE = """
import numpy as np
from tissue_sim.fem.linear import band
from tissue_sim.fem.linear.band import make_cholesky_functions
from tissue_sim.fem.taichi.origins import allocate_array
from tissue_sim.fem.taichi.runtime import get_initialised_taichi

ti = get_initialised_taichi()
factorise, _ = make_cholesky_functions()
numbers = ti.types.ndarray(dtype=ti.i32, ndim=1)

@ti.kernel
def run(table: numbers):
    ti.loop_config(serialize=True)
    for _ in range(1):
        factorise(table, 0, 0)

lower = np.vstack([np.full(64, 4.0), np.ones(64)])
blocks = band.pack_lapack_band_to_blocks(lower)
matrix, inverse, right = allocate_array(blocks.shape), allocate_array((8, 8)), allocate_array((8, 8))
matrix[:] = blocks
run(band.make_band_table(matrix, matrix, matrix, matrix, inverse, right))
assert abs(matrix[0, -1, 0, 0] - 2.0) < 1e-12, matrix[0, -1]
"""


@pytest.mark.slow
@pytest.mark.skipif(not CPU.exists() or " avx2 " not in CPU.read_text(encoding="utf-8"),
                    reason="reads machine code of processors with AVX2, which this machine lacks or does not list in "
                           "/proc/cpuinfo")
def test_the_band_factorisation_loads_vectors_without_gathers(tmp_path):
    script = tmp_path / "factorise.py"
    script.write_text(FACTORISE, encoding="utf-8")
    # Taichi writes the machine code of each compiled kernel to the working directory.
    environment = os.environ | {"TI_PRINT_KERNEL_ASM": "1", "TISSUE_SIM_CACHE": str(tmp_path / "kernels")}
    subprocess.run([sys.executable, str(script)], cwd=tmp_path, env=environment, check=True)
    longest = max((path.read_text(encoding="utf-8") for path in tmp_path.glob("*.s")), key=len)
    wide = len(re.findall(r"\(%r\w+[^)]*\), %[yz]mm\d+", longest))
    assembled = len(re.findall(r"\tv(?:movhp|unpck|insert|movlhps)", longest))
    assert "gather" not in longest
    assert wide > 100 and assembled < 0.1 * wide
