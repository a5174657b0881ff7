"""Latency of the force channel relative to the displacement channel."""

from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect


class Latency(Effect):
    """Effect of a time, s, by which the force is recorded later than the displacement."""

    name = "latency"
    category = "rig"
    title = "latency of the force"
    signature = "the force lags: it is too low in loading and too high in unloading, in proportion to the speed"
    separated_by = "a second speed"
    #: Trial latency as a fraction of the duration of the fastest loading.
    trial_fraction = 0.01

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates with a latency above the stated one."""
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        fastest = situation.find_largest_loading_speed(tests)
        size = self.trial_fraction * min(map(situation.largest_displacement, tests)) / fastest
        return make_experiment_or_rig_candidates(self, situation, "rig.latency", tests, lambda _: size, two_sided=False)
