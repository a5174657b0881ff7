"""A needle on a spring in Newton presses into tissue: equilibrium of spring and tissue.

The spring, of stiffness k, draws the needle to the depth D. The needle comes to rest at the depth d at which
`k (D - d) = F(d)`, with the force F of the tissue. The force at rest equals the quasi-static force of `simulate` at d
within the stated error of the mesh (2.7 %). Needs `tissue_sim[newton]`.
"""

import sys

import numpy as np
from matplotlib.figure import Figure

import tissue_sim as ts
from tissue_sim.realtime.engines.newton import NewtonTissue

STIFFNESS = 500.0
DEPTH = 8e-3
MASS = 0.05
STEP = 1e-3


def run() -> Figure:
    import newton
    import warp as wp

    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
    model = ts.Model(ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(DEPTH, points=9),
                                   ts.Tool("flat", radius=8e-3), friction="bonded"), material)
    builder, inertia = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0)), wp.mat33(*(1e-4 * MASS * np.eye(3)).ravel())
    needle = builder.add_link(mass=MASS, inertia=inertia, com=wp.vec3(0.0, 0.0, 0.03), label="needle")
    builder.add_articulation([builder.add_joint_prismatic(
        -1, needle, axis=newton.Axis.Z, target_ke=STIFFNESS, target_kd=2.0 * (STIFFNESS * MASS) ** 0.5)])
    scene = builder.finalize(device="cpu")
    state, following, control = scene.state(), scene.state(), scene.control()
    newton.eval_fk(scene, scene.joint_q, scene.joint_qd, state)
    solver = newton.solvers.SolverFeatherstone(scene)
    tissue = NewtonTissue(scene, body="needle", tissue=ts.Simulator(model, resolution="realtime_20"))
    wrenches = []
    for number in range(1000):
        control.joint_target_q.assign([-DEPTH * min(1.0, 2.0 * number * STEP)])
        state.clear_forces()
        wrenches.append(tissue.apply(state, STEP))
        solver.step(state, following, control, None, STEP)
        state, following = following, state
    quasi_static = ts.simulate(model, resolution="accurate")
    depths = [wrench.pose.depth for wrench in wrenches]
    assert abs(STIFFNESS * (DEPTH - depths[-1]) / np.interp(
        depths[-1], quasi_static.displacement, quasi_static.force) - 1.0) < 0.027
    axes = (figure := Figure(figsize=(5, 3.4), layout="constrained")).subplots()
    axes.plot(1e3 * np.array(depths), [wrench.force[2] for wrench in wrenches], label="needle in Newton, 1 kHz")
    axes.plot(1e3 * quasi_static.displacement, quasi_static.force, "o", label="quasi-static, accurate", zorder=0)
    axes.plot(1e3 * np.array([0.0, DEPTH]), [STIFFNESS * DEPTH, 0.0], "--", label="spring at the end")
    axes.set(xlabel="depth [mm]", ylabel="force [N]", ylim=(0.0, 2.5), title="A needle on a spring of 500 N/m")
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    run().savefig(sys.argv[1] if len(sys.argv) > 1 else "newton_needle.png")
