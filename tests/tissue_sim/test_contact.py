"""Tools that lift off and come back, with friction and with adhesion, through the function that a user calls."""

import numpy as np
import pytest

import tissue_sim as ts

MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
RADIUS = 8e-3


def force(friction, tool, places, base=None, adhesion=None):
    """Force, N, of the study's cylinder at these places of the tool, m; its base is bonded where nothing is said."""
    protocol = ts.Protocol(np.arange(float(len(places))), places)
    return ts.simulate(ts.Model(ts.Experiment(
        ts.Specimen(0.040, 0.070), protocol, tool or ts.Tool(), friction=friction, friction_base=base or "bonded",
        adhesion=adhesion), MATERIAL)).force


class TestLiftOff:
    @pytest.mark.slow
    @pytest.mark.parametrize(("tool", "mu"), [
        (None, 0.1), (None, 0.4), (None, 0.7), (ts.Tool("flat", RADIUS, 1e-3), 0.4), (ts.Tool("round", RADIUS), 0.4),
        (ts.Tool("cone", RADIUS, half_angle=1.0, tip_radius=5e-4), 0.1)])
    def test_no_force_above_the_tissue_and_the_curve_again(self, tool, mu):
        """Nodes that touch again are bonded from the end of that step on, so that loading begins with small steps."""
        down, gently = np.linspace(0.0, 6e-3, 13), 1e-3 * np.array([0.0, 0.01, 0.02, 0.04, 0.08, 0.15, 0.3])
        found = force(mu, tool, [*down, *down[-2::-1], -1e-3, *gently, *down[1:], -2e-3], base=None if tool else mu)
        assert found[25] == found[-1] == 0.0 and abs(found[24]) < 1e-4 * found[12]
        assert abs(found[33:45] - found[1:13]).max() < 1e-3 * found[12]


class TestAdhesion:
    FORCE = 0.02
    #: Length, m.
    LENGTH = 0.5e-3

    def curves(self, friction, tool=None, base=None):
        """Force with and without adhesion: to 1 mm and back in 8 steps, then 0.02 mm a step to 0.8 mm above."""
        down = np.linspace(0.0, 1e-3, 5)
        places = np.array([*down, *down[-2::-1], *(-0.02e-3 * np.arange(1.0, 41.0))])
        adhesion = ts.Adhesion(self.FORCE, self.LENGTH)
        return (places, *(force(friction, tool, places, base or friction, each) for each in (adhesion, None)))

    @pytest.mark.slow
    @pytest.mark.parametrize(("friction", "tool", "base", "short"), [
        ("frictionless", None, None, 0.02), ("stick", None, "bonded", 0.03), (0.3, None, "bonded", 0.03),
        ("stick", ts.Tool("flat", RADIUS), "bonded", 0.07)])
    def test_pull_off(self, friction, tool, base, short):
        """A plate separates almost everywhere at once; with a bonded base its rim separates first. Under a sharp punch
        the edge separates first, so it pulls a little less."""
        places, found, plain = self.curves(friction, tool, base)
        assert found.min() == pytest.approx(-self.FORCE, rel=short)
        retracting = np.arange(found.size) > 8
        # The tissue may stretch after the tool by what the pull does to it, here less than the length.
        pulled = retracting & (places > -0.3e-3)
        assert (found[pulled] < 0).all() and plain[retracting].max() == 0.0
        assert abs(found[places < -self.LENGTH - 0.2e-3]).max() < 1e-9
        assert (np.diff(found[found.argmin():]) > -1e-9).all()

    @pytest.mark.slow
    @pytest.mark.parametrize(("friction", "tool"), [("frictionless", None), ("stick", None),
                                                    ("stick", ts.Tool("flat", RADIUS))])
    def test_first_loading_is_that_without_adhesion(self, friction, tool):
        _, found, plain = self.curves(friction, tool, "bonded" if friction == "stick" else None)
        np.testing.assert_allclose(found[:5], plain[:5], atol=1e-8)

    @pytest.mark.slow
    def test_friction_takes_the_pull_as_pressure(self):
        """Adhesion presses the faces together, so that more sticks."""
        _, found, plain = self.curves(0.3, None, "bonded")
        assert (found[1:5] > plain[1:5]).all() and abs(found[:5] - plain[:5]).max() < 0.1 * self.FORCE

    @pytest.mark.parametrize(("arguments", "words"), [((-1.0, 1e-3), "must be 0 or more; got -1 N"),
                                                      ((np.nan, 1e-3), "must be 0 or more; got nan N"),
                                                      ((0.1, 0.0), "adhesion.length")])
    def test_refused(self, arguments, words):
        with pytest.raises(ts.InputError, match=words):
            ts.Adhesion(*arguments)
