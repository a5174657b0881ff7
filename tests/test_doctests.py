"""Examples in docstrings run and print what they state."""

import doctest
import importlib

import pytest

#: Modules whose docstrings contain examples.
MODULES = (
    "calibration.pipeline",
    "tissue_sim.closed_form.column",
    "tissue_sim.closed_form.histories",
    "tissue_sim.closed_form.homogeneous",
    "tissue_sim.errors",
    "tissue_sim.experiment.kinds.kind",
    "tissue_sim.experiment.protocol",
    "tissue_sim.experiment.tools.tool",
    "tissue_sim.laws",
    "tissue_sim.laws.law",
    "tissue_sim.laws.stability",
    "tissue_sim.material.file",
    "tissue_sim.material.material",
    "tissue_sim.mesh.axisymmetric",
    "tissue_sim.mesh.solid",
    "tissue_sim.model",
    "tissue_sim.parameters",
    "tissue_sim.pose",
    "tissue_sim.recording.file",
    "tissue_sim.recording.recording",
    "tissue_sim.registry",
    "tissue_sim.rig.file",
    "tissue_sim.rig.rig",
    "tissue_sim.simulator",
    "tissue_sim.specimen.specimen",
    "tissue_sim.units",
)


@pytest.mark.parametrize("name", MODULES)
def test_examples_print_what_they_state(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)  # some examples write files
    results = doctest.testmod(importlib.import_module(name))
    assert results.attempted and not results.failed, capsys.readouterr().out


def test_every_module_with_examples_is_in_the_list(root):
    found = {".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")
             for folder in ("tissue_sim", "calibration", "haptics", "scenes") for path in (root / folder).rglob("*.py")
             if ">>> " in path.read_text(encoding="utf-8")}
    assert found == set(MODULES)
