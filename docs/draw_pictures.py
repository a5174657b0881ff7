"""Draw every picture of README and docs again: python docs/draw_pictures.py"""

import shutil
import tempfile
from pathlib import Path

import tissue_sim as ts
from scenes import SCENES, draw_simulation, run_demo

PICTURES = Path(__file__).parent / "pictures"


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        answer = run_demo(Path(folder) / "demo")
        shutil.copyfile(answer["figure"], PICTURES / "demo.png")
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
    experiment = SCENES["bonded_compression"].experiment(radius=0.040, height=0.070, protocol=ts.Protocol.ramp(0.010))
    model = ts.Model(experiment, material)
    recording = ts.simulate(model, resolution="accurate", fields=True)
    draw_simulation(recording, model, PICTURES / "bonded_pressure.png", field="pressure")
    for path in sorted(PICTURES.glob("*.png")):
        print(path)


if __name__ == "__main__":
    main()
