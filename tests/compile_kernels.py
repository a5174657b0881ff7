"""Compile the kernels that most tests use, and keep them; see conftest.py."""

import tissue_sim as ts
from tissue_sim.mesh import cylinder_mesh
from tissue_sim.mesh.elements import Q4P0

#: Radius, m.
RADIUS = 0.04
#: Height, m.
HEIGHT = 0.07


def main() -> None:
    polynomial = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
    ogden = ts.Material("ogden_1", {"mu1": 3225.9, "alpha1": 14.8}, ts.Bulk("bulk_ratio", 1e4))
    bonded, slipping = (ts.Experiment(ts.Specimen(RADIUS, HEIGHT), ts.Protocol.ramp(1e-4, 2), friction=friction)
                        for friction in ("bonded", 0.3))
    linear = cylinder_mesh(RADIUS, HEIGHT, (3, 4), Q4P0)
    for material, parameter in ((polynomial, "C10"), (ogden, "mu1")):
        ts.sensitivities(ts.Model(bonded, material), [parameter])
        ts.simulate(ts.Model(bonded, material), mesh=linear)
    ts.simulate(ts.Model(slipping, polynomial))
    for resolution in ("realtime", "fast"):
        ts.simulate(ts.Model(bonded, polynomial), solver="solid", resolution=resolution)


if __name__ == "__main__":
    main()
