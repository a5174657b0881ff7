"""Draw the moving picture of a robot arm in MuJoCo: MUJOCO_GL=egl python docs/draw_arm_movie.py

The arm of `examples/mujoco_arm.py` presses a needle 10 mm into the specimen of the study, and leaves it. MuJoCo renders
the scene without a window; the surface of the tissue is a mesh whose vertices are replaced in each frame.
"""

import runpy
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

import tissue_sim as ts
from tissue_sim.realtime.engines.mujoco import MujocoTissue

ROOT = Path(__file__).parents[1]
#: Time between two frames, s; the picture plays at this speed.
FRAME_TIME = 0.1
#: Width and height of the rendered scene, pixels.
SCENE_SIZE = (400, 300)
#: Triangles around the axis of the tissue.
AROUND = 64
#: Colours of a frame: an indexed palette keeps the file small.
FRAME_COLOURS = 128
#: Heights of the tip, m, and their times, s.
HEIGHTS = ((0.0, 0.006), (0.3, 0.006), (2.0, -0.010), (2.6, -0.010), (4.0, 0.006), (4.3, 0.006))


def make_scene(mjcf: str, vertices: np.ndarray, faces: np.ndarray) -> mujoco.MjModel:
    """Compile the arm with the surface of the tissue."""
    def join(values: np.ndarray) -> str:
        return " ".join(f"{value:.9g}" for value in values.ravel())

    return mujoco.MjModel.from_xml_string(mjcf.replace("<worldbody>", f"""<asset>
        <texture type="skybox" builtin="flat" rgb1="1 1 1" rgb2="1 1 1" width="8" height="8"/>
        <mesh name="surface" vertex="{join(vertices)}" face="{join(faces)}"/></asset><worldbody>
        <light pos="-0.1 -0.6 0.8" dir="0.2 0.6 -0.8"/><geom type="mesh" mesh="surface" rgba=".92 .55 .5 1"/>"""))


class TissueMesh:
    """Mesh of the tissue in a MuJoCo model, which the compiler has moved to its own centre and principal axes."""

    def __init__(self, model: mujoco.MjModel, faces: np.ndarray):
        mesh, self._model, self._faces = model.mesh("surface").id, model, faces
        start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        self._vertices = model.mesh_vert[start:start + count]
        start, count = model.mesh_normaladr[mesh], model.mesh_normalnum[mesh]
        self._normals = model.mesh_normal[start:start + count]
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.mesh_quat[mesh])
        self._rotation, self._center = rotation.reshape(3, 3), model.mesh_pos[mesh].copy()

    def move(self, vertices: np.ndarray, renderer: mujoco.Renderer) -> None:
        """Replace the vertices, and the normals, which are means over the triangles of a vertex."""
        self._vertices[:] = (vertices - self._center) @ self._rotation
        a, b, c = (self._vertices[self._faces[:, corner]] for corner in range(3))
        normals, across = np.zeros_like(self._vertices), np.cross(b - a, c - a)
        for corner in range(3):
            np.add.at(normals, self._faces[:, corner], across)
        self._normals[:] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        mujoco.mjr_uploadMesh(self._model, renderer._mjr_context, 0)


def draw_frame(scene: np.ndarray, times: np.ndarray, forces: np.ndarray, sample: int, depth: float) -> Image.Image:
    """Draw the scene, and the force up to a sample."""
    figure = Figure(figsize=(7.6, 3.0), dpi=84, layout="constrained")
    left, curve = figure.subplots(1, 2, width_ratios=[1.2, 1.0])
    left.imshow(scene)
    left.set_axis_off()
    curve.plot(times, forces, color="0.85", linewidth=1.2)
    curve.plot(times[:sample + 1], forces[:sample + 1], color="#0072B2", linewidth=1.8)
    curve.plot(times[sample], forces[sample], "o", color="#D55E00", markersize=5)
    curve.set(xlabel="time [s]", ylabel="force on the arm [N]",
              title=f"{1e3 * max(depth, 0.0):4.1f} mm   {forces[sample]:4.2f} N")
    curve.grid(alpha=0.3)
    curve.spines[["top", "right"]].set_visible(False)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB").quantize(FRAME_COLOURS)


def main() -> None:
    example = runpy.run_path(str(ROOT / "examples" / "mujoco_arm.py"))
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
    simulator = ts.Simulator(ts.Model(ts.Experiment(
        ts.Specimen(0.040, 0.070), ts.Protocol.ramp(0.010, 2), ts.Tool("flat", radius=8e-3, edge_radius=1e-3),
        friction=0.3), material))
    simulator.warm_up()
    simulator.step(1e-6, 0.0)
    vertices, faces = simulator.surface().triangles(AROUND)
    simulator.reset()
    model = make_scene(example["MJCF"], np.asarray(vertices), np.asarray(faces))
    data, surface = mujoco.MjData(model), TissueMesh(model, np.asarray(faces))
    data.qpos[:] = example["solve_inverse_kinematics"](HEIGHTS[0][1])
    tissue = MujocoTissue(model, data, body="needle", tissue=simulator)
    renderer, camera = mujoco.Renderer(model, SCENE_SIZE[1], SCENE_SIZE[0]), mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (-0.05, 0.0, 0.02), 0.40, 110.0, -28.0
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
    every, scenes, depths, forces = round(FRAME_TIME / model.opt.timestep), [], [], []
    for number in range(round(HEIGHTS[-1][0] / model.opt.timestep)):
        height = np.interp(number * model.opt.timestep, *zip(*HEIGHTS, strict=True))
        data.ctrl[:] = example["solve_inverse_kinematics"](height)
        wrench = tissue.step()
        forces.append(wrench.force[2])
        depths.append(wrench.pose.depth)
        if number % every == 0:
            surface.move(np.asarray(simulator.surface().triangles(AROUND)[0]), renderer)
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            scenes.append(renderer.render())
    times = model.opt.timestep * np.arange(len(forces))
    frames = [draw_frame(scene, times, np.array(forces), every * number, depths[every * number])
              for number, scene in enumerate(scenes)]
    frames[0].save(ROOT / "docs" / "pictures" / "mujoco_arm.gif", save_all=True, append_images=frames[1:],
                   duration=round(1e3 * FRAME_TIME), loop=0, optimize=True)


if __name__ == "__main__":
    main()
