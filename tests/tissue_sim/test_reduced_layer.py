"""The elastic layer between a tool and a reduced solid: friction, and derivatives of its forces."""

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.contact.pairs import ContactPair
from tissue_sim.fem.reduced.contact import PenaltyContact
from tissue_sim.fem.solid.contact import ToolFrame
from tissue_sim.pose import rotate_pose_about_its_position


class TestLayer:
    """Nodes that move alone: the modes are their freedoms."""

    #: Coefficient of friction, 1.
    MU = 0.3
    SPRING = 1e5 * 1e-6 / (1e-3 * 5e-3)

    def contact(self, tool: ts.Tool, mu: float) -> PenaltyContact:
        body = ContactPair(tool.profile, np.array([0]), (mu, mu))
        layer = PenaltyContact([body], np.zeros((1, 3)), np.array([1e-6]), np.eye(3), reach=5e-3, softness=1e-3)
        layer.set_penalty_and_get_smallest_modulus(np.array([1e5]))
        return layer

    @staticmethod
    def frame(*position: float) -> ToolFrame:
        return ToolFrame(ts.Pose(position), 0.0)

    def test_sticks_up_to_mu_times_the_pressure(self):
        layer, depth = self.contact(ts.Tool("flat", radius=8e-3), self.MU), 1e-4
        layer.evaluate_contact(np.zeros(3), self.frame(0.0, 0.0, -depth), True)
        np.testing.assert_allclose(layer.forces[0], [0.0, 0.0, -self.SPRING * depth], rtol=1e-12)
        layer.commit_step()
        for way in (1e-5, 2.9e-5, 3.1e-5, 2e-4):
            layer.evaluate_contact(np.zeros(3), self.frame(way, 0.0, -depth), True)
            # It drags the tissue along.
            assert layer.forces[0, 0] == pytest.approx(self.SPRING * min(way, self.MU * depth), rel=1e-9)
            assert layer.slipping_count == (way > self.MU * depth)

    def test_back_from_sliding_it_sticks_where_it_slid_to(self):
        layer, depth = self.contact(ts.Tool("flat", radius=8e-3), self.MU), 1e-4
        for way in (0.0, 1e-3, 1e-3 - 1e-5):
            layer.evaluate_contact(np.zeros(3), self.frame(way, 0.0, -depth), True)
            layer.commit_step()
        assert layer.forces[0, 0] == pytest.approx(self.SPRING * (self.MU * depth - 1e-5), rel=1e-9)

    @pytest.mark.parametrize("mu", [0.0, 0.3])
    @pytest.mark.parametrize("tool", [ts.Tool("round", radius=8e-3), ts.Tool("cone", radius=6e-3, half_angle=1.0)],
                             ids=lambda tool: tool.shape)
    def test_its_rates_are_those_of_its_forces(self, tool, mu):
        layer, at = self.contact(tool, mu), np.array([2e-3, 1e-3, 0.0])
        pose = self.frame(0.0, 0.0, -3e-3)
        layer.evaluate_contact(at, pose, True)
        layer.commit_step()
        moved = np.add(at, [3e-6, -1e-6, 2e-6])
        layer.evaluate_contact(moved, pose, True)
        _, rates = layer.get_modal_forces_and_stiffness()
        width = 1e-9
        for axis in range(3):
            sides = []
            for sign in (1.0, -1.0):
                layer.evaluate_contact(moved + sign * width * np.eye(3)[axis], pose, True)
                sides.append(layer.get_modal_forces_and_stiffness()[0])
            np.testing.assert_allclose(rates[:, axis], (sides[0] - sides[1]) / (2 * width), rtol=1e-4,
                                       atol=1e-3 * np.abs(rates).max())

    # With friction they leave out how the force along the surface bends with it.
    @pytest.mark.parametrize(("mu", "close"), [(0.0, 1e-4), (0.3, 5e-3)])
    @pytest.mark.parametrize("follows", [False, True])
    def test_its_answers_to_the_tool_are_derivatives(self, mu, close, follows):
        """Derivatives of forces and wrench with respect to tool position and rotation, on fixed and moving tissue."""
        layer, at = self.contact(ts.Tool("round", radius=8e-3), mu), np.array([2e-3, 1e-3, 0.0])
        answer = np.zeros((3, 6))
        pose = rotate_pose_about_its_position(ts.Pose((1e-4, 0.0, -3e-3)), (0.1, -0.05, 0.02))
        layer.evaluate_contact(at, ToolFrame(pose, 0.0), True)
        layer.commit_step()
        at = np.add(at, [3e-6, -1e-6, 2e-6])
        if follows:
            answer[:] = 0.1 * np.random.default_rng(0).standard_normal((3, 6)) * [1.0, 1.0, 1.0, 5e-3, 5e-3, 5e-3]
        layer.evaluate_contact(at, ToolFrame(pose, 0.0), True)
        rates = layer.modal_force_derivative_by_pose + layer.get_modal_forces_and_stiffness()[1] @ answer
        stiffness = layer.compute_contact_stiffness_at_tool(answer)
        for axis in range(6):
            width = 1e-9 if axis < 3 else 1e-7
            pushes, wrenches = [], []
            for change in (width * np.eye(6)[axis], -width * np.eye(6)[axis]):
                there = rotate_pose_about_its_position(ts.Pose(tuple(pose.position + change[:3]), pose.orientation),
                                                       tuple(change[3:]))
                layer.evaluate_contact(at + answer @ change, ToolFrame(there, 0.0), True)
                pushes.append(layer.get_modal_forces_and_stiffness()[0])
                wrenches.append(layer.wrench)
            for found, sides, sign in ((rates, pushes, 1.0), (stiffness, wrenches, -1.0)):
                np.testing.assert_allclose(found[:, axis], sign * (sides[0] - sides[1]) / (2.0 * width), rtol=close,
                                           atol=close * np.abs(found).max())

    def test_its_force_follows_the_tissue(self):
        layer, at, change = self.contact(ts.Tool("round", radius=8e-3), 0.0), np.array([2e-3, 1e-3, 0.0]), np.array(
            [1e-9, -2e-9, 3e-9])
        sides = []
        for place in (at + change, at - change, at):
            layer.evaluate_contact(place, self.frame(0.0, 0.0, -3e-3), True)
            sides.append(layer.wrench[:3])
        np.testing.assert_allclose(layer.compute_force_change_by_amplitudes(2.0 * change), sides[0] - sides[1],
                                   rtol=1e-5)
