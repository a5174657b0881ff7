"""Draw the pictures of README and documentation: python docs/draw_pictures.py

``python docs/draw_pictures.py imports`` draws the pictures of measured data sets from the folder TISSUE_SIM_DATA,
``python docs/draw_pictures.py needle`` the moving picture of README, and ``python docs/draw_pictures.py examples``
the pictures of the gallery.
"""

import base64
import math
import os
import re
import runpy
import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

import tissue_sim as ts
from calibration import ImportOptions, InterpretationOverrides, calibrate, import_files
from scenes import SCENES, draw_simulation, run_demo, run_hidden_demo
from scenes.colour_scale import choose_colour_scale
from scenes.figures import draw_section, write_figure_file

PICTURES = Path(__file__).parent / "pictures"
CURVES = Path(__file__).parents[1] / "tests" / "reference"
#: Seed of the demonstration with a hidden effect for which the effect is relaxation.
RELAXING = 23
#: Time between two frames of the moving picture, s of the test; it plays at this speed.
FRAME_TIME = 0.125
#: Size of the moving picture, inches; at `FRAME_DPI`.
FRAME_SIZE = (7.6, 3.6)
FRAME_DPI = 84
#: Colours of a frame: an indexed palette keeps the file small.
FRAME_COLOURS = 200


def reference(name: str) -> ts.Recording:
    """Read a force curve of an independent solver; columns in mm and N."""
    displacement, force = np.loadtxt(CURVES / name, delimiter=",").T
    return ts.Recording({"displacement": displacement * 1e-3, "force": force},
                        metadata={"name": "independent Q2/Q1 solver"})


#: Picture -> scene, depth in mm, field, curve of the independent solver.
SIMULATIONS = {
    "bonded_pressure": ("bonded_compression", 10.0, "pressure", "bonded_RP.csv"),
    "friction_bulge": ("friction_compression", 30.0, "von_mises", "friction0.7_30mm_RP.csv"),
    "needle_von_mises": ("needle_indentation", 10.0, "von_mises", "punch_bonded_face_side_wall_RP.csv"),
    "needle_J": ("needle_indentation", 10.0, "J", "punch_bonded_face_side_wall_RP.csv")}


def study_material() -> ts.Material:
    """Return the silicone of the reference study."""
    return ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        answer = run_demo(Path(folder) / "demo")
        shutil.copyfile(answer["figure"], PICTURES / "demo.png")
        hidden = run_hidden_demo(Path(folder) / "hidden", seed=RELAXING)
        shutil.copyfile(hidden.figure, PICTURES / "demo_hidden.png")
    material = study_material()
    for name, (scene, depth, field, curve) in SIMULATIONS.items():
        protocol = ts.Protocol.ramp(depth * 1e-3, points=round(2 * depth) + 1)
        model = ts.Model(SCENES[scene].experiment(specimen=ts.Specimen(0.040, 0.070), protocol=protocol), material)
        recording = ts.simulate(model, resolution="accurate", fields=True)
        draw_simulation(recording, model, PICTURES / f"{name}.png", field=field, reference=reference(curve))
    draw_solid(material)
    draw_needle_movie(material)
    draw_cycles(material)
    draw_inverse_calibration(material)
    for path in sorted(PICTURES.glob("*.png")):
        print(path)


def draw_solid(material: ts.Material) -> None:
    """Draw a tilted needle off the axis, in space."""
    experiment = SCENES["needle_indentation"].experiment(
        specimen=ts.Specimen(0.040, 0.070), protocol=ts.Protocol.ramp(8e-3, points=5), friction=0.3,
        tool=ts.Tool("round", radius=8e-3), approach=ts.Approach(12e-3, math.radians(15.0)))
    model = ts.Model(experiment, material)
    draw_simulation(ts.simulate(model, solver="solid", fields=True), model, PICTURES / "solid_figure.png")


def draw_examples() -> None:
    """Run each example and save its picture in the size of the gallery."""
    for path in sorted((Path(__file__).parents[1] / "examples").glob("*.py")):
        example = runpy.run_path(str(path))
        try:
            figure = example["run"]()
        except ModuleNotFoundError as error:
            print(f"{path.stem} is left out: {error}", file=sys.stderr)
            continue
        figure.savefig(PICTURES / "examples" / f"{path.stem}.png", dpi=90)


def draw_needle_movie(material: ts.Material) -> None:
    """Write an animated GIF of a needle pressed into relaxing tissue, held and pulled out: section and force."""
    protocol = ts.Protocol.parse("ramp 10mm @5mm/s; hold 2s; unload", points=41)
    tissue = replace(material, viscoelastic=ts.Prony((ts.PronyTerm(0.35, 0.8),)))
    experiment = SCENES["needle_indentation"].experiment(specimen=ts.Specimen(0.040, 0.070), protocol=protocol)
    recording = ts.simulate(ts.Model(experiment, tissue), resolution="accurate", fields=True)
    times = np.arange(0.0, recording.time[-1] + 0.5 * FRAME_TIME, FRAME_TIME)
    samples = np.abs(recording.time[:, None] - times).argmin(axis=0)
    largest = choose_colour_scale(recording.fields, "von_mises", int(np.argmax(recording.force))).high
    frames = [_needle_frame(recording, int(sample), largest, experiment.tool) for sample in samples]
    frames[0].save(PICTURES / "needle.gif", save_all=True, append_images=frames[1:], duration=round(1e3 * FRAME_TIME),
                   loop=0, optimize=True)


def _needle_frame(recording: ts.Recording, sample: int, largest: float, tool: ts.Tool) -> Image.Image:
    """Draw one frame of the moving picture: section with a common colour scale in kPa, force up to the sample."""
    figure = Figure(figsize=FRAME_SIZE, dpi=FRAME_DPI, layout="constrained")
    section, curve = figure.subplots(1, 2, width_ratios=[1.15, 1.0])
    draw_section(section, recording.fields, "von_mises", sample, tool=tool)
    for drawn in (each for each in section.collections if each.get_array() is not None):
        drawn.set_clim(0.0, largest)
    section.set_ylim(-74.0, 14.0)
    curve.plot(recording.time, recording.force, color="0.85", linewidth=1.2)
    curve.plot(recording.time[:sample + 1], recording.force[:sample + 1], color="#0072B2", linewidth=1.8)
    curve.plot(recording.time[sample], recording.force[sample], "o", color="#D55E00", markersize=5)
    curve.set(xlabel="time [s]", ylabel="force [N]",
              title=f"{recording.displacement[sample] * 1e3:4.1f} mm   {recording.force[sample]:4.2f} N")
    curve.grid(alpha=0.3)
    curve.spines[["top", "right"]].set_visible(False)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    return picture.quantize(FRAME_COLOURS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)


def draw_cycles(material: ts.Material) -> None:
    """Draw two cycles of ramp, hold and unloading of needle and plate: elastic, relaxing and softening specimen."""
    protocol = ts.Protocol.parse("repeat 2 (ramp 8mm @0.5mm/s; hold 10s; unload)", points=33)
    materials = {"elastic": material,
                 "g = 0.3, tau = 2 s": replace(material, viscoelastic=ts.Prony((ts.PronyTerm(0.3, 2.0),))),
                 "softening by 40 %": replace(material, softening=ts.Softening(0.4, modulus=20.0, share=0.5))}
    figure = Figure(figsize=(10, 6.4), layout="constrained")
    axes = figure.subplots(2, 2, sharey="row", width_ratios=[1, 1.3])
    tests = (("plates, friction 0.7", "friction_compression", 0.7),
             ("needle that sticks", "needle_indentation", "stick"))
    for row, (title, scene, friction) in zip(axes, tests, strict=True):
        experiment = SCENES[scene].experiment(specimen=ts.Specimen(0.040, 0.070), protocol=protocol, friction=friction)
        for (name, stuff), colour in zip(materials.items(), ("0.8", "#0072B2", "#D55E00"), strict=True):
            recording = ts.simulate(ts.Model(experiment, stuff))
            # The elastic curve is wider: the others lie on it in part.
            line = {"color": colour, "linewidth": 3.5 if name == "elastic" else 1.3}
            row[0].plot(recording.displacement * 1e3, recording.force, label=name, **line)
            row[1].plot(recording.time, recording.force, **line)
        row[0].set(xlabel="displacement [mm]", ylabel="force [N]", title=title)
        row[1].set(xlabel="time [s]")
        for panel in row:
            panel.grid(alpha=0.3)
            panel.spines[["top", "right"]].set_visible(False)
    axes[0, 0].legend(frameon=False)
    write_figure_file(figure, PICTURES / "cycles.png")


def draw_inverse_calibration(material: ts.Material) -> None:
    """Draw the report figure of a needle test: three laws fitted by inverse calibration to needle and bonded plates."""
    tests = {"bonded_compression": "", "needle_indentation": 'tool = "flat"\ntool_radius_mm = 8.0\n'}
    text = "[[specimen]]\nradius_mm = 40.0\nheight_mm = 70.0\n"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for kind, keys in tests.items():
            experiment = SCENES[kind].experiment(specimen=ts.Specimen(0.040, 0.070),
                                                 protocol=ts.Protocol.ramp(0.010, 201))
            true = ts.simulate(ts.Model(experiment, material), resolution="accurate")
            for number in (1, 2, 3):
                scatter = np.random.default_rng(number)
                rig = ts.Rig(contact_offset=scatter.normal(0, 0.03e-3), zero_offset=scatter.normal(0, 0.01),
                             force_noise=0.02, seed=number)
                ts.write_recording(rig.measure(true), folder / f"{kind}_{number}.csv")
            text += f'[[test]]\nname = "{kind.split("_")[0]}"\nkind = "{kind}"\nrecordings = ["{kind}_*.csv"]\n{keys}'
        text += ('[fit]\nmethod = "inverse_fem"\nlaws = ["neo_hooke", "mooney_rivlin", "reduced_polynomial_2"]\n'
                 'bulk_ratio = 10000.0\nstarts = 1\n')
        (folder / "study.toml").write_text(text, encoding="utf-8")
        calibrate([folder / "study.toml"], folder / "out")
        page = (folder / "out" / "report.html").read_text(encoding="utf-8")
    found = re.search(r'<img[^>]*src="data:image/png;base64,([^"]+)"[^>]*residuals of needle', page)
    (PICTURES / "inverse_calibration.png").write_bytes(base64.b64decode(found[1]))


#: Picture -> files of a measured set, and what only a person knows of them.
IMPORTS = {
    "ecoflex": ("ecoflex_compression/EF10_0T_A?.csv", InterpretationOverrides()),
    "brain": ("brain_tension_damage/brain_gm1.csv", InterpretationOverrides()),
    "acrylic": ("oca_vhb_viscoelastic/uniaxial*loading_2d0_unloading_0d01.xlsx", InterpretationOverrides(
        columns={"time": "A", "stretch": "B", "nominal stress": "C"}, units={"time": "s", "nominal stress": "kPa"}))}


def draw_imports(data: Path) -> None:
    """Import and fit measured data sets and save the figures of their reports; `data` is the folder of the sets."""
    for name, (pattern, stated) in IMPORTS.items():
        with tempfile.TemporaryDirectory() as place:
            campaign = Path(place, f"{name}.toml")
            imported = import_files(sorted(data.glob(pattern)), campaign,
                                    ImportOptions(stated, laws=("neo_hooke", "ogden_1")))
            if name == "ecoflex":
                shutil.copyfile(imported.picture, PICTURES / f"import_{name}.png")
            calibrate([campaign], Path(place, "out"))
            page = Path(place, "out", "report.html").read_text(encoding="utf-8")
        found = re.search(r'<img[^>]*src="data:image/png;base64,([^"]+)"[^>]*residuals of', page)
        (PICTURES / f"import_{name}_fit.png").write_bytes(base64.b64decode(found[1]))


if __name__ == "__main__":
    if "needle" in sys.argv[1:]:
        draw_needle_movie(study_material())
    elif "examples" in sys.argv[1:]:
        draw_examples()
    elif "imports" in sys.argv[1:]:
        draw_imports(Path(os.environ["TISSUE_SIM_DATA"]))
    else:
        main()
