"""The force as an operation of JAX and PyTorch: derivatives, bounds, errors, number of simulations."""

import importlib
import sys

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.autodiff import force_curve
from tissue_sim.autodiff.force_curve import ForceCurve
from tissue_sim.parameters import with_values

NAMES = ("C10", "C20", "viscoelastic.terms[0].g")
VALUES = np.array([1404.9, 699.4, 0.3])


def material(**options):
    return ts.Material("reduced_polynomial_2", {"C10": VALUES[0], "C20": VALUES[1]}, ts.Bulk("bulk_ratio", 1e4),
                       viscoelastic=ts.Prony((ts.PronyTerm(VALUES[2], 2.0),), "long_term"), **options)


def needle(shape="flat", **options):
    """Return a needle test with a hold and an unloading; the rig adds noise, which the curve does not contain."""
    protocol = ts.Protocol.parse("ramp 3mm; hold 5s; unload 1mm", 4)
    experiment = ts.Experiment(ts.Specimen(0.04, 0.05), protocol, ts.Tool(shape, radius=8e-3), **options)
    return ts.Model(experiment, material(), ts.Rig(force_noise=0.1, seed=1))


@pytest.fixture
def jax():
    """JAX in float64."""
    module = pytest.importorskip("jax", reason="JAX is an optional package: pip install 'tissue-sim[jax]'")
    before = module.config.jax_enable_x64
    module.config.update("jax_enable_x64", True)
    yield module
    module.config.update("jax_enable_x64", before)


@pytest.fixture
def torch():
    return pytest.importorskip("torch", reason="PyPI has no wheel of PyTorch for Linux without the 3 GB of NVIDIA's "
                                               "libraries, and pip cannot select the CPU wheels of PyTorch's own index")


@pytest.fixture
def simulated(monkeypatch):
    """Names of the functions that simulated, one entry for each call."""
    calls = []
    for name in ("sensitivities", "simulate"):
        done = getattr(force_curve, name)
        monkeypatch.setattr(force_curve, name, lambda *given, _name=name, _done=done, **options: (
            calls.append(_name), _done(*given, **options))[1])
    return calls


@pytest.fixture(scope="module")
def expected():
    """Derivatives of the needle test."""
    return ts.sensitivities(needle(), NAMES)


@pytest.mark.slow
@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])
def test_jax_returns_force_and_derivatives_of_one_simulation(jax, expected, simulated, compiled):
    """Force and derivatives equal those of `sensitivities` to the last bit."""
    curve = ts.JaxForceCurve(needle(), NAMES)
    theta, wrap = jax.numpy.asarray(curve.values), jax.jit if compiled else lambda function: function
    np.testing.assert_array_equal(curve.values, VALUES)
    np.testing.assert_array_equal(wrap(curve)(theta), expected.recording.force)
    for transform in (jax.jacfwd, jax.jacrev):
        np.testing.assert_array_equal(wrap(transform(curve))(theta), expected.values)
    np.testing.assert_array_equal(wrap(jax.grad(lambda theta: curve(theta)[-1]))(theta), expected.values[-1])
    force, slope = wrap(lambda theta: jax.jvp(curve, (theta,), (jax.numpy.array([0.0, 1.0, 0.0]),)))(theta)
    np.testing.assert_array_equal(force, expected.recording.force)
    np.testing.assert_array_equal(slope, expected.values[:, 1])
    np.testing.assert_array_equal(curve.exact, expected.exact)
    # The first request is for the force alone.
    assert simulated == ["simulate", "sensitivities"]


@pytest.mark.slow
def test_jax_gradient_of_a_sum_of_squares(jax):
    """The chain rule through operations of JAX, against central differences of three widths."""
    curve = ts.JaxForceCurve(needle(), NAMES)
    measured = curve.compute_force(1.1 * VALUES)

    def misfit(x):
        return jax.numpy.sum((curve(jax.numpy.exp(x)) - measured) ** 2)

    x = np.log(VALUES)
    slope = np.asarray(jax.grad(misfit)(x))
    for width in (1e-2, 1e-3, 1e-4):
        difference = [(misfit(x + step) - misfit(x - step)) / (2.0 * width) for step in width * np.eye(3)]
        np.testing.assert_allclose(slope, difference, rtol=0, atol=(30.0 * width**2 + 1e-6) * abs(slope).max())


@pytest.mark.slow
def test_jax_vmap_simulates_one_set_after_the_other(jax, expected):
    curve = ts.JaxForceCurve(needle(), NAMES)
    several = jax.numpy.stack([VALUES, 1.1 * VALUES])
    forces, jacobians = jax.vmap(curve)(several), jax.vmap(jax.jacrev(curve))(several)
    np.testing.assert_array_equal(forces[0], expected.recording.force)
    np.testing.assert_array_equal(jacobians[0], expected.values)
    other = ts.sensitivities(with_values(needle(), {f"material.{name}": 1.1 * value for name, value in zip(
        NAMES, VALUES, strict=True)}), NAMES)
    np.testing.assert_array_equal(forces[1], other.recording.force)
    np.testing.assert_array_equal(jacobians[1], other.values)


@pytest.mark.slow
@pytest.mark.parametrize("friction", [-0.1, 11.0, np.nan])
def test_jax_raises_outside_of_the_bounds(jax, friction):
    curve = ts.JaxForceCurve(needle("round", friction=0.3), ["C10", "experiment.friction"])
    np.testing.assert_array_equal(curve.bounds[1], [0.0, 10.0])
    theta = jax.numpy.array([VALUES[0], friction])
    words = "experiment.friction: must be between 0 and 10; got "
    for function in (curve, jax.jacfwd(curve), jax.jacrev(curve)):
        with pytest.raises(ts.InputError, match=words):
            function(theta)
        with pytest.raises(jax.errors.JaxRuntimeError, match=words):
            jax.jit(function)(theta)


@pytest.mark.slow
def test_jax_raises_where_the_simulation_does_not_converge(jax):
    """With a negative C20 the law softens until no equilibrium exists."""
    experiment = ts.Experiment(ts.Specimen(0.04, 0.05), ts.Protocol.ramp(0.03, 4))
    curve = ts.JaxForceCurve(ts.Model(experiment, material()), ["C10", "C20"])
    theta = jax.numpy.array([VALUES[0], -VALUES[0]])
    with pytest.raises(ts.ConvergenceError, match="stopped at") as caught:
        jax.jacrev(curve)(theta)
    assert caught.value.depth < 0.03
    with pytest.raises(jax.errors.JaxRuntimeError, match="ConvergenceError: stopped at"):
        jax.jit(curve)(theta)


@pytest.mark.slow
def test_jax_refuses_float32_other_shapes_and_second_derivatives(jax):
    curve = ts.JaxForceCurve(needle(), NAMES)
    with pytest.raises(ts.InputError, match=r'got float32\. Call jax\.config\.update\("jax_enable_x64", True\)'):
        curve(np.float32(VALUES))
    with pytest.raises(ts.InputError, match=r"must have the shape \(3,\); got \(2, 3\)\. Use jax\.vmap"):
        curve(np.stack([VALUES, VALUES]))
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        jax.hessian(lambda theta: curve(theta)[-1])(VALUES)


@pytest.mark.slow
def test_torch_returns_force_and_gradient_of_one_simulation(torch, expected, simulated):
    curve = ts.TorchForceCurve(needle(), NAMES)
    theta = torch.tensor(VALUES, requires_grad=True)
    force = curve(theta)
    np.testing.assert_array_equal(force.detach(), expected.recording.force)
    for row in range(force.numel()):
        slope, = torch.autograd.grad(force[row], theta, retain_graph=True)
        np.testing.assert_array_equal(slope, expected.values[row])
    np.testing.assert_array_equal(curve(theta.detach()), expected.recording.force)
    assert simulated == ["sensitivities"]


@pytest.mark.slow
def test_torch_gradcheck(torch):
    curve = ts.TorchForceCurve(needle(), NAMES)

    def scaled(x):
        return curve(x * torch.tensor(VALUES))

    assert torch.autograd.gradcheck(scaled, torch.ones(3, dtype=torch.float64, requires_grad=True), eps=1e-4, atol=1e-6,
                                    rtol=1e-5)


@pytest.mark.slow
def test_torch_refuses_other_types_bounds_and_second_derivatives(torch):
    curve = ts.TorchForceCurve(needle("round", friction=0.3), ["C10", "experiment.friction"])
    with pytest.raises(ts.InputError, match=r"tensor of torch\.float64; got torch\.float32"):
        curve(torch.tensor([VALUES[0], 0.3], dtype=torch.float32))
    with pytest.raises(ts.InputError, match="got list"):
        curve([VALUES[0], 0.3])
    with pytest.raises(ts.InputError, match=r"experiment\.friction: must be between 0 and 10; got -1"):
        curve(torch.tensor([VALUES[0], -1.0], dtype=torch.float64, requires_grad=True))
    curve = ts.TorchForceCurve(needle(), NAMES)
    theta = torch.tensor(VALUES, requires_grad=True)
    for loss in ((curve(theta) ** 2).sum(), curve(theta).sum()):
        slope, = torch.autograd.grad(loss, theta, create_graph=True)
        with pytest.raises(NotImplementedError, match="first derivatives only"):
            slope.sum().backward()
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        torch.autograd.functional.hessian(lambda theta: curve(theta).sum(), torch.tensor(VALUES))


@pytest.mark.slow
def test_force_alone_takes_no_simulations_of_differences(simulated):
    """Parameters of the rig have no exact derivative: each Jacobian takes two further simulations."""
    first = ForceCurve(needle(), ["rig.displacement_gain"])
    first.compute_force(first.values)
    assert simulated == ["simulate"]
    simulated.clear()
    curve = ForceCurve(needle(), ["rig.displacement_gain"])
    assert not curve.exact.any() and simulated == ["sensitivities"]
    curve.compute_force(np.array([0.01]))
    curve.compute_force(np.array([0.01]))
    assert simulated == ["sensitivities", "simulate"]
    force, jacobian = curve.compute_force_and_jacobian(np.array([0.01]))
    np.testing.assert_array_equal(curve.compute_force(np.array([0.01])), force)
    force[:], jacobian[:] = 0.0, 0.0
    assert all(abs(each).max() > 0.0 for each in curve.compute_force_and_jacobian(np.array([0.01])))
    assert simulated == ["sensitivities", "simulate", "sensitivities"]


@pytest.mark.slow
def test_all_parameters_of_the_material_and_a_mesh_that_moves():
    """Without names: all of the material. Geometry moves the nodes of the model's mesh."""
    model = needle()
    assert set(NAMES) < set(ForceCurve(model).names)
    curve = ForceCurve(model, ["experiment.specimen.radius"])
    larger = with_values(model, {"experiment.specimen.radius": 0.05})
    answer = ts.sensitivities(larger, ["experiment.specimen.radius"], topology=model)
    force, jacobian = curve.compute_force_and_jacobian(np.array([0.05]))
    np.testing.assert_array_equal(force, answer.recording.force)
    np.testing.assert_array_equal(jacobian, answer.values)


@pytest.mark.parametrize(("theta", "words"), [
    (np.float32(VALUES), r"float64 of shape \(3,\); got float32 of shape \(3,\)"),
    (VALUES[:2], r"got float64 of shape \(2,\)"), (np.array([np.nan, 1.0, 0.1]), "C10: must be between -inf and inf")])
def test_values_of_another_type_or_shape(theta, words):
    with pytest.raises(ts.InputError, match=words):
        ForceCurve(needle(), NAMES).compute_force(theta)


def test_unknown_parameter():
    with pytest.raises(ts.InputError, match="did you mean 'C10'"):
        ForceCurve(needle(), ["C11"])


@pytest.mark.parametrize("package", ["jax", "torch"])
def test_absent_package(package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    kind = {"jax": ts.JaxForceCurve, "torch": ts.TorchForceCurve}[package]
    with pytest.raises(ts.MissingBackendError, match=rf"pip install 'tissue-sim\[{package}\]'"):
        kind(needle(), NAMES)


def test_import_of_the_package_imports_neither_jax_nor_torch():
    for name in ("force_curve", "jax_curve", "torch_curve"):
        module = importlib.import_module(f"tissue_sim.autodiff.{name}")
        assert not {"jax", "torch"} & set(vars(module))
