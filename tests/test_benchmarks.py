"""The runner of the benchmarks, and the tables that it writes into pages."""

import json
import subprocess
import sys

import pytest

from benchmarks.__main__ import modules, title


def run(root, *arguments):
    return subprocess.run([sys.executable, *arguments], cwd=root, capture_output=True, text=True, encoding="utf-8")


def test_each_benchmark_has_a_title():
    assert {"realtime", "needle", "raw_files", "motions", "report"} <= set(modules())
    assert all(title(module) for module in modules().values())


def test_an_unknown_name_is_refused_with_the_names(root):
    done = run(root, "-m", "benchmarks", "neddle")
    assert done.returncode == 2
    assert "got neddle" in done.stderr and "needle" in done.stderr


@pytest.mark.slow
def test_the_former_file_of_the_realtime_benchmark_runs(root):
    done = run(root, "benchmarks/realtime.py", "--help")
    assert done.returncode == 0 and "--quick" in done.stdout


@pytest.fixture
def page(tmp_path):
    """A page that names two benchmarks; the second one fails."""
    path = tmp_path / "page.md"
    path.write_text("# Title\n\n<!-- benchmark: needle --repeats 1 -->\nold table\n<!-- end of benchmark -->\n\n"
                    "Text.\n\n<!-- benchmark: needle --repeats 0 -->\nkept\n<!-- end of benchmark -->\n",
                    encoding="utf-8")
    return path


@pytest.mark.slow
def test_report_replaces_the_tables_of_a_page_and_keeps_those_that_failed(root, page):
    done = run(root, "-m", "benchmarks", "report", "--docs", str(page.parent))
    text = page.read_text(encoding="utf-8")
    assert done.returncode == 1 and "--repeats 0 failed" in done.stderr
    assert "old table" not in text and "\nkept\n" in text and "\nText.\n" in text
    assert "| mesh | FElupe | ours |" in text and "commit" in text


def test_report_refuses_a_benchmark_that_no_page_names(root, page):
    done = run(root, "-m", "benchmarks", "report", "coverage", "--docs", str(page.parent))
    assert done.returncode == 2 and "got coverage" in done.stderr


@pytest.mark.slow
def test_json_is_one_object(root):
    done = run(root, "-m", "benchmarks", "long_files", "--rows", "1000", "--json")
    assert json.loads(done.stdout)["benchmark"] == "long_files"
