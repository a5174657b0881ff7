"""Coverage and width of the 95 % interval of the contact point, and detection rate of failures.

    python -m benchmarks contact [--json] [--recordings N] [--seed N]

Recordings are those of `virtual_recordings.py`: noise of 0.01 to 0.3 % of the largest force, 100 to 1000 samples after
contact, air of 8 samples to as much as the loading, drift, preload, relaxation. A width is in sampling steps, from the
first sample on where the interval is open. A failure counts as found within 3 samples of the last intact one, or within
5 % of the way where it comes little by little.
"""

import argparse
import time
from collections.abc import Sequence

import numpy as np

from benchmarks.inverse.virtual_recordings import Virtual, break_or_not, touch
from tissue_sim.recording.contact import Contact, find_contact
from tissue_sim.recording.failure import Failure, find_failure

#: Smallest accepted coverage of the 95 % intervals.
LEAST = 0.92
#: Largest accepted coverage.
MOST = 0.98
#: Largest accepted median width of an interval, in ideal widths.
WIDEST = 4.0
#: Smallest accepted fraction of failures that are found.
FOUND = 0.95
#: Largest distance between a sudden failure and the detected one, samples.
NEAR = 3
#: The same for a gradual failure, as a fraction of the motion.
NEAR_SHARE = 0.05


def contacts(recordings: int, seed: int) -> list[dict]:
    """Return one row for each recording: description, coverage, width in steps, status, CPU time (s)."""
    rows = []
    for number in range(recordings):
        virtual = touch(seed, number)
        began = time.process_time()
        found = find_contact(virtual.displacement, virtual.force, virtual.time)
        rows.append({**virtual.words, **judge_contact(virtual, found), "status": found.status,
                     "cpu_s": time.process_time() - began})
    return rows


def judge_contact(virtual: Virtual, found: Contact) -> dict:
    """Return whether the interval contains the true contact, and its width in sampling steps."""
    low, high = found.interval
    width = (high - max(low, float(virtual.displacement[0]))) / virtual.step
    return {"holds": bool(low <= virtual.truth <= high), "width": width}


def failures(recordings: int, seed: int) -> list[dict]:
    """Return one row for each test: equal numbers of tests with a failure and of intact ones."""
    rows = []
    for fails in (True, False):
        for number in range(recordings):
            virtual = break_or_not(seed, number, fails=fails)
            found = find_failure(virtual.displacement, virtual.force, virtual.time)
            rows.append({**virtual.words, "right": judge_failure(virtual, found)})
    return rows


def judge_failure(virtual: Virtual, found: Failure | None) -> bool:
    """Return whether the failure of a test is found at its sample; for an intact test, whether none is found."""
    if virtual.truth < 0 or found is None:
        return virtual.truth < 0 and found is None
    gradual = virtual.words["failure"] == "little by little"
    return abs(found.index - virtual.truth) <= max(NEAR, NEAR_SHARE * virtual.truth if gradual else 0)


def coverage(rows: Sequence[dict]) -> tuple[float, float]:
    """Return the fraction of intervals that contain the true contact, and the median width in steps."""
    return float(np.mean([row["holds"] for row in rows])), float(np.median([row["width"] for row in rows]))


def draw(result: dict, console) -> None:
    """Print the result as tables."""
    from benchmarks.measure import table, verdict

    rows, broken = result["contacts"], result["failures"]
    share, width = coverage(rows)
    lines = [["all", str(len(rows)), f"{share:.3f}", f"{width:.1f}"]]
    for key in ("noise of largest force", "noise", "material", "preload", "shape", "status"):
        for word in sorted({row[key] for row in rows}):
            some = [row for row in rows if row[key] == word]
            lines.append([word if key == "shape" else f"{key}: {word}", str(len(some)), f"{coverage(some)[0]:.3f}",
                          f"{coverage(some)[1]:.1f}"])
    table(console, "contact: share of 95 % intervals that hold the truth, median width in sampling steps",
          ["recordings", "number", "coverage", "width"], lines)
    console.print(verdict(LEAST <= share <= MOST, f"coverage {LEAST} to {MOST}:") + "; "
                  + verdict(width <= WIDEST, f"median width of at most {WIDEST:g} steps:")
                  + f"; {np.mean([row['cpu_s'] for row in rows]):.3f} CPU s each")
    lines = []
    for word in sorted({row["failure"] for row in broken}):
        some = [row for row in broken if row["failure"] == word]
        lines.append([word, str(len(some)), f"{np.mean([row['right'] for row in some]):.3f}"])
    table(console, "failure: share that is found where it is; of intact ones, share in which none is found",
          ["failure", "number", "right"], lines)
    found = np.mean([row["right"] for row in broken if row["failure"] != "intact"])
    wrong = sum(not row["right"] for row in broken if row["failure"] == "intact")
    console.print(verdict(bool(found >= FOUND), f"found in {FOUND:g}:") + "; "
                  + verdict(wrong == 0, "none in intact ones:"))


def main() -> None:
    from benchmarks.measure import about, show

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--recordings", type=int, default=200, metavar="N")
    parser.add_argument("--seed", type=int, default=1, metavar="N")
    arguments = parser.parse_args()
    result = about("contact") | {"recordings": arguments.recordings, "seed": arguments.seed,
                                 "contacts": contacts(arguments.recordings, arguments.seed),
                                 "failures": failures(arguments.recordings, arguments.seed)}
    show(result, draw, as_json=arguments.json)


if __name__ == "__main__":
    main()
