"""A solver from one file outside the packages in the viewer: fields, a full pose, a full wrench.

The session plays an oblique, turning path through a loop in its own process. What its trace keeps must be the wrench of
the solver alone at each pose, and what is drawn must stand where the tool stands.
"""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from waiting import wait_for_value

import tissue_sim as ts
from haptics.devices.back_ends import MOTIONS, make_motion
from scenes.cli import main
from scenes.viewer.frame import NullViewer, Phase
from scenes.viewer.live_simulation import SETTINGS
from scenes.viewer.page import Page
from scenes.viewer.page.readouts import readouts_html, status_html
from scenes.viewer.revolution import WedgeOpening
from scenes.viewer.scene import Scene
from scenes.viewer.session import Session
from scenes.viewer.solid_body import Wedge
from tissue_sim.experiment.kinds.standard_tests import NEEDLE
from tissue_sim.fem.solver import SOLVERS
from tissue_sim.pose import Pose, compute_rigid_motion

MATERIAL = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3))
CHANNELS = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
#: As many points of the trace as show a path.
ENOUGH = 40
#: How deep the spiral goes, m.
AXIS_DEPTH = 0.8 * 4e-3


@pytest.fixture
def spring(plugin, registers):
    module = plugin("spring_solver")
    registers(SOLVERS, module.SpringSolver, "spring")
    return module


@pytest.fixture
def spiral(plugin, registers):
    module = plugin("spiral_motion")
    registers(MOTIONS, module.open_spiral, "spiral")
    return make_motion("spiral:reach_mm=4")


@pytest.fixture
def scene(spring):
    experiment = NEEDLE.experiment(specimen=ts.Specimen(0.04, 0.07), protocol=ts.Protocol.ramp(4e-3, 9))
    return Scene(NEEDLE, experiment, MATERIAL, solver="spring")


@pytest.fixture
def plain_scene(scene, plugin, registers):
    """The scene with a solver without fields."""
    registers(SOLVERS, plugin("plain_spring").PlainSpringSolver, "plain_spring")
    return replace(scene, solver="plain_spring")


@pytest.fixture
def shown(scene, spiral, monkeypatch):
    """The session, a frame after the tool was pressed in and removed, with a filled trace, and all ticks of the loop
    up to this frame."""
    # No step ends for want of time: the same poses give the same wrenches.
    monkeypatch.setattr("scenes.viewer.live_simulation.BUDGET", None)
    session = Session(scene, settings=replace(SETTINGS, real_time=False))
    viewer, problems, caught = NullViewer(), [], []
    try:
        wait_for_value(session.update_and_make_frame, lambda frame: frame.phase is not Phase.STARTING)
        ring = session.simulation.haptic_loop_process.open_ring_reader()
        session.post("follow", device=spiral, reply=problems.append)

        def seen():
            viewer.show(session.update_and_make_frame())
            caught.append(ring.read_ticks_after(caught[-1].number if caught else 0))
            return viewer.latest

        def fits(frame):
            trace = frame.curves.trace
            return (problems and len(trace) >= ENOUGH and trace.depth.max() > 0.95 * AXIS_DEPTH
                    and trace.get_newest_loading_and_unloading()[1] is not None and frame.snapshot.depth > 1e-3)

        frame = wait_for_value(seen, fits)
        ring.close()
        assert not any(ticks.lost for ticks in caught)
        yield session, frame, np.concatenate([ticks.records for ticks in caught])
    finally:
        session.close()
    assert problems == [None]


def test_pose_and_wrench_come_unchanged_into_the_trace(spring, scene, shown):
    """Every pose of the loop, in a simulator of this process: the slider's way depends on all of them."""
    _, frame, ticks = shown
    twin, wrenches = ts.Simulator(scene.model, solver="spring"), {}
    for at, pose in zip(ticks["time"].tolist(), ticks["tool_pose"].tolist(), strict=True):
        wrenches[at] = twin.step(Pose(tuple(pose[:3]), tuple(pose[3:])), 1e-3).wrench
    trace = frame.curves.trace
    expected = np.array([wrenches[at] for at in trace.time.tolist()])
    np.testing.assert_allclose(trace.wrench, expected, rtol=0, atol=1e-12 * abs(expected).max())
    np.testing.assert_array_equal(trace.force, trace.wrench[:, 2])
    assert abs(expected).max(axis=0).min() > 1e-6, "every component is in use"
    assert np.hypot(*expected[:, :2].T).max() == pytest.approx(spring.LIMIT), "the slider has given way"


@pytest.mark.slow
def test_the_path_is_that_of_the_motion(shown, plugin):
    """Along an oblique line, turning about it, as far as the way along it says."""
    axis, trace = np.array(plugin("spiral_motion").AXIS), shown[1].curves.trace
    way = trace.pose[:, :3] @ axis
    half = 0.5 * 2 * math.pi * 40.0 * way
    np.testing.assert_allclose(trace.pose[:, :3], way[:, None] * axis, rtol=0, atol=1e-12)
    np.testing.assert_allclose(trace.pose[:, 3:], np.column_stack([np.cos(half), np.sin(half)[:, None] * axis]), rtol=0,
                               atol=1e-12)
    np.testing.assert_array_equal(trace.depth, -trace.pose[:, 2])
    assert np.ptp(trace.pose, axis=0).min() > 1e-3


@pytest.mark.slow
def test_what_was_felt_is_saved_with_its_wrench(shown):
    trace = shown[1].curves.trace
    recording = trace.make_equilibrium_recording({"name": "spiral"})
    np.testing.assert_array_equal(np.stack([recording.channel(name) for name in CHANNELS], axis=1), trace.wrench)


@pytest.mark.slow
def test_what_is_drawn(spring, shown):
    """The tool at its full pose, the fields at this pose, and the force along z in the read-outs."""
    _, frame, _ = shown
    snapshot = frame.snapshot
    assert snapshot.drawable_fields is snapshot.fields and snapshot.skin is None and snapshot.datum == 0.0
    assert isinstance(snapshot.fields, spring.SpringFields) and frame.surface is None
    block = snapshot.fields.geometry()
    deepest = block.top[np.argmin(snapshot.node_positions[block.top, 2])]
    assert np.linalg.norm(snapshot.node_positions[deepest, :2] - snapshot.pose.position[:2]) < 0.01
    assert -snapshot.depth < snapshot.node_positions[deepest, 2] < -0.8 * snapshot.depth
    x, y, _, *turn = compute_rigid_motion(Pose.at_depth(0.0), snapshot.pose)
    assert math.hypot(x, y) > 1e-6 and math.hypot(*turn) > 1e-6, "oblique and turned"
    assert f'data-testid="force">{frame.readouts.force:.3f}<' in readouts_html(frame)
    assert "device" in status_html(frame)


@pytest.mark.slow
def test_the_curve_of_the_whole_test_is_of_that_solver(spring, shown):
    """Computed in another process, which must know the name."""
    session, *_ = shown
    model = wait_for_value(session.update_and_make_frame, lambda frame: frame.curves.model is not None).curves.model
    np.testing.assert_allclose(model.force, spring.STIFFNESS[2, 2] * model.displacement, rtol=1e-9)


@pytest.mark.slow
def test_the_page_draws_it(spring, scene, shown, tmp_path, monkeypatch):
    """Contents of the scene nodes without a browser: bands, section, mesh lines and the tool at its pose."""
    session, frame, _ = shown
    tissue = ts.Simulator(scene.model, solver="spring", inertia="off")
    tissue.step(Pose((2e-3, -1e-3, -3e-3), (math.cos(0.1), 0.0, math.sin(0.1), 0.0)), 1e-3)
    frame = replace(frame, snapshot=tissue.snapshot())
    page, sent = Page(session, frame, tmp_path, port=0), {}
    monkeypatch.setattr("scenes.viewer.page.solid.send_scene_node_arrays",
                        lambda handle, **arrays: sent.update({handle.name: arrays}))
    try:
        solid, options = page._solid, replace(page._look.options, field="energy", cut=180.0, mesh_lines=True)
        assert solid.draw_frame(frame, options)
        pose = frame.snapshot.pose
        np.testing.assert_allclose(solid._tool_frame.position, solid.scale * np.array(pose.position), rtol=1e-12)
        np.testing.assert_allclose(solid._tool_frame.wxyz, pose.orientation, rtol=1e-12)
        np.testing.assert_allclose(solid._force_frame.wxyz, [1, 0, 0, 0])
        assert solid.levels[0] <= 0.0 and solid.levels[-2] < frame.snapshot.fields.at_nodes("energy").max()
        assert not solid._surface.visible and len(sent["/tissue/mesh"]["points"]) > 1000
        positions, cells = frame.snapshot.node_positions, frame.snapshot.fields.geometry().cells
        volumes = np.linalg.det(positions[cells[:, 1:]] - positions[cells[:, :1]]) / 6.0
        wedge = Wedge(WedgeOpening(math.pi, math.radians(options.turn - 90.0)), pose)
        removed = wedge.are_tool_frame_points_inside(wedge.transform_scene_to_tool(positions[cells].mean(axis=1)))
        bands = [band for band in solid._bands if band.visible]
        assert len(bands) >= 5
        remaining = compute_enclosed_volume(sent[band.name] for band in bands)
        assert remaining == pytest.approx(volumes[~removed].sum(), rel=0.02) and removed.mean() > 0.3
        assert solid.draw_frame(frame, replace(options, cut=0.0))
        whole = compute_enclosed_volume(sent[band.name] for band in solid._bands if band.visible)
        assert whole == pytest.approx(volumes.sum(), rel=1e-5)
        assert not solid.draw_frame(frame, replace(options, cut=0.0)), "an unchanged frame is not sent again"
    finally:
        page.close()


def compute_enclosed_volume(meshes):
    """Return the volume inside the meshes of the page, m3, by the divergence theorem; they must be closed together."""
    volume, total, area = 0.0, np.zeros(3), 0.0
    for mesh in meshes:
        a, b, c = np.moveaxis(mesh["vertices"].astype(float)[mesh["faces"]], 1, 0)
        vectors = 0.5 * np.cross(b - a, c - a)
        volume += np.einsum("ti,ti->", vectors, a) / 3.0
        total, area = total + vectors.sum(axis=0), area + np.linalg.norm(vectors, axis=1).sum()
    assert np.linalg.norm(total) < 1e-5 * area
    return volume


@pytest.mark.slow
def test_the_page_lists_the_fields_of_the_solver(shown, tmp_path):
    session, frame, _ = shown
    page = Page(session, frame, tmp_path, port=0)
    try:
        page._look.update_controls(frame)
        assert page._look.options.field == "energy", "the first known field that the solver computes"
        assert set(page._look._field.options) == {"energy density [J/m³]", "displacement [mm]"}
    finally:
        page.close()


@pytest.mark.slow
def test_a_solver_without_fields_is_a_plain_surface(plain_scene, plugin, tmp_path):
    session = Session(plain_scene, settings=replace(SETTINGS, real_time=False))
    try:
        frame = wait_for_value(session.update_and_make_frame, lambda frame: frame.snapshot is not None)
        vertices, triangles = plugin("plain_spring").Square().triangles()
        np.testing.assert_allclose(frame.surface.vertices, vertices, rtol=1e-7)
        np.testing.assert_array_equal(frame.surface.faces, triangles)
        page = Page(session, frame, tmp_path, port=0)
        try:
            solid = page._solid
            assert solid.draw_frame(frame, page._look.options)
            assert solid._surface.visible and not any(band.visible for band in solid._bands)
            assert solid.levels is None, "a surface without a field has no colour scale"
            empty = frame.surface._replace(vertices=frame.surface.vertices[:0], faces=frame.surface.faces[:0])
            for surface in (empty, None):
                assert solid.draw_frame(replace(frame, surface=surface), page._look.options)
                assert not solid._surface.visible and solid._tool.visible, "the tool alone"
        finally:
            page.close()
    finally:
        session.close()


def test_empty_triangles_are_published(plain_scene, plugin, monkeypatch):
    """A solver may have no surface: the board holds a snapshot without numbers."""
    from haptics.loop.shared_slots import SnapshotReader, SnapshotWriter, find_unused_path

    monkeypatch.setattr(plugin("plain_spring").Square, "triangles", lambda surface, segments=48: ([], []))
    tissue = ts.Simulator(plain_scene.model, solver="plain_spring")
    pose = Pose((1e-3, 2e-3, -3e-3), (math.cos(0.1), 0.0, math.sin(0.1), 0.0))
    tissue.step(pose, 1e-3)
    pattern, path = tissue.snapshot(), find_unused_path("empty")
    with SnapshotWriter(path, pattern) as board:
        board.publish(0.5, pattern)
        with SnapshotReader(path, pattern) as reader:
            published = reader.latest()
    assert published.snapshot.pose == pose and published.snapshot.skin.vertices.shape == (0, 3)


@pytest.mark.slow
@pytest.mark.parametrize("words", [
    ["simulate", "needle_indentation", "--material", "{material}", "--depth-mm", "2"],
    ["loop", "--seconds", "0.2", "--no-real-time", "--motion", "spiral:reach_mm=2"],
    ["view", "--headless", "--seconds", "0.5", "--no-real-time", "--protocol", "ramp 1mm @20mm/s; hold 1s"],
], ids=lambda words: words[0])
def test_the_commands_take_its_name(words, spring, spiral, capsys, tmp_path):
    path = tmp_path / "m.material.json"
    ts.write_material_file(ts.MaterialFile.of(MATERIAL), path)
    words = [word.format(material=path) for word in words]
    assert main([*words, "--solver", "spring", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    if words[0] == "simulate":
        stiffness = spring.STIFFNESS[2, 2]
        np.testing.assert_allclose(answer["force_N"], stiffness * np.array(answer["displacement_mm"]) * 1e-3, rtol=1e-9)
    elif words[0] == "loop":
        assert answer["largest_force_N"] > 0.1
    else:
        depth, force = (np.array(answer[name]) for name in ("displacement_mm", "force_N"))
        assert depth.max() == pytest.approx(1.0, abs=1e-6)
        assert answer["phase"] == "running" and len(force) > 3


@pytest.mark.parametrize("words", [["simulate", "needle_indentation", "--material", "m"],
                                   ["loop"], ["view"], ["serve", "--material", "m"]], ids=lambda words: words[0])
def test_a_solver_that_is_not_there_is_refused(words, spring, capsys):
    assert main([*words, "--solver", "sprung"]) == 2
    assert capsys.readouterr().err == "tissue-sim: --solver: unknown solver 'sprung'; did you mean 'spring'?\n"


def test_a_figure_of_a_solver_without_fields_is_refused(plain_scene, capsys, tmp_path):
    material, figure = tmp_path / "m.material.json", tmp_path / "f.png"
    ts.write_material_file(ts.MaterialFile.of(MATERIAL), material)
    assert main(["simulate", "needle_indentation", "--material", str(material), "--depth-mm", "1", "--solver",
                 plain_scene.solver, "--figure", str(figure)]) == 2
    assert "fields with a geometry, which the solver 'plain_spring' does not provide" in capsys.readouterr().err
    assert not figure.exists()
