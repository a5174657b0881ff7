"""A physics engine of one falling body, and its adapter: pose and velocity in, wrench out."""

import numpy as np

import tissue_sim as ts


class FallingBody:
    """Rigid body with gravity along -y and viscous damping, stepped by the semi-implicit Euler rule."""

    def __init__(self, mass, height, damping):
        self.mass, self.damping = mass, damping
        self.position, self.velocity = np.array([0.0, height, 0.0]), np.zeros(3)
        self.force, self.time = np.zeros(3), 0.0

    def step(self, dt):
        gravity = np.array([0.0, -9.81, 0.0])
        acceleration = gravity + (self.force - self.damping * self.velocity) / self.mass
        self.velocity = self.velocity + dt * acceleration
        self.position = self.position + dt * self.velocity
        self.time += dt


class FallingBodyTissue:
    """Tissue under a body of this engine, whose y axis points upwards."""

    def __init__(self, body, tissue):
        self.body = body
        half = 0.5**0.5  # turns the z axis of the scene, and of the tool, to y
        upwards = ts.Pose((0.0, 0.0, 0.0), (half, -half, 0.0, 0.0))
        self.coupling = ts.ToolCoupling(tissue, scene=upwards, tip=upwards, mass=body.mass)

    def apply(self):
        body = self.body
        state = ts.RigidBodyState(body.position, (1.0, 0.0, 0.0, 0.0), body.position, body.velocity, (0.0, 0.0, 0.0))
        wrench = self.coupling.compute_wrench(state, body.time)
        body.force = np.array(wrench.force)
        return wrench
