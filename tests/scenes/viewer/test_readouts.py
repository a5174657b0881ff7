"""HTML texts of the page, parsed without a browser."""

from dataclasses import replace
from types import SimpleNamespace
from xml.etree import ElementTree

import pytest

import tissue_sim as ts
from scenes.viewer.frame import Phase, PlotCurves, SessionFrame, SimulationReadouts
from scenes.viewer.page.readouts import (
    LargestLiveModelDifference,
    largest_live_model_difference_html,
    model_rmse_html,
    readouts_html,
    scene_title_html,
    status_html,
)
from scenes.viewer.scene import Scene
from tissue_sim.experiment.kinds.standard_tests import NEEDLE

NOW = SimulationReadouts(time=3.0, depth=5.678e-3, force=1.2344, stiffness=211.0, step_time=0.31e-3, iterations=0.84,
                         rate=999.7,
                         late=0.0042, status="in equilibrium", mesh="realtime_63, force within 1.1 %", unconverged=3)
FRAME = SessionFrame(Phase.RUNNING, "running", None, None, NOW, PlotCurves(), "protocol", 0.0)


def texts(html):
    """Text of each element with a test id."""
    return {part.get("data-testid"): "".join(part.itertext())
            for part in ElementTree.fromstring(html.replace("&nbsp;", " ")).iter() if part.get("data-testid")}


def test_readouts_have_display_units():
    assert texts(readouts_html(FRAME)) == {
        "force": "1.234", "depth": "5.68", "stiffness": "0.211 N/mm", "step-time": "0.31 ms",
        "iterations": "0.8 per tick", "rate": "1000 Hz", "late": "0.42 %", "solution": "in equilibrium",
        "doubtful": "3 in the last second", "mesh": "realtime_63, force within 1.1 %"}


def test_a_force_without_equilibrium_is_marked_in_red():
    unreliable = replace(NOW, status="stopped", warning="no equilibrium: move <back>")
    shown = readouts_html(replace(FRAME, readouts=unreliable))
    assert texts(shown)["badge"] == "STOPPED" and texts(shown)["solution"] == "stopped"
    assert "#C0392B" in shown and 'title="no equilibrium: move &lt;back&gt;"' in shown
    assert "badge" not in texts(readouts_html(FRAME))


def test_numbers_of_a_stopped_simulation_are_grey_and_marked_as_old():
    shown = readouts_html(replace(FRAME, phase=Phase.DIED))
    assert texts(shown)["badge"] == "old" and "opacity:0.45" in shown and "#C0392B" not in shown
    assert "opacity:0.45" not in readouts_html(FRAME)
    assert "badge" not in texts(readouts_html(replace(FRAME, phase=Phase.DIED, readouts=None)))


def test_readouts_are_dashes_before_the_first_tick():
    assert set(texts(readouts_html(replace(FRAME, readouts=None))).values()) == {"–"}


def test_zero_has_no_minus_sign():
    shown = texts(readouts_html(replace(FRAME, readouts=replace(NOW, force=-1e-6, depth=-1e-9, stiffness=-1e-3))))
    assert (shown["force"], shown["depth"], shown["stiffness"]) == ("0.000", "0.00", "0.000 N/mm")


@pytest.mark.parametrize(("motion", "words"), [("hand", "running · by hand"), ("protocol", "running · protocol"),
                                               ("recording", "running · measured motion")])
def test_the_status_names_phase_and_motion(motion, words):
    assert texts(status_html(replace(FRAME, motion=motion))) == {"phase": words}


def test_messages_are_escaped_in_html():
    shown = status_html(replace(FRAME, phase=Phase.DIED, message="killed by <signal 9> & so on"))
    assert texts(shown) == {"phase": "stopped", "message": "killed by <signal 9> & so on"}
    assert 'data-phase="died"' in shown


def test_the_start_shows_its_present_activity():
    loading = replace(FRAME, phase=Phase.STARTING, message="loading the solver", readouts=None)
    assert texts(status_html(loading)) == {"phase": "starting", "message": "loading the solver"}
    assert texts(status_html(replace(loading, message="starting"))) == {"phase": "starting"}


def test_agreement_shows_the_rmse_or_what_is_missing():
    flat = SimpleNamespace(experiment=SimpleNamespace(tool=ts.Tool("flat", 8e-3)))
    frame = replace(FRAME, scene=flat)
    measured = SimpleNamespace(replicate_force_rms_scatter=0.0172, describe_deviating_tool_or_empty=lambda tool: "")
    gap = SimpleNamespace(rmse=0.02034, samples=303)
    assert "--measured FILE" in texts(model_rmse_html(FRAME))["agreement"]
    waiting = replace(FRAME, curves=PlotCurves(measurement=measured))
    assert "being computed" in texts(model_rmse_html(waiting))["agreement"]
    shown = texts(model_rmse_html(replace(frame, curves=PlotCurves(measurement=measured, residual=gap))))
    assert shown["rmse"] == "0.020" and "303 samples, noise 0.017 N" in shown["agreement"]
    alone = SimpleNamespace(replicate_force_rms_scatter=None,
                            describe_deviating_tool_or_empty=lambda tool: "cone of 3 mm radius")
    single = texts(model_rmse_html(replace(frame, curves=PlotCurves(measurement=alone, residual=gap))))
    assert ", noise" not in single["agreement"] and "other-tool" not in shown
    assert single["other-tool"] == "measured with another tool: cone of 3 mm radius"
    computing = PlotCurves(measurement=measured, residual=gap, computing=True)
    old = texts(model_rmse_html(replace(frame, curves=computing)))
    assert old["rmse"] == "0.020" and "of the previous model" in old["agreement"] and "old-curve" not in shown


@pytest.mark.parametrize("shape", ["flat", "sphere"])
def test_the_title_names_test_specimen_tool_and_material(shape):
    tool, friction = ts.Tool(shape, 8e-3), "bonded" if shape == "flat" else 0.3
    experiment = NEEDLE.experiment(specimen=ts.Specimen(0.04, 0.07), tool=tool, friction=friction,
                                   protocol=ts.Protocol.ramp(4e-3, 5))
    material = ts.Material("neo_hooke", {"C10": 500.0}, ts.Bulk("bulk_ratio", 1e4))
    said = texts(scene_title_html(Scene(NEEDLE, experiment, material, "<m>.json")))["title"]
    assert said.startswith("Needle indentation, cylinder \u2300 80 \u00d7 70 mm")
    assert f"{shape}, tool radius 8 mm" in said and "<m>.json" in said
    assert ("bonded" in said) is (shape == "flat") and ("friction 0.3" in said) is (shape == "sphere")


def test_the_gap_to_the_model_names_its_causes():
    assert largest_live_model_difference_html(None) == ""
    fast = texts(largest_live_model_difference_html(LargestLiveModelDifference(0.1234, 3.35e-3, 20e-3, 0.012,
                                                                               0.8)))["live-gap"]
    assert fast == ("live \u2212 model: up to 0.123 N at 3.35 mm; at 20 mm/s the inertia of the tissue contributes; "
                    "1.2% of the points are extrapolated by late ticks (grey)")
    slow = texts(largest_live_model_difference_html(LargestLiveModelDifference(-0.001, 1e-3, 1e-3, 0.0,
                                                                               0.0)))["live-gap"]
    assert slow == "live \u2212 model: up to -0.001 N at 1 mm"
    # Quasi-static tissue has no inertia at any speed.
    assert "inertia" not in largest_live_model_difference_html(LargestLiveModelDifference(0.1, 1e-3, 20e-3, 0.0, 0.0))
