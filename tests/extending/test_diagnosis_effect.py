"""An effect of a diagnosis from one file: registered, a candidate, and identified in virtual recordings."""

import sys

import pytest
from virtual_campaign import fitted, measured_campaign

import tissue_sim as ts
from calibration.effects.effect import CATALOGUE, Effect, NotTestableError
from tissue_sim.rig.fault import FAULTS


@pytest.fixture
def cable(plugin, registers):
    module = plugin("cable_spring")
    registers(FAULTS, module.CableSpring)
    return registers(CATALOGUE, module.CablePull)


@pytest.mark.slow
def test_effect_scores_highest_where_it_acts(cable, tmp_path):
    """A cable of 20 N/m in tests of 200 to 900 N/m scores higher than the other effects of the rig."""
    values = {"rig.faults.cable_spring.stiffness": 20.0}
    study = fitted(measured_campaign(tmp_path, lambda name, model: cable().apply(model, values)))
    candidate, = CATALOGUE["cable_pull"]().candidates(study.situation)
    score = study.score(candidate)
    assert score > 5.0
    for name, kind in CATALOGUE.items():
        if kind.category == "rig" and name not in ("cable_pull", "step_loss", "inertia", "machine_compliance"):
            assert max(abs(study.score(other)) for other in kind().candidates(study.situation)) < score, name


def test_registered_name_is_refused(cable):
    with pytest.raises(ts.InputError, match="'tilt' is taken"):
        CATALOGUE.register(cable, "tilt")
    with pytest.raises(ts.InputError, match=r"derives from calibration\.effects\.effect\.Effect"):
        CATALOGUE.register(object, "nothing")


def test_effect_gives_reason_why_tests_cannot_show_it():
    class Nowhere(Effect):
        name = "nowhere"
        category = "rig"
        title = "nothing"
        signature = "no change"
        separated_by = "no test"

        def candidates(self, situation):
            raise NotTestableError("no test has a sensor")

    with pytest.raises(NotTestableError, match="no test has a sensor"):
        Nowhere().candidates(None)


def test_former_names_work_and_warn(cable, tmp_path):
    """A plug-in of an earlier release: ``room``, ``beside_material``, ``both_ways`` and ``DiagnosisData.simulated``."""
    from calibration.effects import candidates

    with pytest.warns(DeprecationWarning, match=r"OldCable\.room is renamed to category; define category"):
        class OldCable(Effect):
            name = "old_cable"
            room = "rig"
            title = "cable"
            signature = "pulls"
            separated_by = "a run in air"

            def candidates(self, situation):
                tests = [add_cable(test) for test in situation.simulated()]
                return candidates.beside_material(self, situation, "rig.faults.cable_spring.stiffness", tests,
                                                  lambda group: 2.0, both_ways=False, prepare=add_cable)

    add_cable = sys.modules[cable.__module__].with_cable
    situation = fitted(measured_campaign(tmp_path, lambda name, model: model)).situation
    with pytest.warns(DeprecationWarning) as caught:
        found, = OldCable().candidates(situation)
    assert {str(each.message).partition(" is ")[0].rpartition(".")[2] for each in caught} == {
        "simulated", "beside_material"}
    path, = found.bounds
    assert found.bounds[path][0] == 0.0 and OldCable.category == "rig"
    with pytest.warns(DeprecationWarning, match=r"Effect\.room is renamed to category"):
        assert OldCable().room == "rig"
    test = situation.tests[0]
    for old, new in (("depth", "largest_displacement"), ("force", "largest_force"), ("strain", "largest_strain")):
        with pytest.warns(DeprecationWarning, match=rf"DiagnosisData\.{old} is renamed to {new}"):
            assert getattr(situation, old)(test) == getattr(situation, new)(test) > 0
    with pytest.warns(DeprecationWarning, match=r"DiagnosisData\.modulus is renamed to estimated_shear_modulus"):
        assert situation.modulus == situation.estimated_shear_modulus
