"""CalculiX on a mesh of ours: a tool that holds some of its nodes, and a base that stays."""

import re
import shutil
import subprocess

import numpy as np
import pytest

from tissue_sim.exports import ExportContent
from tissue_sim.exports.calculix import CALCULIX


def held_force(mesh, columns, kind, material, motion, folder, held="face"):
    """Force on what holds a set of nodes, N.

    Args:
        mesh: with the sets `held` and ``base``. columns: of its connectivity, in the order of CalculiX.
        kind: the element there. material: named GEL. motion: of the held nodes, m, shape (3,). folder: for files.
    """
    if shutil.which("ccx") is None:
        pytest.skip("compares with CalculiX, a system package that pip cannot install; ccx is not on PATH. Debian: "
                    "apt install calculix-ccx. .ci/run installs it")
    elements = mesh.connectivity[:, columns] + 1
    used = np.unique(elements)
    rows = ["*NODE, NSET=ALL", *(f"{n}, " + ", ".join(f"{x:.12g}" for x in mesh.nodes[n - 1]) for n in used),
            f"*ELEMENT, TYPE={kind}, ELSET=TISSUE"]
    for number, nodes in enumerate(elements, start=1):
        rows += [f"{number}, " + ", ".join(map(str, nodes[:10])) + ",", ", ".join(map(str, nodes[10:]))] if len(
            nodes) > 10 else [f"{number}, " + ", ".join(map(str, nodes))]
    for name in ("base", held):
        rows += [f"*NSET, NSET={name.upper()}", *(f"{n}," for n in np.intersect1d(mesh.sets[name] + 1, used))]
    rows += [CALCULIX.write(ExportContent((material,))).rstrip(),
             "*SOLID SECTION, ELSET=TISSUE, MATERIAL=GEL", "*STEP, NLGEOM, INC=100",
             "*STATIC", "0.25, 1.", "*BOUNDARY", "BASE, 1, 3",
             *(f"{held.upper()}, {axis}, {axis}, {part}" for axis, part in enumerate(motion, start=1)),
             f"*NODE PRINT, NSET={held.upper()}, TOTALS=ONLY", "RF", "*END STEP"]
    (folder / "punch.inp").write_text("\n".join(rows) + "\n", encoding="utf-8")
    done = subprocess.run(["ccx", "punch"], cwd=folder, capture_output=True, text=True, encoding="utf-8", timeout=600)
    answer = (folder / "punch.dat").read_text(encoding="utf-8")
    assert done.returncode == 0 and answer, done.stdout[-2000:]
    return np.array([float(x) for x in re.findall(r"total force.*?\n\n((?:\s+\S+){3})", answer)[-1].split()])
