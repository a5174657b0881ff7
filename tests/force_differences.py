"""Derivatives of the force by differences of whole simulations, to which tests compare exact derivatives."""

import numpy as np

import tissue_sim as ts
from tissue_sim.fem.axisymmetric.solver import AxisymmetricSolver
from tissue_sim.parameters import get_parameter_value, with_values

#: Widths of the central differences, relative to the parameter.
WIDTHS = (4e-3, 2e-3, 1e-3)


class ContactFlags:
    """Store the contact state of all points at every sample."""

    def before_first_step(self, solver):
        self.seen = []

    def after_sample(self, solver, factor):
        if isinstance(solver, AxisymmetricSolver):
            surface = solver.equations.surface
            # A point that just touches has a force of rounding, or none.
            presses = abs(surface.forces).max(axis=-1) > 1e-9 * abs(surface.forces).max(initial=0.0)
            self.seen.append(presses.tobytes() + surface.slip_signs.tobytes())
        else:
            self.seen.append(solver.contact.state.discrete_contact_flags.tobytes())


def extrapolated_difference(model, path, **options):
    """Richardson extrapolation of central differences of three widths, up to the last sample with equal contact."""
    value, runs, slopes = get_parameter_value(model, path), [], []
    for width in WIDTHS:
        forces = []
        for factor in (1.0 + width, 1.0 - width):
            flags = ContactFlags()
            changed = with_values(model, {path: value * factor})
            forces.append(ts.simulate(changed, watch=flags, estimate_error=False, topology=model, **options).force)
            runs.append(flags.seen)
        slopes.append((forces[0] - forces[1]) / (2.0 * width * value))
    shared = np.cumprod([len(set(seen)) == 1 for seen in zip(*runs, strict=True)]).sum()
    wide, middle, narrow = slopes
    once, again = (4.0 * middle - wide) / 3.0, (4.0 * narrow - middle) / 3.0
    return (16.0 * again - once) / 15.0, int(shared)


def assert_exact(model, paths, rel=1e-6, **options):
    """Compare with differences; return the fraction of samples at which all simulations had the same contact."""
    answer = ts.sensitivities(model, paths, **options)
    assert answer.exact.all()
    compared = 0
    for k, path in enumerate(paths):
        slope, shared = extrapolated_difference(model, path, **options)
        assert abs(slope[:shared]).max() > 0.0, path
        assert abs(answer.values[:shared, k] - slope[:shared]).max() < rel * abs(slope[:shared]).max(), path
        compared += shared
    return compared / (len(paths) * len(answer.recording))
