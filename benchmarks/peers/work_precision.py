"""Work-precision diagram: force error against CPU time per step, two elements, several meshes, two tests.

    python -m benchmarks work_precision [--json] [--figure FILE] [--repeats N]

Curves of 21 points to 10 mm: bonded compression and needle indentation of the study's cylinder, on one thread.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

import tissue_sim as ts
from benchmarks.measure import about, option_parser, show, spread, summary, table
from benchmarks.peers.compression import PARAMETERS
from tissue_sim.fem.axisymmetric.discretisation import build_mesh, build_solver_on_mesh
from tissue_sim.mesh import Mesh, cylinder_mesh, cylinder_mesh_refined_under_needle
from tissue_sim.mesh.elements import Q4P0, Q9P1

#: Radius of the specimen, m.
RADIUS = 0.040
#: Height of the specimen, m.
HEIGHT = 0.070
#: Radius of the needle, m.
NEEDLE_RADIUS = 0.008
MATERIAL = ts.Material("reduced_polynomial_2", PARAMETERS, ts.Bulk("bulk_ratio", 1e4))
#: Specimen of the reference study.
_SPECIMEN = ts.Specimen(RADIUS, HEIGHT)
#: Ramp to 10 mm in 20 steps.
_PROTOCOL = ts.Protocol.ramp(10e-3, 21)
MODELS = {"bonded compression": ts.Model(ts.Experiment(_SPECIMEN, _PROTOCOL), MATERIAL),
          "needle indentation": ts.Model(ts.Experiment(_SPECIMEN, _PROTOCOL, tool=ts.Tool("flat", NEEDLE_RADIUS)),
                                         MATERIAL)}
#: Samples of the curve at 2, 5 and 10 mm.
DEPTHS = {2.0: 4, 5.0: 10, 10.0: 20}
#: Forces at 2, 5 and 10 mm of an independent Taylor-Hood solver, N, and their own relative error.
REFERENCES = {"bonded compression": ((1.5417, 4.1035, 9.456), (1e-4, 5e-4, 2e-3)),
              "needle indentation": ((0.3601, 0.9363, 2.078), (3e-4, 6e-4, 1e-3))}
#: Family -> (colour that the colour-blind can tell, marker, line).
STYLES = {"Q9/P-1, strongly graded": ("#0072B2", "o", "-"), "Q9/P-1, graded": ("#56B4E9", "s", "-"),
          "Q9/P-1, uniform": ("#009E73", "^", "-"), "Q4/P0, graded": ("#D55E00", "D", "--"),
          "Q4/P0, uniform": ("#000000", "v", "--")}


def uniform_needle_mesh(elements: tuple[int, int], element) -> Mesh:
    """Return a mesh of equal elements along r and along z, with an element boundary at the edge of the needle."""
    mesh = cylinder_mesh(RADIUS, HEIGHT, elements, element)
    top = mesh.sets["top"]
    distance = mesh.nodes[top, 0] - NEEDLE_RADIUS
    return replace(mesh, sets={**mesh.sets, "face": top[distance <= 1e-9], "free": top[distance >= -1e-9]})


def bonded_meshes() -> Iterator[tuple[str, Mesh]]:
    """Yield (family, mesh), each family from coarse to fine."""
    nine, four = ((3, 4), (4, 5), (6, 8), (8, 10), (11, 14), (16, 20)), ((6, 8), (11, 14), (20, 25), (40, 50), (60, 75))
    for name, element, grading, counts in (
            ("Q9/P-1, strongly graded", Q9P1, (50.0, 10.0), nine), ("Q9/P-1, graded", Q9P1, (10.0, 4.0), nine),
            ("Q9/P-1, uniform", Q9P1, (1.0, 1.0), nine), ("Q4/P0, graded", Q4P0, (50.0, 10.0), four),
            ("Q4/P0, uniform", Q4P0, (1.0, 1.0), four)):
        for count in counts:
            yield name, cylinder_mesh(RADIUS, HEIGHT, count, element, grading=grading)


def needle_meshes() -> Iterator[tuple[str, Mesh]]:
    """Yield (family, mesh), each family from coarse to fine."""
    for name, element, growth, largest, sizes in (
            ("Q9/P-1, strongly graded", Q9P1, 1.8, 15.0, (4.0, 2.6, 1.3, 0.65, 0.3, 0.1, 0.03)),
            ("Q9/P-1, graded", Q9P1, 1.5, 12.0, (2.0, 0.65, 0.2, 0.05, 0.02)),
            ("Q4/P0, graded", Q4P0, 1.2, 3.0, (4.0, 1.3, 0.4, 0.1))):
        for smallest in sizes:
            yield name, cylinder_mesh_refined_under_needle(RADIUS, HEIGHT, NEEDLE_RADIUS, element, growth=growth,
                                                           smallest=smallest * 1e-3,
                                                           largest=largest * 1e-3)
    for name, element, counts in (("Q9/P-1, uniform", Q9P1, ((5, 7), (10, 13), (15, 18), (20, 25))),
                                  ("Q4/P0, uniform", Q4P0, ((10, 13), (20, 25), (40, 50), (60, 75)))):
        for count in counts:
            yield name, uniform_needle_mesh(count, element)


def measure(test: str, family: str, mesh: Mesh, repeats: int, named: str | None = None) -> dict:
    """Return one point of the diagram; its status tells if the simulation did not reach 10 mm."""
    model = MODELS[test]
    forces, error = (np.array(values) for values in REFERENCES[test])
    point = {"test": test, "family": family, "element": mesh.element.name, "elements": len(mesh.connectivity),
             "freedoms": (equations := build_solver_on_mesh(model, mesh).equations).free,
             "half_band": equations.half_band, "named": named}
    spent = []
    try:
        for _ in range(1 + repeats):
            marks = []
            recording = ts.simulate(model, mesh=mesh,
                                    progress=lambda *_, marks=marks: marks.append(time.process_time()))
            # From the sample at rest to the last: without set-up and, in the first curve, compiling.
            spent.append((marks[-1] - marks[1]) / (len(marks) - 2))
    except ts.ConvergenceError as failure:
        return {**point, "status": str(failure)}
    relative = recording.force[list(DEPTHS.values())] / forces - 1
    solved = recording.metadata["solver"]
    return {**point, "status": "converged", "step": summary(spent[1:]), "error_percent": list(100 * relative),
            "largest_error_percent": float(100 * abs(relative).max()),
            "within_reference": [bool(inside) for inside in abs(relative) <= error],
            "iterations": solved["newton_iterations"], "cuts": solved["cuts"]}


def points(repeats: int) -> Iterator[dict]:
    """Return every point of the diagram; named meshes carry their name."""
    for test, meshes in (("bonded compression", bonded_meshes()), ("needle indentation", needle_meshes())):
        named = {name: build_mesh(MODELS[test].experiment, name) for name in ("fast", "accurate")}
        for family, mesh in meshes:
            name = next((name for name, known in named.items() if known.element is mesh.element
                         and known.nodes.shape == mesh.nodes.shape and np.allclose(known.nodes, mesh.nodes)), None)
            named.pop(name, None)
            yield measure(test, family, mesh, repeats, name)
        for name, mesh in named.items():
            yield measure(test, "of no family", mesh, repeats, name)


def known_points(found: list[dict], repeats: int) -> list[dict]:
    """Return needle meshes with the numbers of elements of an earlier table, and their known errors, %."""
    mesh_of_42, mesh_of_120 = (cylinder_mesh_refined_under_needle(RADIUS, HEIGHT, NEEDLE_RADIUS, Q9P1, growth=1.8,
                                                                  smallest=smallest,
                                                                  largest=0.012) for smallest in (4.0e-3, 0.65e-3))
    measured = [(0.91, measure("needle indentation", "graded", mesh_of_42, repeats)),
                (0.27, measure("needle indentation", "graded", mesh_of_120, repeats))]
    needles = [point for point in found if point["test"] == "needle indentation"]
    measured += [(0.7, next(point for point in needles if point["named"] == "fast")),
                 (4.0, next(point for point in needles if point["elements"] == 500 and point["element"] == Q4P0.name))]
    return [{"known_percent": known, **point} for known, point in measured]


def plot(found: list[dict], path: Path) -> None:
    """Draw the diagram; a hollow marker means an error below that of the reference at its depth."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 2, figsize=(11.0, 5.2), sharey=True, layout="constrained")
    for panel, (test, (_, own)) in zip(panels, REFERENCES.items(), strict=True):
        done = [point for point in found if point["test"] == test and point["status"] == "converged"]
        for family, (colour, marker, line) in STYLES.items():
            chosen = [point for point in done if point["family"] == family]
            x, y = ([1e3 * point["step"]["median_s"] for point in chosen],
                    [point["largest_error_percent"] for point in chosen])
            panel.plot(x, y, line, color=colour, lw=1.2, marker=marker, ms=6, label=family)
            inside = [point["within_reference"][np.argmax(np.abs(point["error_percent"]))] for point in chosen]
            panel.plot(np.array(x)[inside], np.array(y)[inside], marker, color=colour, mfc="white", ms=6)
        for point in (point for point in done if point["named"]):
            at = 1e3 * point["step"]["median_s"], point["largest_error_percent"]
            panel.plot(*at, "*", color="#CC79A7", mec="black", ms=17, zorder=5)
            panel.annotate(point["named"], at, xytext=(-9, -16), textcoords="offset points", ha="right", weight="bold")
        panel.axhspan(1e-3, 100 * max(own), color="0.88", zorder=0)
        panel.text(0.02, 0.02, f"below the reference's own error at 10 mm ({100 * max(own):g} %)",
                   transform=panel.transAxes, color="0.3", fontsize=9)
        panel.set(title=test, xscale="log", yscale="log", xlabel="CPU time per converged step [ms]",
                  xlim=(0.03, 100), ylim=(0.02, 20))
        panel.grid(which="major", color="0.8", lw=0.5)
        panel.xaxis.set_major_formatter("{x:g}")
        panel.yaxis.set_major_formatter("{x:g}")
    panels[0].set_ylabel("largest force error at 2, 5 and 10 mm [%]")
    panels[0].legend(fontsize=9, title="hollow: below the reference's own error", title_fontsize=9)
    figure.savefig(path, dpi=130)


def draw(result: dict, console: Console) -> None:
    """Print the result as tables."""
    def errors(title, points, first, leading):
        rows = []
        for point in points:
            row = [leading(point), *(str(point[name]) for name in ("elements", "freedoms", "half_band"))]
            if point["status"] != "converged":
                rows.append([*row, point["status"]])
                continue
            rows.append([*row, spread(point["step"]),
                         *(f"({error:+.3f})" if inside else f"{error:+.3f}" for error, inside
                           in zip(point["error_percent"], point["within_reference"], strict=True))])
        table(console, title, [first, "elements", "freedoms", "half band", "CPU ms a step (range)", "2 mm %", "5 mm %",
                               "10 mm %"], rows)

    for test in REFERENCES:
        errors(f"{test}: force error, in brackets where the reference's own is larger",
               [point for point in result["points"] if point["test"] == test], "mesh",
               lambda point: point["family"] + (f": {point['named']}" if point["named"] else ""))
    errors("needle indentation: meshes of as many elements as points known before", result["known"], "known error",
           lambda point: f"{point['known_percent']:g} %, {point['element']}")


def main() -> None:
    parser = option_parser(__doc__)
    parser.add_argument("--figure", type=Path, help="draw the diagram into this file")
    arguments = parser.parse_args()
    found = list(points(arguments.repeats))
    result = about("work_precision") | {
        "references": {test: {"force_N": forces, "relative_error": error}
                       for test, (forces, error) in REFERENCES.items()},
        "points": found, "known": known_points(found, arguments.repeats)}
    if arguments.figure:
        plot(found, arguments.figure)
    show(result, draw, as_json=arguments.json)


if __name__ == "__main__":
    main()
