"""The page of a solid in space: it comes up, the tool goes off the axis, and the picture follows."""

import math

import numpy as np
import pytest

from scenes.viewer.page.solid import DRAGS, SIZE

#: Units of the browser in a metre.
UNIT = SIZE / 0.08
#: Of the tool, rad; see `shown_solid`.
LEAN = math.radians(10.0)


@pytest.mark.slow
def test_a_tool_goes_off_the_axis_of_a_solid_and_the_picture_follows(shown_solid, open_page, chromium, reader_of):
    page = open_page(shown_solid, width=1200, height=760, triangles=300)
    reader = reader_of(page, shown_solid)
    reader.phase("running")
    reader.tab("Motion")
    # The tool leans and stands aside, as it was asked for at the start.
    reader.until(lambda: reader.field("x [mm]").input_value(), lambda value: value == "8")
    assert reader.field("y [mm]").input_value() == "0"
    seen = [page.locator("canvas").first.screenshot()]
    reader.enter("y [mm]", "-2")
    moved = reader.until(lambda: shown_solid.frame.snapshot.pose.position, lambda place: abs(place[1] + 2e-3) < 1e-6)
    assert moved[0] == pytest.approx(8e-3, abs=1e-6)
    chromium.wait_for_picture(page)
    seen.append(page.locator("canvas").first.screenshot())
    # Deeper, as a hand would by the slider, along the axis that leans towards +x.
    reader.enter("depth [mm]", "1.5")
    moved = reader.until(lambda: shown_solid.frame.snapshot.pose, lambda pose: pose.depth > 1.45e-3)
    assert moved.position[0] > 8e-3 + 0.9 * np.tan(np.radians(10.0)) * 1.45e-3
    reader.wait_for("solution", "in equilibrium")
    assert reader.number("force") > 0.005
    across = [float(part.split()[0]) for part in reader.read("across").split(" and ")]
    assert len(across) == 2 and abs(across[0]) > 0.0005, "a tool that leans is pushed aside"
    # The cut is turned about the tool.
    reader.tab("View")
    reader.enter("cut turned [°]", "60")
    chromium.wait_for_picture(page)
    reader.until(lambda: page.locator("canvas").first.screenshot(), lambda picture: picture not in seen)
    assert len(set(seen)) == 2


@pytest.mark.slow
def test_a_mouse_drags_the_tool_sideways(shown_solid, open_page, reader_of):
    page = open_page(shown_solid, width=1200, height=760, triangles=300)
    reader = reader_of(page, shown_solid)
    reader.phase("running")
    shown_solid.ask("reset")
    reader.tab("Motion")
    shown_solid.ask("aim", depth=-2e-3)
    start = reader.until(lambda: np.array(shown_solid.frame.snapshot.pose.position), lambda place: place[2] > 1.9e-3)
    reader.choose("mouse moves it", next(words for words, way in DRAGS.items() if way == "sideways"))
    reader.until(lambda: shown_solid.page._solid.drag_way, lambda way: DRAGS[way] == "sideways")
    held = start + np.array([0.0, 0.0, 12e-3])  # on the shaft
    aside = np.array([-5e-3, -4e-3, 0.0])
    mouse = page.mouse
    mouse.move(*reader.place(held * UNIT))
    mouse.down()
    for share in (0.3, 0.6, 1.0):
        mouse.move(*reader.place((held + share * aside) * UNIT))
    wanted = start[:2] + aside[:2]
    reader.until(lambda: np.array(shown_solid.frame.across) - np.array([math.tan(LEAN) * 2e-3, 0.0]),
                 lambda place: np.hypot(*(place - wanted)) < 0.2 * np.hypot(*aside[:2]))
    mouse.up()
    assert shown_solid.frame.target == pytest.approx(-2e-3, abs=1e-4), "as deep as it was"
    end = reader.until(lambda: np.array(shown_solid.frame.snapshot.pose.position),
                       lambda place: np.hypot(*(place - start)[:2]) > 2e-3)
    assert end[2] == pytest.approx(start[2], abs=1e-4)


@pytest.mark.slow
def test_a_reduced_solid_is_coloured_by_what_is_known_of_it(shown_reduced, open_page, chromium, reader_of):
    page = open_page(shown_reduced, width=1200, height=1000, triangles=300)
    reader = reader_of(page, shown_reduced)
    reader.phase("running")
    reader.tab("Motion")
    reader.enter("depth [mm]", "1.5")
    reader.until(lambda: shown_reduced.frame.snapshot.pose, lambda pose: pose.depth > 1.45e-3)
    reader.until(lambda: shown_reduced.page._solid.levels, lambda levels: levels is not None and levels[-1] > 0.5)
    chromium.wait_for_picture(page)
    # Without a pressure, neither pressure nor stresses along an axis are offered.
    assert shown_reduced.page._look._field.options == ("von Mises stress [kPa]", "displacement [mm]",
                                                       "largest stretch", "volume ratio J")


@pytest.mark.slow
def test_a_reduced_block_is_seen_and_its_tool_stays_in_the_box(shown_block, open_page, reader_of):
    page = open_page(shown_block, width=1200, height=760, triangles=100)
    reader = reader_of(page, shown_block)
    reader.phase("running")
    reader.tab("Motion")
    reader.until(lambda: reader.field("x [mm]").input_value(), lambda value: value == "2")
    reader.enter("depth [mm]", "1.2")
    reader.until(lambda: shown_block.frame.readouts.depth, lambda depth: abs(depth - 1.2e-3) < 1e-6)
    # Farther than the box reaches, and above what the tool holds.
    reader.enter("y [mm]", "-7")
    reader.until(lambda: shown_block.frame.snapshot.pose.position,
                 lambda place: np.abs(np.array(place) - [2e-3, -1e-3, -1.2e-3]).max() < 1e-6)
    reader.wait_for("solution", "in equilibrium")
    assert reader.number("force") > 0.05 and shown_block.frame.readouts.across[1] > 0.01
    reader.enter("depth [mm]", "-3")
    reader.until(lambda: shown_block.frame.readouts.depth, lambda depth: abs(depth) < 1e-9)
    assert shown_block.frame.target == 0.0
    # Examples do not lift it, and what would is refused.
    assert reader.field("protocol").input_value() == "ramp 2mm; hold 1s; unload"
    told = []
    shown_block.session.post("play", text="approach 2mm; ramp 2mm", reply=told.append)
    reader.until(lambda: list(told), len)
    assert "a reduced solid that it holds cannot be lifted" in told[0]
