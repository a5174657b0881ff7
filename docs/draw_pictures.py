"""Draw every picture of README and docs again: python docs/draw_pictures.py"""

import shutil
import tempfile
from pathlib import Path

import numpy as np

import tissue_sim as ts
from scenes import SCENES, draw_simulation, run_demo

PICTURES = Path(__file__).parent / "pictures"
CURVES = Path(__file__).parents[1] / "tests" / "reference"


def reference(name: str) -> ts.Recording:
    """A curve of an independent solver: mm and N in two columns."""
    displacement, force = np.loadtxt(CURVES / name, delimiter=",").T
    return ts.Recording({"displacement": displacement * 1e-3, "force": force},
                        metadata={"name": "independent Q2/Q1 solver"})


REFERENCES = {"bonded_compression": reference("bonded_RP.csv"),
              "needle_indentation": reference("punch_bonded_face_side_wall_RP.csv")}


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        answer = run_demo(Path(folder) / "demo")
        shutil.copyfile(answer["figure"], PICTURES / "demo.png")
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
    for scene, field, name in (("bonded_compression", "pressure", "bonded_pressure"),
                               ("needle_indentation", "von_mises", "needle_von_mises"),
                               ("needle_indentation", "J", "needle_J")):
        experiment = SCENES[scene].experiment(specimen=ts.Specimen(0.040, 0.070), protocol=ts.Protocol.ramp(0.010))
        model = ts.Model(experiment, material)
        recording = ts.simulate(model, resolution="accurate", fields=True)
        draw_simulation(recording, model, PICTURES / f"{name}.png", field=field, reference=REFERENCES[scene])
    for path in sorted(PICTURES.glob("*.png")):
        print(path)


if __name__ == "__main__":
    main()
