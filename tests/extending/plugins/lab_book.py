"""A format in one file: runs of a test as JSON, millimetres and grams, several in a file."""

import json

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.recording import Recording


def read_lab_book(path, *, curve=None):
    """All runs of the file, or the one of that number, from 1."""
    try:
        runs = json.loads(path.read_text(encoding="utf-8"))["runs"]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError("is no lab book, expected JSON with a list of runs", file=path) from None
    chosen = runs if curve is None else runs[curve - 1:curve]
    return tuple(Recording({"displacement": 1e-3 * np.array(run["mm"]), "force": 9.80665e-3 * np.array(run["g"])})
                 for run in chosen)
