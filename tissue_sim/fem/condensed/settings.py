"""Settings of the contact on a condensed bulk."""

from dataclasses import dataclass


@dataclass(frozen=True)
class StepperSettings:
    """Settings of `CondensedStepper`.

    Attributes:
        max_iterations: maximum number of contact iterations of an increment.
        max_exact_iterations: maximum number of contact iterations of an increment in an exact step.
        max_flat_iterations: number of iterations in which the linear equations keep the contact states that
            `TangentPlaneContact` found.
        flat_gap: nodes with a gap below this fraction of the contact radius take part in the flat contact.
        flat_tolerance: relative residual of the flat contact.
        near_gap: nodes with a gap above this fraction of the contact radius are not evaluated until the tool or the
            tissue has moved by a third of this gap.
        force_tolerance: relative change of the forces at which an iteration has converged.
        exact_factor: factor of `force_tolerance` in an exact step.
        exact_violation: factor of the tolerance of the contact conditions in an exact step.
        negligible_friction: friction below this fraction of the surface's smallest force is neglected.
        max_stiffness_factor: derivatives of forces above this multiple of the largest stiffness of a single node are
            discarded.
        reassembly_interval: number of increments that use the same derivatives if the same nodes are in contact.
        max_increment: largest increment of the tool, as a fraction of the contact radius.
        min_increment: smallest increment after failures, as a fraction of `max_increment`.
        violation_factor: tolerance of the contact conditions over that of the surface.
    """

    max_iterations: int = 10
    max_exact_iterations: int = 24
    max_flat_iterations: int = 5
    flat_gap: float = 0.06
    flat_tolerance: float = 1e-6
    near_gap: float = 0.2
    force_tolerance: float = 1e-4
    exact_factor: float = 1e-6
    exact_violation: float = 1e-4
    negligible_friction: float = 1e-6
    max_stiffness_factor: float = 10.0
    reassembly_interval: int = 8
    max_increment: float = 0.03
    min_increment: float = 0.5
    violation_factor: float = 0.5
