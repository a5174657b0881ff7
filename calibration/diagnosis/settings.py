"""Settings of a diagnosis: decision limits with their statistical meaning, and settings of the fits of single effects.

The decision limits are significance levels, odds, cosines and fractions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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


@dataclass(frozen=True)
class DecisionLimits:
    """Limits at which a diagnosis decides; docs/theory_diagnosis.md describes the tests.

    Attributes:
        region_level: p value of a region, adjusted for the number of regions (Holm), below which its residuals are
            inadequate. A larger level finds smaller misfits and reports more misfits by chance.
        common_signal_level: p value, corrected for the number of tests with several recordings, below which the
            residuals of the recordings of a test have a common signal (analysis of variance).
        jitter_exceedance: probability that the true jitter of contact and zero exceeds the assumed one, if few
            recordings determine it. A smaller probability gives a larger assumed jitter, so that fewer offsets are
            significant by chance and small offsets are missed.
        effect_level: family-wise p value of a score, for all candidates together, below which an effect is significant.
        detectable_score: expected score, in standard deviations, of an effect that is found with a probability of 90 %:
            the critical score 4.3 for `effect_level` and a catalogue of this size, plus the 90 % quantile 1.28 of the
            normal distribution. It determines the smallest detectable size of each effect.
        twin_cosine: cosine between the changes of the whitened forces, after projection, above which two effects are
            indistinguishable in the given tests (twins).
        odds: likelihood ratio from the Schwarz criterion, exp(-delta BIC / 2), above which the less likely explanation
            is excluded. Larger odds name fewer effects and report more sets.
        min_pair_gain: smallest decrease of BIC by a second effect. Two effects reduce almost any misfit, and 50 effects
            form 1200 pairs: 2 ln 1200 corrects for the choice of a pair, and 2 ln 20 gives odds of 20.
        pair_level: largest family-wise p value of the score of a second effect in a fit with the first effect.
        max_pair_cosine: largest cosine between the changes of the forces by two effects of a pair. The difference of
            two similar effects can explain almost any misfit.
        min_score_ratio: smallest ratio of the score of the second effect alone to its score in the fit with the first
            effect.
        explained_fraction: fraction of the misfit that an effect must explain if its fit is not adequate; also the
            fraction of the total decrease of BIC that an effect must achieve to be named alone. The misfit is the
            excess of chi-square over its expectation.
        explained_without_rival: explained fraction that suffices if no other effect is a rival.
        rival_gain_ratio: decrease of BIC by another effect, relative to the best, from which the effect is a rival.
        scored_fraction: fraction of the total decrease of BIC that the added effects must achieve; the significant
            scores of the remaining effects predict the rest.
        clear_misfit_level: p value of a region below which a remaining misfit is large enough to determine the
            explained fraction.
        hold_change: difference between the measured and the computed change of the force over a hold that is described
            in words, in standard errors.
        error_growth: ratio of the squared prediction errors of unseen data, with and without the added effect, above
            which the effect is called unreliable.
        min_mentioned_percent: smallest explained percentage of the misfit from which an effect that was not added is
            mentioned.

    Raises:
        InputError: a limit is not positive.
    """

    region_level: float = 0.005
    common_signal_level: float = 1e-3
    jitter_exceedance: float = 0.2
    effect_level: float = 0.01
    detectable_score: float = 4.3 + 1.28
    twin_cosine: float = 0.97
    odds: float = 20.0
    min_pair_gain: float = 20.0
    pair_level: float = 1e-3
    max_pair_cosine: float = 0.5
    min_score_ratio: float = 0.5
    explained_fraction: float = 0.9
    explained_without_rival: float = 0.8
    rival_gain_ratio: float = 0.75
    scored_fraction: float = 0.7
    clear_misfit_level: float = 1e-4
    hold_change: float = 4.0
    error_growth: float = 1.1
    min_mentioned_percent: float = 30.0

    def __post_init__(self) -> None:
        require_all_settings_positive(self)

    @property
    def min_bic_decrease(self) -> float:
        """Smallest decrease of BIC for which an effect is accepted: `odds` against the fit without effects."""
        return 2.0 * float(np.log(self.odds))


#: Decision limits of every diagnosis.
LIMITS = DecisionLimits()
