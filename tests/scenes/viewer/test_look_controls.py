"""The tab with what the picture shows: fields that a solver does not know are never asked of it."""

from types import SimpleNamespace

import pytest
import viser

import tissue_sim as ts
from scenes.field_labels import LABELS
from scenes.viewer.page.look_controls import LookControls

KNOWN = ("displacement", "von_mises", "J", "stretch")


def frame(fields=None):
    experiment = SimpleNamespace(tool=ts.Tool("flat", radius=8e-3), specimen=ts.Specimen(0.03, 0.02),
                                 tool_pose=ts.Pose.at_depth)
    snapshot = None if fields is None else SimpleNamespace(fields=fields, in_space=True)
    return SimpleNamespace(scene=SimpleNamespace(half_width=0.03, experiment=experiment), snapshot=snapshot)


@pytest.fixture
def controls():
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        yield LookControls(server, frame(), 1.0)
    finally:
        server.stop()


def choose(controls, name):
    """As a browser does, whose list may be an old one."""
    controls._field._impl.value = LABELS[name][0]
    for told in controls._field._impl.update_cb:
        told(SimpleNamespace(client=None))


@pytest.mark.parametrize("when", ["before", "after"])
def test_a_field_that_is_not_known_is_not_shown(controls, when):
    if when == "before":
        choose(controls, "pressure")
        assert controls.look.field == "pressure"
    controls.show(frame(SimpleNamespace(names=KNOWN)))
    if when == "after":
        choose(controls, "J")
        choose(controls, "energy")
        assert controls.look.field == "J"
    controls.show(frame(SimpleNamespace(names=KNOWN)))
    assert controls.look.field in KNOWN
    assert set(controls._field.options) == {LABELS[name][0] for name in KNOWN}


def test_all_fields_come_back(controls):
    controls.show(frame(SimpleNamespace(names=KNOWN)))
    controls.show(frame(SimpleNamespace(names=tuple(LABELS))))
    choose(controls, "energy")
    assert controls.look.field == "energy" and len(controls._field.options) == len(LABELS)
