"""View tab: the list of fields contains only the fields that the solver computes."""

from types import SimpleNamespace

import pytest
import viser

import tissue_sim as ts
from scenes.field_labels import LABELS
from scenes.viewer.page.view_controls import ViewControls

KNOWN = ("displacement", "von_mises", "J", "stretch")


def frame(fields=None):
    """Minimal frame of a scene whose snapshot has these fields."""
    experiment = SimpleNamespace(tool=ts.Tool("flat", radius=8e-3), specimen=ts.Specimen(0.03, 0.02),
                                 tool_pose=ts.Pose.at_depth)
    snapshot = None if fields is None else SimpleNamespace(drawable_fields=fields, is_three_dimensional=True)
    return SimpleNamespace(scene=SimpleNamespace(specimen_outer_radius=0.03, experiment=experiment), snapshot=snapshot)


@pytest.fixture
def controls():
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        yield ViewControls(server, frame(), 1.0)
    finally:
        server.stop()


def choose(controls, name):
    """Choose a field as a browser does, whose list may be outdated."""
    controls._field._impl.value = LABELS[name][0]
    for callback in controls._field._impl.update_cb:
        callback(SimpleNamespace(client=None))


@pytest.mark.parametrize("when", ["before", "after"])
def test_an_unavailable_field_is_not_displayed(controls, when):
    if when == "before":
        choose(controls, "pressure")
        assert controls.options.field == "pressure"
    controls.update_controls(frame(SimpleNamespace(names=KNOWN)))
    if when == "after":
        choose(controls, "J")
        choose(controls, "energy")
        assert controls.options.field == "J"
    controls.update_controls(frame(SimpleNamespace(names=KNOWN)))
    assert controls.options.field in KNOWN
    assert set(controls._field.options) == {LABELS[name][0] for name in KNOWN}


def test_all_fields_return_with_a_solver_that_computes_them(controls):
    controls.update_controls(frame(SimpleNamespace(names=KNOWN)))
    controls.update_controls(frame(SimpleNamespace(names=tuple(LABELS))))
    choose(controls, "energy")
    assert controls.options.field == "energy" and len(controls._field.options) == len(LABELS)
