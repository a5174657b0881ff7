"""An effect of a diagnosis from one file: in the catalogue, among the candidates, and found where it is hidden."""

import pytest
from virtual_campaign import fitted, measured_campaign

import tissue_sim as ts
from calibration.effects.catalogue import CATALOGUE
from calibration.effects.effect import Effect, NotTestableError
from tissue_sim.rig.fault import FAULTS


@pytest.fixture
def cable(plugin, registers):
    module = plugin("cable_spring")
    registers(FAULTS, module.CableSpring)
    return registers(CATALOGUE, module.CablePull)


def test_it_is_found_where_it_is_hidden(cable, tmp_path):
    """A cable of 20 N/m beside tests of 200 to 900 N/m; of the rig's other effects none explains as much."""
    values = {"rig.faults.cable_spring.stiffness": 20.0}
    study = fitted(measured_campaign(tmp_path, lambda name, model: cable().apply(model, values)))
    candidate, = CATALOGUE["cable_pull"]().candidates(study.situation)
    score = study.score(candidate)
    assert score > 5.0
    for name, kind in CATALOGUE.items():
        if kind.room == "rig" and name not in ("cable_pull", "step_loss", "inertia", "machine_compliance"):
            assert max(abs(study.score(other)) for other in kind().candidates(study.situation)) < score, name


def test_a_name_that_is_taken_is_refused(cable):
    with pytest.raises(ts.InputError, match="'tilt' is taken"):
        CATALOGUE.register(cable, "tilt")
    with pytest.raises(ts.InputError, match=r"derives from calibration\.effects\.effect\.Effect"):
        CATALOGUE.register(object, "nothing")


def test_an_effect_says_what_tests_cannot_hold():
    class Nowhere(Effect):
        name, room, title, signature, separated_by = "nowhere", "rig", "nothing", "none at all", "nothing at all"

        def candidates(self, situation):
            raise NotTestableError("there is nothing to look at")

    with pytest.raises(NotTestableError, match="nothing to look at"):
        Nowhere().candidates(None)
