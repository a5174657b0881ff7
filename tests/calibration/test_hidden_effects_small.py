"""benchmarks/hidden_effects, small: its scores on runs whose score is known, its truths, and two runs end to end."""

import json
import math

import numpy as np
import pytest

NAMES = ("truth", "cases", "sizes", "recordings", "peers", "scoring", "run", "tables")


@pytest.fixture(scope="module")
def study(benchmark_module, tmp_path_factory):
    """The modules of the study by name; ``main`` is its command line."""
    found = {name: benchmark_module(f"hidden_effects.{name}") for name in NAMES}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(found["truth"], "CACHE", tmp_path_factory.mktemp("cache"))
        yield {**found, "main": benchmark_module("hidden_effects.__main__")}


def made(verdict, named=(), others=(), effects=("latency",), **changes):
    """A run that ended so."""
    return {"name": f"{verdict}{named}{others}{effects}", "protocol": "full", "room": "hidden", "form": "exact",
            "class": "> 10", "signal": 20.0, "testable": True, "effects": list(effects), "twins": [],
            "verdict": verdict, "named": list(named), "indistinguishable": list(others), "weights": {},
            "catalogue": ["latency", "tilt", "backlash", "layer", "softening"], "not_testable": [],
            "fit_before": {"C10": [1100.0, 1.0], "C20": [500.0, 1.0]}, "fit_after": None, "held_out": [],
            "scatter": {"coloured": False}, "wall_s": 1.0, **changes}


@pytest.mark.parametrize(("run", "expected", "inside"), [
    (made("NAMED", ["latency"], ["latency"]), "right", True),
    (made("NAMED", ["tilt"], ["tilt@B"]), "wrong", False),
    # A second effect that is not there is a wrong name.
    (made("NAMED", ["latency", "tilt"], ["latency", "tilt@A"]), "wrong", True),
    (made("NAMED", ["latency", "tilt"], ["latency", "tilt@A"], ("latency", "tilt")), "right", True),
    (made("SET", ["tilt"], ["tilt", "latency"]), "set", True),
    (made("SET", ["tilt"], ["tilt", "backlash", "layer"]), "wrong set", False),
    (made("SET", ["tilt"], ["tilt", "latency", "backlash", "layer"]), "long set", False),
    # Stated twins of the truth do not make a set long.
    (made("SET", ["tilt"], ["tilt", "latency", "backlash", "layer"], twins=["tilt"]), "set", True),
    # One effect in several tests is one name.
    (made("SET", ["latency"], ["latency@A", "latency@B"]), "right", True),
    (made("LOOKS_LIKE", ["latency"], ["latency"]), "looks right", True),
    (made("LOOKS_LIKE", ["tilt"], ["tilt"]), "looks wrong", False),
    (made("UNKNOWN"), "unknown", False), (made("NONE"), "none", False)])
def test_outcomes(study, run, expected, inside):
    assert study["scoring"].outcome(run) == expected and study["scoring"].in_reported(run) == inside


def test_shares_and_their_intervals(study):
    scoring = study["scoring"]
    # Wilson, J. American Statistical Association 22 (1927) 209; 0 of 380 shows a rate below 1 % and 0 of 378 does not
    # as far as the third digit.
    assert scoring.wilson(0, 380)[1] == pytest.approx(0.01, abs=2e-5)
    assert scoring.wilson(5, 10) == pytest.approx((0.2366, 0.7634), abs=1e-4)
    assert scoring.wilson(0, 0) == (0.0, 1.0)


def test_log_score_and_levels(study):
    scoring = study["scoring"]
    sure = made("NAMED", ["latency"], ["latency"], weights={"latency": 1.0, "tilt": 0.01})
    assert scoring.log_score(sure) == pytest.approx(math.log(0.95 + 0.05 / 7))
    assert sum(scoring.probabilities(sure).values()) == pytest.approx(1.0)
    torn = made("SET", ["latency"], ["latency", "tilt"], weights={"latency": 1.0, "tilt": 0.25})
    assert scoring.log_score(torn) == pytest.approx(math.log(0.95 * 0.8 + 0.05 / 7))
    wrong = made("NAMED", ["tilt"], ["tilt"], weights={"tilt": 1.0, "latency": 0.6})
    rows = {row["from"]: row for row in scoring.words([sure, torn, wrong])}
    assert (rows[0.99]["hits"], rows[0.99]["of"]) == (1, 1) and (rows[0.75]["hits"], rows[0.75]["of"]) == (1, 1)
    assert (rows[0.5]["hits"], rows[0.5]["of"]) == (0, 1)
    # From the surest on: first a right one, then a wrong one.
    levels = [scoring.confidence(run) for run in (sure, wrong)]
    assert scoring.error_against_coverage([sure, wrong], levels, [False, True]) == [(0.5, 0.0), (1.0, 0.5)]


def test_figures_of_known_runs(study):
    after = {"C10": [1404.9 * 1.002, 2.0], "C20": [699.4, 5.0]}
    named = made("NAMED", ["latency"], ["latency"], fit_after=after, held_out=[
        {"kind": "test", "adequate_after": True, "before_N": 0.1, "after_N": 0.02},
        {"kind": "replicate", "adequate_after": False, "before_N": 0.1, "after_N": 0.2}])
    runs = [named, made("NAMED", ["tilt"], ["tilt"]), made("NONE", signal=2.0, **{"class": "< 3"}),
            made("NAMED", ["latency"], ["latency"], form="other", fit_after=after),
            made("NONE", effects=(), room="none", form=""), made("NAMED", ["tilt"], effects=(), room="outside"),
            made("SET", ["tilt"], ["sensor_gain", "tilt"], ("sensor_gain",)),
            made("NONE", effects=("sensor_gain",), not_testable=["sensor_gain"]),
            made("NONE", effects=("sensor_gain",))]
    found = study["scoring"].score(runs, study["tables"].TRUTH)

    def counts(row):
        return row["hits"], row["of"]

    assert set(found["exact"]) == {"> 10", "< 3", "testable, 3 and more"}
    assert counts(found["exact"]["> 10"]["unique and right"]) == (1, 2)
    assert counts(found["exact"]["> 10"]["unique and wrong"]) == (1, 2)
    assert counts(found["other form"]["> 10"]["right kind"]) == (1, 1)
    assert counts(found["nothing hidden"]["white"]) == (0, 1)
    assert counts(found["outside, unlike"]["unique name"]) == (1, 1)
    assert counts(found["sensor_gain"]) == (2, 3)
    assert counts(found["held-out test"]["rejects"]) == (0, 1) and counts(found["held-out replicate"]["fell"]) == (0, 1)
    assert found["bias"]["C10"]["smaller"] == pytest.approx((1 - 1100 / 1404.9) / 0.002)
    assert counts(found["bias"]["C10"]["covered"]) == (1, 1)


def test_truths_are_those_of_others(study, root):
    """Relaxation on the force, tilt and compliance against what others computed, or what must be."""
    truth, cases = study["truth"], study["cases"]
    slow = truth.full()[0]
    stored = np.loadtxt(root / "tests" / "reference" / "lubricated_prony.csv", delimiter=",", skiprows=2)
    relaxing = truth.hereditary(slow, truth.plain("A", slow.displacement), lambda t: 1 - 0.3 * (1 - np.exp(-t / 2)))
    assert np.interp(stored[:, 0], slow.time, relaxing) == pytest.approx(stored[:, 4], abs=3e-4)
    assert truth.lubricated(np.array([10e-3])) == pytest.approx(7.59995, abs=1e-5)
    hidden = cases.hidden()
    # A load train of 0.01 mm/N, and a leaning face: behind by compliance times force, and by half of the tilt.
    assert hidden["machine_compliance/exact"].force(slow, 1e-5).max() == pytest.approx(
        truth.plain("A", np.array([10e-3 - 1e-5 * 7.52]))[0], rel=2e-3)
    deep = slow.displacement > 5e-3
    for form in ("exact", "other"):
        leaning = hidden[f"tilt/{form}"].force(slow, 0.2e-3)[deep]
        assert leaning == pytest.approx(truth.plain("A", slow.displacement[deep] - 0.1e-3), rel=1e-4)
    # At its smallest size an effect is as good as absent.
    for key, case in hidden.items():
        if case.origin == "independent":
            change = case.force(slow, 1e-3 * case.low) - truth.plain("A", slow.displacement)
            assert np.abs(change).max() < 2e-4, key


def test_the_frozen_table_names_what_no_test_tells(study):
    table = study["sizes"].frozen()
    for protocol in ("ramps", "full"):
        assert set(table[protocol]) == {*study["cases"].hidden(), *study["cases"].outside()}
        assert not any(table[protocol][f"{effect}/exact"]["testable"] for effect in ("sensor_gain", "population"))
    assert table["animals"]["population/exact"]["testable"]
    assert not table["ramps"]["backlash/exact"]["testable"] and table["full"]["backlash/exact"]["testable"]
    assert "rate_damping" in table["ramps"]["guide_friction/exact"]["twins"]
    assert "rate_damping" not in table["full"]["guide_friction/exact"]["twins"]


def test_seeds_are_kept_apart(study, tmp_path, monkeypatch):
    main, ledger = study["main"], tmp_path / "ledger.jsonl"
    with pytest.raises(SystemExit, match="sealed"):
        main.check_seeds([1000], "a" * 64, sealed=False, ledger=ledger)
    with pytest.raises(SystemExit, match="development"):
        main.check_seeds([999], "a" * 64, sealed=True, ledger=ledger)
    ledger.write_text(json.dumps({"hash": "a" * 64, "first": 1000, "last": 1010, "date": "2026-01-01"}) + "\n")
    main.check_seeds(range(1000, 1011), "a" * 64, sealed=True, ledger=ledger)  # resumed
    with pytest.raises(SystemExit, match="fresh ones from 1011"):
        main.check_seeds([1005], "b" * 64, sealed=True, ledger=ledger)
    assert main.shard_of("2/8") == (2, 8)
    with pytest.raises(SystemExit, match="give I/N"):
        main.shard_of("9/8")


@pytest.fixture
def plates(study, monkeypatch):
    """A protocol of one compression with loading and unloading, and its table of sizes."""
    truth, run = study["truth"], study["run"]
    monkeypatch.setitem(truth.PROTOCOLS, "plates", lambda: (truth.VirtualTest("A", "A", truth.FAST, True, 3.0),))
    rows = {"testable": True, "sizes": {"> 10": [[2e-3, 30.0]]}, "correlated": {"> 10": [12.0]}, "twins": []}
    monkeypatch.setattr(run, "frozen", lambda: {"plates": {"sensor_drift/exact": rows}})
    return "plates"


@pytest.mark.slow
def test_one_hidden_effect_and_none_end_to_end(study, plates, tmp_path, capsys):
    """A drifting sensor and nothing, through files: found, or not; the lines are read and scored; peers tried."""
    run, main = study["run"], study["main"]
    results = run.Results(tmp_path, "a" * 64, sealed=False)
    planned = [run.Planned(plates, "hidden", ("sensor_drift/exact",), "> 10", 0, 1, False),
               run.Planned(plates, "none", (), "", 0, 1, False)]
    main.run_all(planned, results, "a" * 64, main.Workers(), quiet=True)
    assert capsys.readouterr().out == ""
    main.run_all(planned, results, "a" * 64, main.Workers(), quiet=False)  # all of it is there
    assert capsys.readouterr().out == ""
    hidden, empty = runs = results.read()
    assert study["scoring"].outcome(empty) == "none"
    assert study["scoring"].outcome(hidden) in ("right", "set")
    # What drifts went into the moduli of those who do not look for it.
    assert hidden["peers"]["least squares"]["R2"] > 0.999 and hidden["peers"]["Gaussian process"]["errors"][0] > 0
    found = study["tables"].figures(runs)[plates]
    assert found["runs"] == 2 and found["peers"]["BIC"]["false alarm"]["of"] == 1
