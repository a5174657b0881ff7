"""Settings of the fits of single effects, see `calibration.diagnosis.refits`."""

from __future__ import annotations

from dataclasses import dataclass

from tissue_sim.settings import require_all_settings_positive


@dataclass(frozen=True)
class RefitSettings:
    """Settings that select effects by their scores and control their nonlinear fits.

    Attributes:
        max_effects: largest number of effects that are fitted.
        max_similar: largest number of fitted effects if further scores are close to the best.
        similar: ratio to the best score above which a further score is close.
        shape_margin: largest difference of squared scores for which a second value of the shape parameters is fitted.
        promising: fraction of the smallest acceptable decrease of BIC; effects with a larger squared score are fitted.
        rival_margin: effects whose squared score is within this difference of the best are fitted, too.
        near: difference to the best decrease of BIC, as a fraction of it, within which the mesh correction is computed
            for the effect itself.
        min_near: smallest difference for the same purpose; the larger one applies.
        shortfall: difference between predicted and achieved decrease of the sum of squares above which the descent
            continues.
        on_bound: relative distance at which a parameter counts as on its bound.
        starts: fractions of the size from the score at which a fit starts; the first that improves the fit is used.
        jump_steps: distances, in steps of the sampled displacement, by which the position of a jump is shifted in both
            directions after a fit.
        max_jump_moves: maximum number of repetitions of this search, because a fit can change the contact positions.
        gain: predicted decrease of the sum of squares at which a descent ends; differences between effects are much
            larger.
        tolerance: relative tolerance of the descent.
        patience: number of evaluations without sufficient decrease after which a descent ends.

    Raises:
        InputError: a setting is not positive and finite, a count is not a whole number, or a sequence is empty.
    """

    max_effects: int = 6
    max_similar: int = 10
    similar: float = 0.9
    shape_margin: float = 20.0
    promising: float = 0.6
    rival_margin: float = 8.0
    near: float = 0.3
    min_near: float = 40.0
    shortfall: float = 1.0
    on_bound: float = 1e-4
    starts: tuple[float, ...] = (1.0, 0.3, 0.1)
    jump_steps: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0)
    max_jump_moves: int = 3
    gain: float = 0.1
    tolerance: float = 2e-5
    patience: int = 4

    def __post_init__(self) -> None:
        require_all_settings_positive(self)


#: Default settings of the fits of effects.
REFITS = RefitSettings()
