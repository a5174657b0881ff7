"""Linearising a tissue's bulk where its tool will be."""

from __future__ import annotations

from dataclasses import replace

from tissue_sim.fem.condensed.model import BulkLinearisation, CondensedContact, ContactState
from tissue_sim.fem.condensed.stepper import CondensedStepper
from tissue_sim.material.material import Material
from tissue_sim.pose import Pose, between, motion

#: A model is made for the pose so many times the time that it takes ahead: it comes after once that time and serves for
#: as long again; farther ahead costs more at corners than it gains on the way.
LEAD = 1.25
#: A tool is not followed further ahead than this share of the contact's radius.
_FARTHEST = 1.0
#: Its way is gone in parts of this share of that: friction is not remembered.
_PART = 0.12


class ForesightedLinearisation:
    """Linearises where the tool will be in the middle of the time for which the model serves.

    What was linearised where the tool was is one to two times the time of a linearisation old when it is used. The
    contact is stepped ahead on the last model to where the tool goes if it keeps its speed; nothing of that is
    remembered but the iterate of the bulk: friction goes on from where it really is.

    Args:
        linearisation: of the bulk.
    """

    def __init__(self, linearisation: BulkLinearisation):
        self._linearisation = linearisation
        self._stepper = CondensedStepper(linearisation.surface, _PART)
        self._epoch = self._material = 0

    def linearise(self, state: ContactState, lead: float, serves: float) -> CondensedContact | None:
        """The next model.

        Args:
            state: of the contact, newest.
            lead: how long after it the middle of the time is for which the model serves, s.
            serves: how long after it a tangent of now still serves, s.

        Returns:
            None as of `BulkLinearisation.linearise`.
        """
        stepper, ahead = self._stepper, self.pose_after(state, lead)
        then = state
        if stepper.model is not None and state.model == stepper.model.number and state.epoch == self._epoch and (
                ahead != state.pose):
            stepper.take(state)
            if stepper.step(ahead).converged:
                then = replace(state, pose=ahead, forces=stepper.forces.copy())
        model = self._linearisation.linearise(then, (state.pose, self.pose_after(state, serves)))
        if model is None:
            return None
        has_contact = bool(then.forces.any()) or (state.touched and model.is_held)
        model = replace(model, material=self._material, has_contact=has_contact)
        stepper.adopt(model)
        self._epoch = state.epoch
        return model

    def set_material(self, material: Material, number: int) -> None:
        """Change the material of the bulk.

        Args:
            material: the new one.
            number: of the change, which all models from now on carry.

        Raises:
            InputError: a material that the bulk refuses; it keeps its own.
        """
        self._linearisation.set_material(material)
        self._material = number

    def pose_after(self, state: ContactState, lead: float) -> Pose:
        """Where the tool is after some time, s, if it keeps its speed."""
        passed = state.time - state.earlier
        if passed <= 0.0:
            return state.pose
        way = self._stepper.distance(motion(state.before, state.pose))
        share = lead / passed
        if way * share > 0.0:
            share = min(share, _FARTHEST * self._linearisation.surface.radius / way)
        return between(state.before, state.pose, 1.0 + share)
