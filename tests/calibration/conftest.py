"""Fixtures shared by the tests of the calibration, such as a relaxation fit."""

from types import SimpleNamespace

import numpy as np
import pytest

import calibration
import tissue_sim as ts


def terms_of(count):
    """First lines of a campaign whose material has this number of relaxing terms."""
    return ", ".join(f'"viscoelastic.terms[{i}].g" = 0.2, "viscoelastic.terms[{i}].tau_s" = {3.0 * 8**i}'
                     for i in range(count))


def _fit(folder, recordings, law, terms=1, *, kinds="lubricated_compression", noise="", test=""):
    """Fit, material and series; `kinds` is that of all recordings, or one for each."""
    recordings = [recordings] if isinstance(recordings, ts.Recording) else recordings
    kinds = [kinds] * len(recordings) if isinstance(kinds, str) else kinds
    text = ""
    for i, (recording, kind) in enumerate(zip(recordings, kinds, strict=True)):
        ts.write_recording(recording, folder / f"run_{i}.csv")
        text += f'[[test]]\nname = "run_{i}"\nkind = "{kind}"\nrecordings = ["run_{i}.csv"]\n{test}\n'
    path = folder / "relaxation.toml"
    path.write_text(f'{text}[fit]\nlaws = ["{law}"]\nstart = {{ {terms_of(terms)} }}\n[noise]\n{noise}\n',
                    encoding="utf-8")
    result, = calibration.calibrate([path], folder / "out", figures=False, overwrite=True)
    material = ts.load_material(folder / "out" / result.best.material_file)
    prony = material.viscoelastic
    return SimpleNamespace(fit=result.best, material=material, prony=prony,
                           file=folder / "out" / f"{law}.material.json",
                           values=[*material.parameters.values(), *np.column_stack([prony.g, prony.tau]).ravel()],
                           errors=list(result.best.standard_errors.values()))


@pytest.fixture(scope="session")
def fit_relaxation(tmp_path_factory):
    """A campaign of recordings, on disk, with a number of relaxing terms: called with recordings, law, terms."""
    return lambda *arguments, **options: _fit(tmp_path_factory.mktemp("relaxation"), *arguments, **options)
