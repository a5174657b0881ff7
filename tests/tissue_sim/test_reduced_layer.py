"""The elastic layer between a tool and a reduced solid: friction, and derivatives of its forces."""

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.reduced.contact import LayerContact
from tissue_sim.fem.solid.contact import Body
from tissue_sim.fem.solid.frame import Frame


class TestLayer:
    """Nodes that move alone: the modes are their freedoms."""

    MU, SPRING = 0.3, 1e5 * 1e-6 / (1e-3 * 5e-3)

    def contact(self, tool: ts.Tool, mu: float) -> LayerContact:
        body = Body(tool.profile, np.array([0]), (mu, mu))
        layer = LayerContact([body], np.zeros((1, 3)), np.array([1e-6]), np.eye(3), reach=5e-3, softness=1e-3)
        layer.set_stiffness(1e5)
        return layer

    @staticmethod
    def frame(*position: float) -> Frame:
        return Frame(ts.Pose(position), 0.0)

    def test_sticks_up_to_mu_times_the_pressure(self):
        layer, depth = self.contact(ts.Tool("flat", radius=8e-3), self.MU), 1e-4
        layer.evaluate(np.zeros(3), self.frame(0.0, 0.0, -depth), True)
        np.testing.assert_allclose(layer.forces[0], [0.0, 0.0, -self.SPRING * depth], rtol=1e-12)
        layer.commit()
        for way in (1e-5, 2.9e-5, 3.1e-5, 2e-4):
            layer.evaluate(np.zeros(3), self.frame(way, 0.0, -depth), True)
            # It drags the tissue along.
            assert layer.forces[0, 0] == pytest.approx(self.SPRING * min(way, self.MU * depth), rel=1e-9)
            assert layer.slipping == (way > self.MU * depth)

    def test_back_from_sliding_it_sticks_where_it_slid_to(self):
        layer, depth = self.contact(ts.Tool("flat", radius=8e-3), self.MU), 1e-4
        for way in (0.0, 1e-3, 1e-3 - 1e-5):
            layer.evaluate(np.zeros(3), self.frame(way, 0.0, -depth), True)
            layer.commit()
        assert layer.forces[0, 0] == pytest.approx(self.SPRING * (self.MU * depth - 1e-5), rel=1e-9)

    @pytest.mark.parametrize("mu", [0.0, 0.3])
    @pytest.mark.parametrize("tool", [ts.Tool("round", radius=8e-3), ts.Tool("cone", radius=6e-3, half_angle=1.0)],
                             ids=lambda tool: tool.shape)
    def test_its_rates_are_those_of_its_forces(self, tool, mu):
        layer, at = self.contact(tool, mu), np.array([2e-3, 1e-3, 0.0])
        pose = self.frame(0.0, 0.0, -3e-3)
        layer.evaluate(at, pose, True)
        layer.commit()
        moved = np.add(at, [3e-6, -1e-6, 2e-6])
        layer.evaluate(moved, pose, True)
        _, rates = layer.on_modes()
        width = 1e-9
        for axis in range(3):
            sides = []
            for sign in (1.0, -1.0):
                layer.evaluate(moved + sign * width * np.eye(3)[axis], pose, True)
                sides.append(layer.on_modes()[0])
            np.testing.assert_allclose(rates[:, axis], (sides[0] - sides[1]) / (2 * width), rtol=1e-4,
                                       atol=1e-3 * np.abs(rates).max())
