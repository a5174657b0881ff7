"""`tissue-sim simulate` with a protocol, a rig, noise and replicates."""

import json

import numpy as np
import pytest

import tissue_sim as ts
from scenes import draw_simulation
from scenes.cli import main
from scenes.commands.shared.console import TABLES
from scenes.commands.simulate import select_printed_sample_indices
from tissue_sim.errors import ConvergenceError
from tissue_sim.rig.file import write_rig
from tissue_sim.rig.rig import Rig

LUBRICATED = "lubricated_compression"


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    path = tmp_path_factory.mktemp("material") / "m.material.json"
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
    ts.write_material_file(ts.MaterialFile.of(material), path)
    return str(path)


@pytest.fixture
def simulate(material, capsys):
    """Run a scene and return its exit code, stdout and stderr."""
    def run(scene, *words):
        capsys.readouterr()
        code = main(["simulate", scene, "--material", material, *words])
        return code, *capsys.readouterr()
    return run


@pytest.fixture
def simulate_json(simulate):
    def run(scene, *words) -> dict:
        code, out, err = simulate(scene, *words, "--json")
        assert code == 0, err
        return json.loads(out)
    return run


class TestProtocol:
    def test_unloading_returns_the_loading_force(self, simulate_json):
        """Closed form of the lubricated cylinder: 3.31757 N at 5 mm in loading and unloading, without dissipation."""
        answer = simulate_json(LUBRICATED, "--protocol", "ramp 5mm @1mm/s; hold 2s; unload", "--points", "6")
        assert answer["displacement_mm"][:6] == pytest.approx(range(6))
        assert answer["time_s"][5] == pytest.approx(5) and answer["time_s"][-1] == pytest.approx(12)
        force = np.array(answer["force_N"])
        np.testing.assert_allclose(force[5:-5], 3.31757, rtol=3e-4)
        np.testing.assert_allclose(force[-6:], force[5::-1], atol=1e-6)

    def test_default_speed_is_that_of_the_flag(self, simulate_json):
        words = ["--points", "3", "--protocol", "ramp 1mm; unload @2mm/s"]
        assert simulate_json(LUBRICATED, *words, "--speed-mm-s", "0.5")["time_s"] == pytest.approx([0, 1, 2, 2.25, 2.5])

    def test_labels_reach_table_json_and_file(self, simulate, simulate_json, tmp_path):
        words = [LUBRICATED, "--protocol", "repeat 2 (ramp 1mm; unload)", "--points", "3"]
        _, out, _ = simulate(*words, "-o", str(tmp_path / "c.csv"))
        assert "segment" in out and "time [s]" in out and out.count("unload") == 4
        labels = ts.read_recording(tmp_path / "c.csv").labels
        assert labels["segment"].tolist() == ["ramp"] * 3 + ["unload"] * 2 + ["ramp"] * 2 + ["unload"] * 2
        assert labels["cycle"].tolist() == [1] * 5 + [2] * 4
        answer = simulate_json(*words)
        assert answer["segment"] == labels["segment"].tolist() and answer["cycle"] == labels["cycle"].tolist()

    def test_one_segment_needs_no_column(self, simulate):
        _, out, _ = simulate(LUBRICATED, "--protocol", "ramp 1mm", "--points", "2")
        assert "displacement [mm]" in out and "segment" not in out and "time [s]" not in out

    def test_figure_of_the_deepest_sample(self, simulate, tmp_path):
        """The last sample has no contact; the deepest has 3.31757 N at 5 mm in closed form."""
        code, _, err = simulate(LUBRICATED, "--protocol", "approach 1mm; ramp 5mm; unload; retract 1mm", "--points",
                                "6", "--figure", str(tmp_path / "f.svg"))
        assert code == 0, err
        assert "3.317 N at 5 mm" in (tmp_path / "f.svg").read_text(encoding="utf-8")

    def test_prescribed_force(self, simulate, simulate_json, tmp_path):
        """A lubricated cylinder with 3.31757 N at 5 mm in closed form; the figure shows displacement against time."""
        words = ["--protocol", "ramp 3.31757N @1N/s; hold 2s; unload 1mm @2mm/s", "--points", "6"]
        answer = simulate_json(LUBRICATED, *words)
        forces = np.array(answer["force_N"])
        np.testing.assert_allclose(forces[:6], np.linspace(0.0, 3.31757, 6), atol=1e-7)
        assert answer["displacement_mm"][5] == pytest.approx(5.0, rel=1e-3)
        assert answer["time_s"][-1] == pytest.approx(3.31757 + 2.0 + 0.5 * (answer["displacement_mm"][-6] - 1.0))
        code, out, err = simulate(LUBRICATED, *words, "--figure", str(tmp_path / "f.svg"), "-o",
                                  str(tmp_path / "c.csv"))
        assert code == 0 and "3.3176" in out, err
        figure = (tmp_path / "f.svg").read_text(encoding="utf-8")
        assert "<!-- time [s] -->" in figure and "<!-- displacement [mm] -->" in figure
        read = ts.read_recording(tmp_path / "c.csv")
        np.testing.assert_allclose(read.force, forces, atol=1e-6)

    def test_machine_controls_the_reading_of_its_sensor(self, simulate_json, tmp_path):
        """A sensor that reads 10 % too much: the specimen gets 1/1.1 of the prescribed force, and noise is added."""
        write_rig(Rig(sensor_gain=0.1), tmp_path / "r.rig.json")
        words = [LUBRICATED, "--protocol", "ramp 1.1N @1N/s", "--points", "3", "--rig", str(tmp_path / "r.rig.json")]
        plain = simulate_json(LUBRICATED, "--protocol", "ramp 1N @1N/s", "--points", "3")
        quiet, noisy = simulate_json(*words), simulate_json(*words, "--noise-N", "0.01", "--seed", "3")
        assert quiet["displacement_mm"] == pytest.approx(plain["displacement_mm"], rel=1e-6)
        assert quiet["force_N"] == pytest.approx([0.0, 0.55, 1.1], abs=1e-7)
        assert noisy["displacement_mm"] == quiet["displacement_mm"]
        assert 1e-3 < abs(noisy["force_N"][-1] - 1.1) < 0.05

    @pytest.mark.parametrize("command", ["loop", "view"])
    def test_commands_in_real_time_refuse_a_force(self, command, material, capsys):
        words = ["--headless", "--seconds", "1"] if command == "view" else []
        code = main([command, LUBRICATED, "--material", material, "--protocol", "ramp 1N @1N/s", *words])
        assert code == 2 and "--protocol: must prescribe displacements for this command; got a prescribed force" \
            in capsys.readouterr().err

    @pytest.mark.parametrize(("words", "expected"), [
        (["--protocol", "ramp 1N"], "the first ramp that prescribes a force needs a loading rate, such as ramp 2N @"),
        (["--protocol", "ramp 10mm; hld 60s"], "protocol: column 12, at 'hld 60s': unknown segment 'hld'; did you mean "
         "'hold'? For example 'ramp 10mm"),
        (["--protocol", "ramp 10mm", "--depth-mm", "5"], "--depth-mm: cannot be combined with --protocol"),
        (["--protocol", "ramp 70mm"], "deeper than the specimen is high"),
        (["--protocol", "hold 1s; ramp 200km"], "'km' is not a unit of length or force; use mm, um, m"),
    ])
    def test_faults(self, words, expected, simulate):
        code, out, err = simulate(LUBRICATED, *words)
        assert code == 2 and out == "" and expected in err and err.count("\n") == 1


def curve(samples: int, segments=None) -> ts.Recording:
    ramp = np.linspace(0.0, 0.01, samples)
    return ts.Recording({"time": ramp, "displacement": ramp, "force": ramp},
                        labels={} if segments is None else {"segment": segments})


class TestLongTables:
    def test_short_curves_are_printed_completely(self):
        assert select_printed_sample_indices(curve(TABLES.max_curve_rows)).tolist() \
            == list(range(TABLES.max_curve_rows))

    def test_ends_and_changes_of_segment_are_kept(self):
        rows = select_printed_sample_indices(curve(1000, ["ramp"] * 333 + ["hold"] * 300 + ["unload"] * 367))
        assert {0, 332, 632, 999} <= set(rows) and TABLES.max_curve_rows - 2 <= rows.size <= TABLES.max_curve_rows
        assert np.diff(rows).max() < 20

    @pytest.mark.parametrize("samples", [61, 1000])
    def test_many_segments_are_thinned_too(self, samples):
        rows = select_printed_sample_indices(curve(samples, ["ramp", "unload"] * (samples // 2) + ["ramp"]
                                                   * (samples % 2)))
        assert rows[0] == 0 and rows[-1] == samples - 1 and rows.size == TABLES.max_curve_rows

    def test_omitted_samples_are_reported(self, simulate):
        _, out, _ = simulate(LUBRICATED, "--depth-mm", "1", "--points", "100")
        assert "60 of 100 samples are shown; -o CURVE.csv writes all samples" in out


class TestRig:
    def test_rig_of_a_file(self, simulate_json, tmp_path):
        """Zero and gain of the sensor on the closed form, 1.24965 N at 2 mm."""
        write_rig(Rig(zero_offset=0.1, sensor_gain=0.02), tmp_path / "r.rig.json")
        answer = simulate_json(LUBRICATED, "--depth-mm", "2", "--points", "3", "--rig", str(tmp_path / "r.rig.json"))
        assert answer["force_N"] == pytest.approx([0.1, 1.02 * 0.6142 + 0.1, 1.02 * 1.24965 + 0.1], rel=1e-3)

    def test_compliance_is_part_of_the_simulation(self, simulate_json, tmp_path):
        """At 2 mm and 1.24965 N a load train of 0.2 mm/N has moved 2 + 0.2 * 1.24965 mm."""
        write_rig(Rig(compliance=0.2e-3), tmp_path / "r.rig.json")
        depth = repr(2 + 0.2 * 1.24965)
        answer = simulate_json(LUBRICATED, "--depth-mm", depth, "--points", "21", "--rig", str(tmp_path / "r.rig.json"))
        assert answer["force_N"][-1] == pytest.approx(1.24965, rel=1e-3)

    def test_figure_of_a_resampled_recording(self, simulate, tmp_path):
        write_rig(Rig(sampling_rate=3.0), tmp_path / "r.rig.json")
        code, out, _ = simulate(LUBRICATED, "--depth-mm", "2", "--points", "3", "--rig", str(tmp_path / "r.rig.json"),
                                "--figure", str(tmp_path / "f.png"), "-o", str(tmp_path / "c.csv"))
        # Three samples are simulated, and 8 s are read at 3 Hz.
        assert code == 0 and f"wrote {tmp_path / 'f.png'}" in out and (tmp_path / "f.png").exists()
        assert len(ts.read_recording(tmp_path / "c.csv")) == int(2 / 0.248 * 3) + 1

    def test_too_few_readings_for_a_file(self, simulate, tmp_path):
        write_rig(Rig(sampling_rate=0.3), tmp_path / "r.rig.json")
        code, _, err = simulate(LUBRICATED, "--depth-mm", "2", "--rig", str(tmp_path / "r.rig.json"),
                                "-o", str(tmp_path / "c.csv"))
        assert code == 2 and "--rig: a recording needs at least 5 samples; got 3" in err
        assert [path.name for path in tmp_path.iterdir()] == ["r.rig.json"]


class TestReplicates:
    WORDS = (LUBRICATED, "--depth-mm", "2", "--points", "50", "--noise-N", "0.02")

    def test_same_seed_same_files(self, simulate, tmp_path):
        files = [f"curve_{number}.csv" for number in (1, 2, 3)]
        for folder, seed in (("a", "7"), ("b", "7"), ("c", "8")):
            (tmp_path / folder).mkdir()
            code, out, _ = simulate(*self.WORDS, "--replicates", "3", "--seed", seed,
                                    "-o", str(tmp_path / folder / "curve.csv"))
            assert code == 0 and "replicate 1 of 3 is shown" in out
            assert {path.name for path in (tmp_path / folder).iterdir()} == {
                *files, *(file.replace("csv", "json") for file in files)}
        content = {(folder, file): (tmp_path / folder / file).read_bytes() for folder in "abc" for file in files}
        assert all(content["a", file] == content["b", file] for file in files)
        assert len(set(content.values())) == 6, "seeds and replicates have independent noise"
        recordings = [ts.read_recording(tmp_path / "a" / file) for file in files]
        assert [recording.metadata["replicate"] for recording in recordings] == [1, 2, 3]
        noise = np.array([recording.force for recording in recordings]) - np.mean(
            [recording.force for recording in recordings], axis=0)
        # 100 degrees of freedom are left: the estimate is within 25 % of the truth in 999 of 1000 cases.
        assert np.sqrt((noise**2).sum() / 100) == pytest.approx(0.02, rel=0.25)

    def test_first_replicates_do_not_depend_on_their_number(self, simulate_json):
        few, many = (simulate_json(*self.WORDS, "--replicates", number)["replicates"] for number in ("2", "4"))
        assert many[:2] == few and len(many) == 4
        assert set(few[0]) == {"displacement_mm", "force_N", "seed"}

    def test_json_of_one_recording_has_none(self, simulate_json):
        clean, noisy = simulate_json(*self.WORDS[:-2]), simulate_json(*self.WORDS)
        assert "replicates" not in noisy
        assert 0.01 < np.std(np.subtract(noisy["force_N"], clean["force_N"])) < 0.03

    @pytest.mark.parametrize(("words", "expected"), [
        (["--replicates", "3"], "--replicates: has an effect only with noise. Add --noise-N"),
        (["--seed", "3"], "--seed: has an effect only with noise"),
        (["--replicates", "3", "--noise-N", "0"], "--replicates: has an effect only with noise"),
    ])
    def test_noise_is_needed(self, words, expected, simulate):
        code, out, err = simulate(LUBRICATED, *words)
        assert code == 2 and out == "" and expected in err and err.count("\n") == 1

    def test_nothing_is_written_when_one_file_exists(self, simulate, tmp_path):
        (tmp_path / "curve_3.json").write_text("{}", encoding="utf-8")
        words = (*self.WORDS, "--replicates", "3", "-o", str(tmp_path / "curve.csv"))
        code, _, err = simulate(*words)
        assert code == 2 and "curve_3.json: -o: exists already" in err
        code, _, err = simulate(*words, "--overwrite")
        assert code == 2 and "curve_3.json: is not the sidecar of a recording" in err
        assert [path.name for path in tmp_path.iterdir()] == ["curve_3.json"]

    def test_partial_curves_are_kept(self, simulate, tmp_path, monkeypatch):
        def give_up(model, **options):
            raise ConvergenceError("no convergence beyond 1 mm", recording=curve(6), depth=1e-3)

        monkeypatch.setattr(ts, "simulate", give_up, raising=False)
        code, _, err = simulate(*self.WORDS, "--replicates", "2", "-o", str(tmp_path / "curve.csv"))
        one, two = tmp_path / "curve_1.csv", tmp_path / "curve_2.csv"
        assert code == 1 and err == (f"tissue-sim: no convergence beyond 1 mm; the curve up to this point is in {one} "
                                     f"and {two}\n")
        assert len(ts.read_recording(one)) == len(ts.read_recording(two)) == 6


@pytest.mark.slow
def test_friction_scene_is_close_to_bonded(simulate, simulate_json):
    """Independent curves at 5 mm: 4.103 N with friction 0.7, 4.1035 N bonded; `fast` within 1 %."""
    words = ["friction_compression", "--depth-mm", "5", "--points", "6"]
    answer = simulate_json(*words)
    assert answer["force_N"][-1] == pytest.approx(4.103, rel=0.01)
    assert answer["slipping_points"] >= 0 and "contact points slip at the same time" in simulate(*words)[1]


class TestFigures:
    """Selection of the sample that `draw_simulation` draws."""

    @pytest.fixture(scope="class")
    @staticmethod
    def relaxing():
        experiment = ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.parse("ramp 5mm @1mm/s; hold 9s; unload 2mm",
                                                                              points=6))
        series = ts.Prony((ts.PronyTerm(0.3, 2.0),))
        model = ts.Model(experiment, ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4},
                                                 ts.Bulk("bulk_ratio", 1e4), viscoelastic=series))
        return ts.simulate(model, fields=True), model

    @pytest.mark.slow
    @pytest.mark.parametrize(("segment", "depth"), [(None, 5), ("ramp", 5), ("hold", 5), ("unload", 2)])
    def test_segment(self, relaxing, segment, depth, tmp_path):
        recording, model = relaxing
        draw_simulation(recording, model, tmp_path / "f.svg", segment=segment)
        labels = recording.labels["segment"]
        force = recording.force[np.flatnonzero(labels == (segment or "ramp"))[-1]]
        assert f"{force:.4g} N at {depth} mm" in (tmp_path / "f.svg").read_text(encoding="utf-8")

    def test_no_such_segment(self, relaxing, tmp_path):
        with pytest.raises(ts.InputError, match="no segment 'reload'; known: hold, ramp, unload"):
            draw_simulation(*relaxing, tmp_path / "f.png", segment="reload")
        assert not list(tmp_path.iterdir())
