"""Calibrate law and friction with an optimiser of JAX, through the simulation.

The synthetic campaign has a bonded needle and plates with friction. The force curves are operations of JAX, so that
`jax.jacfwd` returns the Jacobian J of the residuals r with respect to x = log(theta). Each Levenberg-Marquardt step
solves (J^T J + lambda diag(J^T J)) dx = -J^T r. Dotted: the number of residuals minus that of parameters.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import tissue_sim as ts

TRUTH = {"C10": 1404.9, "C20": 699.4, "experiment.friction": 0.15}
START = {"C10": 1000.0, "C20": 1000.0, "experiment.friction": 0.4}
NAMES = list(TRUTH)


def run() -> Figure:
    jax.config.update("jax_enable_x64", True)
    material = ts.Material("reduced_polynomial_2", {"C10": 1000.0, "C20": 1000.0}, ts.Bulk("bulk_ratio", 1e4))
    specimen, protocol = ts.Specimen(0.040, 0.070), ts.Protocol.ramp(0.012, points=7)
    needle = ts.Experiment(specimen, protocol, ts.Tool("flat", radius=8e-3))
    plates = ts.Experiment(specimen, protocol, friction=START["experiment.friction"], friction_base=0.1)
    curves = [ts.JaxForceCurve(ts.Model(test, material), names)
              for test, names in ((needle, NAMES[:2]), (plates, NAMES))]

    def forces(x):
        return jnp.concatenate([curve(jnp.exp(x[:curve.values.size])) for curve in curves])

    exact = forces(jnp.log(jnp.array(list(TRUTH.values()))))
    noise = 5e-4 * exact.max()
    measured = exact + noise * np.random.default_rng(1).standard_normal(exact.size)
    x, damping = jnp.log(jnp.array(list(START.values()))), 1e-2
    residual, history = (forces(x) - measured) / noise, []
    for _ in range(8):
        jacobian = jax.jacfwd(forces)(x) / noise
        normal = jacobian.T @ jacobian
        step = -jnp.linalg.solve(normal + damping * jnp.diag(jnp.diag(normal)), jacobian.T @ residual)
        trial = (forces(x + step) - measured) / noise
        history.append(float(residual @ residual))
        if trial @ trial < residual @ residual:
            x, residual, damping = x + step, trial, 0.01 * damping
        damping *= 10.0
    found, error = np.exp(x), np.sqrt(np.diag(np.linalg.inv(normal)))
    assert abs(found[2] - TRUTH["experiment.friction"]) < 3.0 * found[2] * error[2] < 0.02
    figure = Figure(figsize=(5, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.semilogy(history, "o-")
    axes.axhline(exact.size - len(NAMES), color="k", linestyle=":")
    axes.set(xlabel="iteration", ylabel="sum of squares / variance of the noise",
             title=f"C10 {found[0]:.0f} Pa, C20 {found[1]:.0f} Pa, friction {found[2]:.3f}")
    return figure


if __name__ == "__main__":
    run().savefig(sys.argv[1] if len(sys.argv) > 1 else "differentiable_calibration.png")
