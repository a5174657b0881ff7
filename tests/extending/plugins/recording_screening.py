"""A kind of job that fits nothing: it computes the signal-to-noise ratio of each recording."""

import numpy as np

from calibration.job import Job
from tissue_sim.errors import InputError


def compute_signal_to_noise_ratio(curve):
    return float(np.abs(curve.force).max() / curve.noise.deviation)


class RecordingScreening(Job):
    """Names of the recordings whose largest force is less than `min_ratio` times the noise, and all ratios."""

    kind = "screening"
    result_file = "screening.json"
    stores_simulations = False

    def __init__(self, campaign, measured, folder, context, *, min_ratio=20.0):
        super().__init__(campaign, measured, folder, context)
        self.settings = {"min_ratio": min_ratio}

    def check_before_writing(self):
        if self.settings["min_ratio"] <= 0:
            raise InputError(f"min_ratio must be positive; got {self.settings['min_ratio']}")

    def run(self):
        ratios = self.context.run_task_for_all(compute_signal_to_noise_ratio, [(curve,) for curve in self.recordings],
                                               "screening", names=[curve.name for curve in self.recordings])
        found = dict(zip([curve.name for curve in self.recordings], ratios, strict=True))
        weak = [name for name, ratio in found.items() if ratio < self.settings["min_ratio"]]
        result = {"weak": weak, "ratios": found}
        self.write_result_file(result)
        return result

    def decode_result(self, found):
        return {"weak": found["weak"], "ratios": found["ratios"]}, ()
