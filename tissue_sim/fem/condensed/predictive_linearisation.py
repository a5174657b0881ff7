"""Linearisation of the bulk at the predicted pose of the tool."""

from __future__ import annotations

from dataclasses import dataclass, replace

from tissue_sim.fem.condensed.model import BulkLineariser, CondensedBulk, ContactState
from tissue_sim.fem.condensed.stepper import CondensedStepper
from tissue_sim.material.material import Material
from tissue_sim.pose import Pose, compute_pose_distance, interpolate_pose


@dataclass(frozen=True)
class PredictionSettings:
    """Settings of the prediction of the pose at which the bulk is linearised.

    Attributes:
        lead_factor: prediction time over the duration of a linearisation, 1. A linearisation is in use from one to two
            durations after its start; longer predictions lose more accuracy where the tool changes direction than they
            gain elsewhere.
        max_prediction: largest predicted motion of the tool, over the radius of the contact, 1.
        max_increment: largest increment of the predicted motion, over the radius of the contact, 1. The friction of
            the prediction is discarded, so that coarse increments are sufficient.
    """

    lead_factor: float = 1.25
    max_prediction: float = 1.0
    max_increment: float = 0.12


#: Settings of every prediction.
PREDICTION = PredictionSettings()


class PredictiveLineariser:
    """Linearise the bulk at the pose that the tool will have in the middle of the period of use.

    A linearisation is in use from one to two durations of its computation after its start. The contact is first stepped
    on the last linearisation to the pose that the tool reaches with constant velocity. Only the iterate of the bulk is
    kept; friction continues from the actual state.

    Args:
        linearisation: Newton iteration of the bulk.
    """

    def __init__(self, linearisation: BulkLineariser):
        self._linearisation = linearisation
        self._stepper = CondensedStepper(linearisation.surface, PREDICTION.max_increment)
        self._epoch = self._material = 0

    def linearise_at_predicted_pose_or_none(self, state: ContactState, lead: float,
                                            serves: float) -> CondensedBulk | None:
        """Linearise the bulk for the predicted pose, and return the linearisation.

        Args:
            state: newest state of the contact.
            lead: time from the state to the middle of the period of use, s.
            serves: time from the state to the end of the use of the present tangent, s.

        Returns:
            None under the conditions of `BulkLineariser.iterate_and_linearise_or_none`.
        """
        stepper, ahead = self._stepper, self.extrapolate_pose(state, lead)
        predicted = state
        if stepper.model is not None and state.model == stepper.model.number and state.epoch == self._epoch and (
                ahead != state.pose):
            stepper.load_state(state)
            if stepper.step(ahead).converged:
                predicted = replace(state, pose=ahead, forces=stepper.forces.copy())
        model = self._linearisation.iterate_and_linearise_or_none(predicted,
                                                                  (state.pose, self.extrapolate_pose(state, serves)))
        if model is None:
            return None
        has_contact = bool(predicted.forces.any()) or (state.touched and model.has_tissue_bonded_to_tool)
        model = replace(model, material=self._material, has_contact=has_contact)
        stepper.set_linearisation(model)
        self._epoch = state.epoch
        return model

    def set_material(self, material: Material, number: int) -> None:
        """Change the material of the bulk.

        Args:
            material: new material.
            number: number of the change, `CondensedBulk.material` of all later linearisations.

        Raises:
            InputError: the bulk does not support the material; the material stays.
        """
        self._linearisation.set_material(material)
        self._material = number

    def extrapolate_pose(self, state: ContactState, lead: float) -> Pose:
        """Return the pose of the tool `lead` seconds after a state, extrapolated with constant velocity.

        The motion is limited to `PredictionSettings.max_prediction`.
        """
        passed = state.time - state.earlier
        if passed <= 0.0:
            return state.pose
        radius = self._linearisation.surface.radius
        distance = compute_pose_distance(state.before, state.pose, radius)
        factor = lead / passed
        if distance * factor > 0.0:
            factor = min(factor, PREDICTION.max_prediction * radius / distance)
        return interpolate_pose(state.before, state.pose, 1.0 + factor)
