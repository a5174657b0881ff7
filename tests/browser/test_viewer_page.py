"""Page of the viewer in a browser: display, motion of the tool, and control of the picture."""

import os
import signal
from dataclasses import replace

import numpy as np
import pytest

from scenes.field_labels import LABELS
from scenes.viewer.bands import compute_displayed_srgb
from scenes.viewer.page.readouts import readouts_html
from scenes.viewer.page.solid import SIZE
from scenes.viewer.plots import make_depth_grid

FAULT = "ramp 3mm; wander 2s"


def hexadecimal(colour):
    return "#{:02x}{:02x}{:02x}".format(*colour)


def test_the_page_loads_offline_with_measurement_model_and_residual(shown, reader):
    page = reader.page
    reader.phase("running")
    assert page.title() == "tissue_sim"
    assert reader.read("phase") == "running · by hand"
    assert (reader.read("depth"), reader.read("force")) == ("0.00", "0.000")
    page.get_by_text("measured (3)").wait_for()
    # The measurement is the model plus noise, so the RMSE is the noise.
    rmse = reader.until(lambda: reader.number("rmse"), lambda rmse: rmse > 0)
    assert rmse == pytest.approx(shown.frame.curves.residual.rmse, abs=6e-4)
    assert rmse == pytest.approx(0.02, rel=0.3)
    force, residual, _ = reader.until(reader.curves, lambda plots: len(plots[0]["model load"]) > 100)
    assert len(force["measured load"]) > 100 and max(force["measured load"]) == pytest.approx(
        max(force["model load"]), rel=0.1)
    assert len(residual["load"]) > 100 and max(map(abs, residual["load"])) < 5 * rmse
    assert [page.locator(".uplot canvas").nth(number).is_visible() for number in range(3)] == [True] * 3
    assert {url.split("/")[2] for url in reader.traffic.urls if not url.startswith(("blob:", "data:"))} == {
        f"127.0.0.1:{shown.page.server.get_port()}"}


def test_bar_and_section_have_the_same_colours_and_the_label_of_the_field(shown, reader):
    page = reader.page
    reader.tab("View")
    field = "displacement"
    reader.choose("colour", LABELS[field][0])
    page.get_by_test_id("colour-bar").filter(has_text=LABELS[field][0]).wait_for()
    bar = page.locator("[data-colour]").evaluate_all("blocks => blocks.map(block => block.dataset.colour)")
    painted = page.evaluate("""() => {
        const nodes = window.__viserSceneTree.getState();
        return Object.keys(nodes).filter(name => name.startsWith("/tissue/band_")).sort()
            .map(name => nodes[name].message.props.color);
    }""")
    assert len(set(bar)) == len(bar) == len(painted) > 5
    assert bar == [hexadecimal(compute_displayed_srgb(colour)) for colour in painted]
    shown.ask("aim", depth=2e-3)
    reader.wait_for("depth", "2.00")
    title = page.locator("[data-colour]").last
    # The tool has moved 2 mm, so the largest displacement is about 2 mm.
    reader.until(lambda: title.get_attribute("title"), lambda words: 1.0 < float(words.split()[-1]) <= 2.0)


def test_a_warning_does_not_move_the_controls_below_it(shown, reader):
    # A button that moves between press and release of the mouse loses the click.
    last = reader.until(lambda: shown.frame, lambda frame: frame.readouts is not None)
    heights = []
    for warning in ("", "The force is late."):
        now = replace(last, readouts=replace(last.readouts, status="inaccurate", warning=warning))
        heights.append(reader.page.evaluate("""html => {
            const probe = document.body.appendChild(document.createElement("div"));
            Object.assign(probe.style, {position: "absolute", width: "360px"});
            probe.innerHTML = html;
            const height = probe.getBoundingClientRect().height;
            probe.remove();
            return height;
        }""", readouts_html(now)))
    assert heights[0] == heights[1] > 100


@pytest.mark.slow
def test_the_mouse_drags_the_tool(shown, reader):
    camera = reader.client.camera.position
    mouse, unit = reader.page.mouse, SIZE / (2.0 * shown.scene.experiment.specimen.radius)
    held, down = 4e-3, 3e-3  # above the face of the tool, and how far, m
    x, y = reader.place((0.0, 0.0, held * unit))
    mouse.move(x, y)
    mouse.down()
    for share in (0.3, 0.6, 1.0):
        mouse.move(*reader.place((0.0, 0.0, (held - share * down) * unit)))
    reader.until(lambda: shown.frame.target, lambda depth: depth == pytest.approx(down, rel=0.25))
    mouse.up()
    reader.wait_for("depth", f"{shown.frame.target * 1e3:.2f}")
    assert reader.number("force") > 0.2
    assert shown.frame.motion == "hand"
    np.testing.assert_array_equal(reader.client.camera.position, camera)
    reader.until(reader.curves, lambda plots: len(plots[0]["live load"]) > 50)


@pytest.mark.slow
def test_the_slider_moves_the_tool_and_shows_its_depth(shown, reader):
    reader.enter("depth [mm]", "3.5")
    reader.wait_for("depth", "3.50")
    reader.until(lambda: reader.number("force"),  # the words are a frame older than the tool, which swings to rest
                 lambda force: force > 0.5 and force == pytest.approx(shown.frame.readouts.force, abs=0.02))
    thumb = reader.slider("depth [mm]")
    for _ in range(3):
        thumb.press("ArrowLeft")
    reader.wait_for("depth", "3.47")
    assert reader.field("depth [mm]").input_value() == "3.47"
    shown.ask("aim", depth=1e-3)
    reader.wait_for("depth", "1.00")
    reader.until(lambda: reader.field("depth [mm]").input_value(), lambda value: value == "1")


def at_rest(reader):
    """Return a condition: the loop is paused, and the page shows its depth."""
    def at_rest(now):
        return now.status == "paused" and reader.read("depth") == f"{now.depth * 1e3:.2f}"
    return at_rest


@pytest.mark.slow
def test_a_protocol_is_played_paused_stepped_and_reset(shown, reader):
    # Slow enough to be still moving when a busy machine presses the button.
    reader.fill("protocol", "ramp 4mm @0.05mm/s")
    reader.press("Play")
    reader.page.get_by_test_id("phase").filter(has_text="running · protocol").wait_for()
    reader.until(lambda: reader.number("depth"), lambda depth: depth > 0.05)
    reader.press("Pause")
    reader.phase("paused")
    # Wait until the read-outs show the position of the paused tool.
    standing = reader.until(lambda: shown.frame.readouts, at_rest(reader)).depth
    assert 0.05e-3 < standing < 4e-3
    assert shown.frame.readouts.depth == standing
    reader.press("Step")
    stepped = reader.until(lambda: shown.frame.readouts,
                           lambda now: now.depth > standing + 1.25e-6 and at_rest(reader)(now)).depth
    assert stepped < standing + 2.5e-6, "a frame of 0.05 mm/s is 0.0017 mm"
    reader.phase("paused")
    reader.press("Play")
    reader.phase("running")
    reader.until(lambda: shown.frame.readouts.depth, lambda depth: depth > stepped + 0.01e-3)
    reader.press("Reset")
    reader.page.get_by_test_id("phase").filter(has_text="running · by hand").wait_for()
    reader.fill("protocol", "ramp 4mm @2mm/s; hold 600s; unload")
    reader.press("Play")
    reader.wait_for("depth", "4.00")
    assert reader.read("phase") == "running · protocol"
    # On a busy machine some forces of the loading are late, so the page is compared with the frame.
    grid = make_depth_grid(shown.scene.max_tool_displacement)

    def compute_loading():
        force, _ = shown.frame.curves.trace.interpolate_newest_force_at_each_depth(grid)
        return force[np.isfinite(force)]

    live = reader.until(lambda: reader.curves()[0]["live load"],
                        lambda live: len(live) > 100 and live == pytest.approx(compute_loading()))
    if not shown.frame.curves.trace.is_late.any():
        assert max(live) >= 0.98 * shown.frame.readouts.force
    reader.press("Reset")
    reader.wait_for("depth", "0.00")
    assert reader.read("phase") == "running · by hand"
    reader.until(lambda: reader.curves()[0]["live load"], lambda live: len(live) < 3)


@pytest.mark.slow
def test_an_invalid_protocol_is_refused_with_a_message(shown, reader):
    import tissue_sim as ts

    with pytest.raises(ts.InputError) as fault:
        ts.Protocol.parse(FAULT, 21, 5e-3)
    reader.fill("protocol", FAULT)
    reader.press("Play")
    reader.answer(str(fault.value))
    reader.fill("protocol", "ramp 9mm")
    reader.press("Play")
    reader.answer("must have a depth of at most 5 mm")
    assert reader.read("phase") == "running · by hand"
    assert reader.read("depth") == "0.00"
    assert max(shown.frame.curves.trace.depth, default=0.0) < 1e-6


@pytest.mark.slow
def test_two_browsers_share_everything_except_the_camera_and_a_reload_restores_it(shown, reader, another):
    one, other = reader, another
    one.fill("protocol", "ramp 1.5mm; hold 60s")
    one.tab("View")
    one.enter("cut-away [°]", "60")
    one.choose("colour", LABELS["energy"][0])
    before = other.client.camera.position
    one.press("Top")
    reached = one.until(lambda: one.client.camera.position, lambda place: place[2] > 1.5 * before[2])
    assert np.hypot(*reached[:2]) < 0.1 * reached[2]
    np.testing.assert_array_equal(other.client.camera.position, before)
    one.tab("Motion")
    one.enter("depth [mm]", "2.5")
    for reader in (one, other):
        reader.wait_for("depth", "2.50")
        reader.page.get_by_test_id("colour-bar").filter(has_text=LABELS["energy"][0]).wait_for()
    other.until(lambda: (one.read("force"), other.read("force")), lambda forces: forces[0] == forces[1])
    assert other.number("force") == pytest.approx(shown.frame.readouts.force, abs=0.02)
    other.reload()
    other.wait_for("depth", "2.50")
    assert other.field("depth [mm]").input_value() == "2.5"
    assert other.field("protocol").input_value() == "ramp 1.5mm; hold 60s"
    other.tab("View")
    assert other.field("cut-away [°]").input_value() == "60"
    assert other.field("colour").input_value() == LABELS["energy"][0]


def test_the_page_switches_between_dark_and_light(reader):
    scheme = "() => document.documentElement.dataset.mantineColorScheme"
    reader.tab("View")
    stroke = "() => Object.values(window.__viserTestpoints.uplots)[0].chart.series.at(-1)._stroke"
    light = reader.page.evaluate(stroke)
    for expected in ("dark", "light"):
        reader.tick("dark page")
        reader.until(lambda: reader.page.evaluate(scheme), lambda seen, expected=expected: seen == expected)
        reader.until(lambda: reader.page.evaluate(stroke),
                     lambda seen, expected=expected: (seen == light) == (expected == "light"))


@pytest.mark.slow
def test_a_valid_scene_is_applied_and_a_killed_simulation_can_be_restarted(shown, reader):
    reader.tab("Scene")
    reader.choose("tool", "flat")
    reader.choose("tool's face", "frictionless")
    reader.until(lambda: reader.field("edge radius [mm]").input_value(), lambda seen: seen == "0.5")
    reader.enter("edge radius [mm]", "0")
    simulation, scene = shown.session.simulation, shown.session.scene
    reader.press("Apply")
    reader.answer("edge_radius")
    assert shown.session.simulation is simulation and shown.session.scene is scene
    reader.choose("tool's face", "bonded")
    reader.choose("tool", "sphere")
    reader.until(lambda: reader.field("tool's face").input_value(), lambda seen: seen == "stick")
    reader.choose("tool's face", "frictionless")
    reader.enter("tool radius [mm]", "6")
    reader.press("Apply")
    reader.phase("starting")
    reader.phase("running")
    tool = shown.session.scene.experiment.tool
    assert (tool.shape, tool.radius) == ("sphere", pytest.approx(6e-3))
    assert shown.session.scene.experiment.friction == "frictionless"

    os.kill(shown.session.simulation.haptic_loop_process.pid, signal.SIGKILL)
    reader.phase("died")
    message = reader.read("message")
    assert "killed by signal 9" in message and message.endswith("Press Restart to begin again.")
    reader.press("Restart")
    reader.phase("starting")
    reader.phase("running")
    assert shown.session.scene.experiment.tool is tool
    reader.tab("Motion")
    reader.enter("depth [mm]", "1")
    reader.wait_for("depth", "1.00")
    assert reader.page.get_by_role("button", name="Restart").count() == 0
