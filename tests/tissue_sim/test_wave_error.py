"""Error of the force by waves that the steps do not resolve (`tissue_sim.realtime.inertia_limits`)."""

import math
from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.realtime.inertia_limits import REVERBERATION, ContactWaveTimeAndShearSpeed, UnresolvedWaveErrorEstimator
from tissue_sim.tool_force import make_axial_stiffness_matrix

#: Shear modulus, Pa, density, kg/m3, radius of the tool, m.
MODULUS = 4e3
DENSITY = 1000.0
RADIUS = 6e-3
#: Length of a tick, s.
TICK = 1e-3
CONVERGED = ts.ForceStatus.CONVERGED
LATE = ts.ForceStatus.LATE


def model(friction="bonded", shape="flat"):
    material = ts.Material("neo_hooke", {"C10": MODULUS / 2}, ts.Bulk("bulk_ratio", 1e3))
    tool = ts.Tool("plate") if shape == "plate" else ts.Tool(shape, radius=RADIUS)
    specimen = ts.Specimen(0.035, 0.030, density=DENSITY)
    return ts.Model(ts.Experiment(specimen, ts.Protocol.ramp(3e-3, 2), tool=tool, friction=friction), material)


def smooth(s):
    """Minimum-jerk motion from 0 to 1."""
    return 10 * s**3 - 15 * s**4 + 6 * s**5


def pressed(depths, dt=TICK, **options):
    """Answers along depths in m, after a first step at the surface."""
    simulator = ts.Simulator(model(**options), resolution="realtime_20", inertia="on")
    simulator.step(ts.Pose((0.0, 0.0, 1e-9)), dt)
    return [simulator.step(float(depth), dt) for depth in depths]


def advanced(velocities, mass=1e-3, dt=TICK):
    """The estimate after steps of a tool that moves a mass, kg, at velocities in m/s."""
    scale, waves = ContactWaveTimeAndShearSpeed.from_model(model(), DENSITY), UnresolvedWaveErrorEstimator()
    for velocity in velocities:
        waves.register_step_with_mass(make_axial_stiffness_matrix(0.0), make_axial_stiffness_matrix(mass / dt**2),
                                      (0.0, 0.0, velocity * dt, 0.0, 0.0, 0.0),
                                      dt, scale)
    return waves


def test_scale_is_the_transit_time_of_a_shear_wave_and_between_plates_of_a_pressure_wave():
    scale = ContactWaveTimeAndShearSpeed.from_model(model(), DENSITY)
    assert scale.shear_speed == pytest.approx(2.0) and scale.duration == pytest.approx(RADIUS / 2.0)
    pressure_speed = math.sqrt((1e3 + 4 / 3) * MODULUS / DENSITY)
    assert ContactWaveTimeAndShearSpeed.from_model(model(shape="plate"), DENSITY).duration \
        == pytest.approx(0.030 / pressure_speed)


def test_an_impact_has_the_force_of_its_momentum_and_then_that_of_its_wave():
    velocity, mass = 0.05, 1e-3
    impact = mass * velocity / TICK
    assert advanced([velocity]).force == pytest.approx(impact)
    later = advanced([velocity] * 30)
    # The onset and the end of the impact are two changes of the inertial force.
    wave = math.sqrt(2.0) * mass * velocity / ContactWaveTimeAndShearSpeed.from_model(model(), DENSITY).duration
    assert later.force == pytest.approx(wave * math.exp(-0.0285 / REVERBERATION), rel=0.05)


def test_an_even_acceleration_is_resolved():
    velocities = np.linspace(0.0, 0.5, 40)
    first, last = advanced(velocities[:3]), advanced(velocities)
    assert last.force < first.force


def test_rest_forgets_the_waves_and_keeps_the_velocity():
    waves = advanced([0.05])
    waves.reset_error_at_step_without_mass((0.0, 0.0, 0.05 * TICK, 0.0, 0.0, 0.0), TICK)
    assert waves.force == 0.0
    waves.register_step_with_mass(make_axial_stiffness_matrix(0.0), make_axial_stiffness_matrix(1e3),
                                  (0.0, 0.0, 0.05 * TICK, 0.0, 0.0, 0.0), TICK,
                                  ContactWaveTimeAndShearSpeed.from_model(model(), DENSITY))
    assert waves.force == 0.0


def test_a_copy_is_independent():
    waves = advanced([0.05])
    before, other = waves.force, replace(waves)
    other.reset_error_at_step_without_mass(None, TICK)
    assert waves.force == before > 0.0


@pytest.mark.parametrize("options", [{}, {"friction": 0.3, "shape": "round"}, {"shape": "plate"}])
def test_a_tool_faster_than_shear_waves_is_never_converged(options):
    depths = np.minimum(3.0 * TICK * np.arange(1, 6), 1.5e-3 if options.get("shape") == "plate" else 3e-3)
    assert all(answer.status is LATE for answer in pressed(depths, **options))


@pytest.mark.parametrize("options", [{}, {"friction": 0.3, "shape": "round"}])
def test_the_stated_error_of_an_impact_covers_the_difference_from_fine_steps(options):
    """A press that starts at 0.2 m/s at once: forces of CONVERGED ticks in steps of 1 ms and of 0.1 ms."""
    times = TICK * np.arange(1, 31)
    coarse = pressed(np.minimum(0.2 * times, 3e-3), **options)
    fine = pressed(np.minimum(0.2 * 0.1 * TICK * np.arange(1, 301), 3e-3), 0.1 * TICK, **options)[9::10]
    peak = max(answer.force for answer in fine)
    wrong = [(one.force, other.force) for one, other in zip(coarse, fine, strict=True) if one.status is CONVERGED
             and abs(one.force - other.force) > max(0.03 * peak, one.force_error)]
    assert not wrong
    assert any(answer.status is LATE for answer in coarse)


def test_a_smooth_press_states_the_error_of_its_mesh():
    """Up to 50 mm/s in 0.1 s: the waves are resolved, and every tick is CONVERGED."""
    depths = 3e-3 * smooth(np.minimum(np.arange(1, 121) / 112.0, 1.0))
    answers = pressed(depths)
    assert all(answer.status is CONVERGED for answer in answers)
    assert answers[-1].force_error < 0.035 * answers[-1].force


def test_a_saved_state_keeps_the_waves():
    simulator = ts.Simulator(model(), resolution="realtime_20", inertia="on")
    simulator.step(ts.Pose((0.0, 0.0, 1e-9)), TICK)
    simulator.step(5e-5, TICK)
    saved = simulator.save()
    first = simulator.step(1e-4, TICK)
    simulator.restore(saved)
    again = simulator.step(1e-4, TICK)
    assert again.force_error == first.force_error > 0.0
