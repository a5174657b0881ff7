"""Program that runs a job and interrupts itself, for test_jobs.py: after some simulations, or at the end of the job.

Arguments: kind of job, campaign file, output folder, number of a signal, and the number of simulations after which this
process sends the signal to itself; 0: while it writes the file of the result.
"""

import os
import signal
import sys
from pathlib import Path

import pytest

from calibration import calibrate, diagnose, evaluate_planned_experiments, load_campaign
from calibration.campaign.planned import read_or_plan_curves_of_all_tests
from calibration.diagnosis.evidence import make_one_law_whole_recording_campaign
from calibration.effects.rig import MachineCompliance
from calibration.effects.tissue import Viscoelasticity
from calibration.forward.simulation_cache import SimulationCache
from calibration.pipeline import run_campaign_jobs

#: Kind of job -> name of the file of its result.
RESULT_FILES = {"fit": "fit.json", "diagnosis": "diagnosis.json", "design": "design.json"}


def run_job(kind, campaign, out):
    """Run a job with two effects in place of the whole catalogue; "design without a folder" writes nothing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("calibration.diagnosis.proposals.CATALOGUE",
                      {"viscoelasticity": Viscoelasticity, "machine_compliance": MachineCompliance})
        if kind == "fit":
            calibrate([campaign], out, figures=False)
        elif kind == "diagnosis":
            diagnose([campaign], out, figures=False)
        elif kind == "design":
            run_campaign_jobs(
                "design", [campaign], out,
                load=lambda path: make_one_law_whole_recording_campaign(load_campaign(path, planned=True)),
                read=lambda plan: read_or_plan_curves_of_all_tests(plan, samples=60))
        else:
            evaluate_planned_experiments(campaign, samples=60)


def interrupt_after_simulations(number, count, *, in_files):
    """Send a signal to this process when `count` simulations are stored in files, or else in memory."""
    store, stored = SimulationCache.store_curve, set()

    def store_and_count(cache, key, curve):
        store(cache, key, curve)
        if (cache.folder is not None) == in_files and key not in stored:
            stored.add(key)
            if len(stored) == count:
                os.kill(os.getpid(), number)

    SimulationCache.store_curve = store_and_count


def interrupt_while_result_is_written(number):
    """Send a signal to this process when the file of a result is complete under its temporary name."""
    replace = Path.replace

    def replace_or_interrupt(path, target):
        if Path(target).name in RESULT_FILES.values():
            os.kill(os.getpid(), number)
        return replace(path, target)

    Path.replace = replace_or_interrupt


if __name__ == "__main__":
    job_kind, campaign_file, folder, signal_number, simulations = sys.argv[1:]
    # A shell that starts the tests in the background has Ctrl-C ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if int(simulations):
        interrupt_after_simulations(int(signal_number), int(simulations), in_files=job_kind in RESULT_FILES)
    else:
        interrupt_while_result_is_written(int(signal_number))
    run_job(job_kind, campaign_file, folder)
