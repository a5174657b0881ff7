"""`tissue-sim record`: recordings on the virtual rig, their calibration, interruptions and errors."""

import json
import signal
import subprocess
import sys

import pytest
from child_environment import child_environment
from waiting import wait_until

import tissue_sim as ts
from calibration.campaign.campaign import load_campaign
from calibration.campaign.schema import replace_mesh_profile_and_rig_paths
from haptics.recorder.run_folder import RunFolder
from scenes.cli import main
from scenes.commands.record.protocol_file import read_protocol_file
from tissue_sim import read_recording

PROTOCOL = """
[[specimen]]
name = "phantom"
radius_mm = 40.0
height_mm = 70.0

[[test]]
name = "plates"
kind = "lubricated_compression"
protocol = "ramp 4mm @8mm/s; unload"

[fit]
method = "analytical"
laws = ["neo_hooke"]

[noise]
force_N = "estimate"
contact_jitter_mm = 0.03

[limits]
force_N = 20.0
lowest_mm = -6.0
highest_mm = 12.0
speed_mm_s = 10.0
duration_s = 600.0
stiffness_N_per_mm = 2.0
force_margin_N = 1e3
sensor_silence_s = 30.0   # a test machine may be busy with other work

[record]
replicates = 2
contact_force_N = 0.1
approach_speed_mm_s = 8.0
lubricant = "silicone oil"
temperature_degC = 21.5
"""
PATIENCE = 120.0


@pytest.fixture
def protocol(tmp_path):
    def protocol(**changes):
        text = PROTOCOL
        for old, new in changes.pop("replace", {}).items():
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "protocol.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return protocol


def started(*words, **options):
    """Start the command in a separate process."""
    return subprocess.Popen([sys.executable, "-c", "import sys; from scenes.cli import main; sys.exit(main())", *words],
                            env=child_environment(), text=True,
                            stdin=subprocess.DEVNULL, **options)


def test_a_dry_run_prints_the_plan(protocol, capsys):
    assert main(["record", str(protocol()), "--dry-run"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "ramp to 4 mm at 8 mm/s, unload to 0 mm at 8 mm/s" in said
    assert "The run stops at a force above 20 N, a position outside -6 to 12 mm" in said
    assert "The encoder detects a stalled motor" in said
    assert main(["record", str(protocol()), "--dry-run", "--json"]) == 0
    planned = json.loads(capsys.readouterr().out)
    assert planned["state"] == "planned" and planned["tests"][0]["replicates"] == 2


@pytest.mark.slow
def test_recordings_can_be_calibrated(protocol, tmp_path, capsys):
    run = tmp_path / "run"
    assert main(["record", str(protocol()), "-o", str(run), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["state"] == "complete" and answer["recordings"] == ["plates_1.csv", "plates_2.csv"]
    metadata = read_recording(run / "plates_1.csv").metadata
    assert (metadata["lubricant"], metadata["temperature_degC"]) == ("silicone oil", 21.5)
    assert metadata["specimen"] == {"name": "phantom", "shape": "cylinder", "radius_mm": 40.0, "height_mm": 70.0}
    assert main(["calibrate", str(run / "campaign.toml"), "-o", str(tmp_path / "out"), "--json"]) == 0
    fit, = json.loads(capsys.readouterr().out)["fits"]
    # Silicone of the reference study; the neo-Hookean C10 absorbs a part of its C20.
    assert fit["parameters"]["C10"] == pytest.approx(1405.0, rel=0.03) and fit["R2"] > 0.999


@pytest.mark.slow
def test_the_folder_of_a_run_contains_all_files_of_its_campaign(protocol, tmp_path):
    """The campaign can be read after the folder was moved and the original rig file was deleted."""
    frame, run = tmp_path / "frame.rig.json", tmp_path / "deep" / "run"
    ts.write_rig(ts.Rig(zero_offset=0.25), frame)
    path = protocol(replace={"[fit]": '[defaults]\nrig = "frame.rig.json"\n\n[fit]', '"analytical"': '"inverse_fem"',
                             "replicates = 2": "replicates = 1"})
    assert main(["record", str(path), "-o", str(run)]) == 0
    frame.unlink()
    moved = run.rename(tmp_path / "elsewhere")
    test, = load_campaign(moved / "campaign.toml").tests
    assert test.rig == ts.Rig(zero_offset=0.25)


def test_a_prescribed_force_requires_limits_and_one_control(protocol, capsys):
    """Without [force_control], and with a change of control, a protocol is refused; otherwise the plan is printed."""
    force, table = {"ramp 4mm @8mm/s; unload": "ramp 1N @1N/s; hold 5s"}, "[force_control]\n"
    assert main(["record", str(protocol(replace=force)), "--dry-run"]) == 2
    assert "Give depth_mm, speed_mm_s and force_error_N, or prescribe displacements" in capsys.readouterr().err
    table += "depth_mm = 6.0\nspeed_mm_s = 1.0\nforce_error_N = 0.3\n\n[record]"
    mixed = {"ramp 4mm @8mm/s; unload": "ramp 1N @1N/s; ramp 2mm", "[record]": table}
    assert main(["record", str(protocol(replace=mixed)), "--dry-run"]) == 2
    assert "segments must prescribe either displacements or forces here" in capsys.readouterr().err
    path = protocol(replace=force | {"[record]": table})
    assert main(["record", str(path), "--dry-run"]) == 0
    assert "ramp to 1 N at 1 N/s, hold 5 s" in " ".join(capsys.readouterr().out.split())
    assert 'control = "force"' in read_protocol_file(path).make_campaign_text({"plates": ["a.csv"]}, str)


def test_real_devices_refuse_a_prescribed_force(protocol, capsys):
    path = protocol(replace={"ramp 4mm @8mm/s; unload": "ramp 1N @1N/s", "[record]": (
        '[devices]\nsensor = "rdt://192.168.1.1"\nstage = "tic:/dev/ttyUSB0,steps_per_mm=800"\n\n'
        "[force_control]\ndepth_mm = 6.0\nspeed_mm_s = 1.0\nforce_error_N = 0.3\n\n[record]")})
    assert main(["record", str(path), "--dry-run"]) == 2
    assert "must prescribe displacements for a TicStage; got a prescribed force" in capsys.readouterr().err


def test_recordings_of_a_prism_state_its_known_sizes(protocol):
    path = protocol(replace={"radius_mm = 40.0": 'shape = "prism"\narea_mm2 = 400.0'})
    said = read_protocol_file(path).plans["plates"].about["specimen"]
    assert said == {"name": "phantom", "shape": "prism", "area_mm2": pytest.approx(400.0), "height_mm": 70.0}


def test_recordings_state_the_tool_of_the_defaults(protocol):
    path = protocol(replace={'kind = "lubricated_compression"': 'kind = "needle_indentation"',
                             "[fit]": '[defaults]\ntool = "flat"\ntool_radius_mm = 8.0\nfriction = "bonded"\n\n[fit]',
                             '"analytical"': '"inverse_fem"'})
    said = read_protocol_file(path).plans["plates"].about
    assert (said["tool"], said["tool_radius_mm"], said["friction"]) == ("flat", 8.0, "bonded")


def test_files_of_equal_names_are_kept_apart(tmp_path):
    for place in ("a", "b"):
        (tmp_path / place).mkdir()
        (tmp_path / place / "tip.csv").write_text(place, encoding="utf-8")
    content = {"defaults": {"tool": "a/tip.csv"}, "test": [{"tool": "b/tip.csv"}, {"tool": "flat"}, {}]}
    (tmp_path / "flat").write_text("no profile", encoding="utf-8")
    with RunFolder(tmp_path / "run", "digest") as folder:
        copied = replace_mesh_profile_and_rig_paths(content, tmp_path, folder.copy_input_file_once)
    assert copied["defaults"]["tool"] == "files/tip.csv" and copied["test"][1:] == [{"tool": "flat"}, {}]
    assert (folder.folder / copied["defaults"]["tool"]).read_text() == "a"
    assert (folder.folder / copied["test"][0]["tool"]).read_text() == "b"
    assert not RunFolder(tmp_path / "run", "digest").has_started_run


@pytest.mark.slow
def test_exceeded_force_limit_stops_the_run_with_its_reason(protocol, tmp_path, capsys):
    run = tmp_path / "run"
    limits = {"force_N = 20.0": "force_N = 1.0"}
    assert main(["record", str(protocol(replace=limits)), "-o", str(run)]) == 1
    said = capsys.readouterr()
    assert "above the limit of 1 N" in said.err and "stopped (force) in plates, ramp" in said.out
    assert main(["record", str(tmp_path / "protocol.toml"), "-o", str(run)]) == 2
    assert "Resume the run with --resume" in capsys.readouterr().err
    # A changed protocol belongs to another run.
    assert main(["record", str(protocol()), "-o", str(run), "--resume"]) == 2
    assert "choose another folder" in capsys.readouterr().err


def wait_for_lines(path, count, program):
    """Wait until a file has a number of lines; fail if the program that writes it ends before."""
    def is_there():
        assert program.poll() is None, f"the program ended with {program.returncode}"
        return path.exists() and path.read_text(encoding="utf-8").count("\n") >= count

    wait_until(is_there, f"{count} lines", PATIENCE)


@pytest.mark.slow
def test_a_killed_run_leaves_readable_files(protocol, tmp_path):
    slow = protocol(replace={"ramp 4mm @8mm/s; unload": "ramp 3mm @8mm/s; hold 100s; unload"})
    run = tmp_path / "run"
    program = started("record", str(slow), "-o", str(run), "--json", stdout=subprocess.DEVNULL)
    partial = run / "plates_1.partial.csv"
    try:
        wait_for_lines(partial, 300, program)
    finally:
        program.kill()
        program.wait()
    recording = read_recording(partial)
    assert len(recording) >= 250 and recording.displacement.max() == pytest.approx(3e-3, abs=1e-4)
    assert json.loads((run / "run.json").read_text(encoding="utf-8"))["state"] == "running"
    assert not (run / "campaign.toml").exists()


@pytest.mark.slow
def test_ctrl_c_stops_the_stage_and_keeps_the_readings(protocol, tmp_path):
    slow = protocol(replace={"ramp 4mm @8mm/s; unload": "ramp 3mm @8mm/s; hold 100s; unload"})
    run = tmp_path / "run"
    program = started("record", str(slow), "-o", str(run), "--json", stdout=subprocess.PIPE)
    partial = run / "plates_1.partial.csv"
    wait_for_lines(partial, 100, program)
    program.send_signal(signal.SIGTERM)
    out, _ = program.communicate(timeout=PATIENCE)
    answer = json.loads(out)
    assert program.returncode == 1 and answer["state"] == "stopped" and "by a signal" in answer["message"]
    assert answer["stops"][0]["cause"] == "asked" and len(read_recording(partial)) > 50


@pytest.mark.parametrize(("change", "said"), [
    ({"[limits]": "[limitz]"}, "limits: is required, because a motor moves"),
    ({"force_N = 20.0": "force_N = 0.0"}, "limits.force: a limit of a run must be positive and finite; got 0"),
    ({"lubricant = ": "lubrication = "}, "unknown key"),
    ({"force_margin_N = 1e3": "force_margin_N = 0.1"}, "Use a speed of at most"),
    ({'protocol = "ramp 4mm @8mm/s; unload"': ""}, "protocol: is required. Give a motion"),
    ({'protocol = "ramp 4mm @8mm/s; unload"': 'recordings = ["a.csv"]'}, "recordings: must not be given"),
    ({"[limits]": '[devices]\nstage = "tic:/dev/null"\n[limits]'}, "Make both virtual, or give the sensor"),
    ({"[limits]": '[devices]\nstage = "tic:/dev/null"\nsensor = "rdt://127.0.0.1"\n[limits]'}, "--arm: is required"),
    ({"[limits]": '[virtual]\nfaults = "los=1"\n[limits]'}, "did you mean 'loss'"),
])
def test_invalid_protocols_get_one_sentence(protocol, tmp_path, capsys, change, said):
    assert main(["record", str(protocol(replace=change)), "-o", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert not (tmp_path / "run" / "run.json").exists()


@pytest.mark.parametrize(("change", "said"), [
    ({"[fit]": '[defaults]\nrig = "frame.rig.json"\n\n[fit]'}, "defaults.rig: the analytical method does not use rig"),
    ({"contact_jitter_mm = 0.03": 'contact_jitter_mm = "estimate"'},
     'noise.contact_jitter_mm: "estimate" requires fit.method'),
    ({'["neo_hooke"]': '["neo_hook"]'}, "fit.laws[0]: unknown law 'neo_hook'"),
])
def test_protocols_that_calibrate_would_refuse_are_not_recorded(protocol, tmp_path, capsys, change, said):
    """The error comes before a folder is created or a motor moves."""
    ts.write_rig(ts.Rig(zero_offset=0.25), tmp_path / "frame.rig.json")
    path = protocol(replace=change)
    for words in (["--dry-run"], ["-o", str(tmp_path / "run")]):
        assert main(["record", str(path), *words]) == 2
        error = capsys.readouterr().err
        assert said in error and "calibrate would not accept the recordings" in error and error.count("\n") == 1
        assert error.startswith(f"tissue-sim: {path}: ")
    assert not (tmp_path / "run").exists()


def test_an_unknown_test_names_the_nearest(protocol, tmp_path, capsys):
    assert main(["record", str(protocol()), "-o", str(tmp_path / "run"), "--test", "plate"]) == 2
    assert "did you mean 'plates'" in capsys.readouterr().err
