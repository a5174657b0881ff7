"""CPU time of a frame of a 3D solid with ten thousand nodes on its surface.

    python -m benchmarks viewer_solid [--json] [--repeats 60]

A block, dented elsewhere in every frame and cut open by 120 degrees at a tool that leans and moves, is shown 20 times a
second on a page that a client in another process reads: von Mises stress in bands. There is no solver. In addition,
what it costs the loop to publish such a state, and the viewer to read it.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console

import tissue_sim as ts
from benchmarks.measure import about, option_parser, show, table
from benchmarks.viewer.processes import reading
from haptics.loop.shared_slots import SnapshotReader, SnapshotWriter
from scenes.viewer.frame import Phase, PlotCurves, SessionFrame
from scenes.viewer.page import Page
from scenes.viewer.scene import Scene
from scenes.viewer.solid_body import ThreeDimensionalMeshBody
from tissue_sim.experiment.kinds.standard_tests import NEEDLE
from tissue_sim.fem.solid.batches import ElementBatches
from tissue_sim.fem.solid.fields import SolidFields
from tissue_sim.mesh.solid import create_block_mesh_from_boundaries
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1, Hexahedron
from tissue_sim.pose import Pose
from tissue_sim.snapshot import Snapshot

#: Edge of the block, m.
EDGE = 0.07
#: Elements along an edge, for ten thousand nodes on the surface.
CELLS = {HEX8P0: 41, HEX27P1: 20}
#: Frames per second.
RATE = 20.0
MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
LEAN = 0.2


class NoSession:
    """Session without clients; a request is an error."""

    def post(self, command: str, *, reply: Callable | None = None, **values: object) -> None:
        raise AssertionError(command)


def block(element: Hexahedron) -> SolidFields:
    """Return the fields of a block at rest."""
    line = np.linspace(-0.5 * EDGE, 0.5 * EDGE, CELLS[element] + 1)
    mesh = create_block_mesh_from_boundaries(line, line, line - 0.5 * EDGE, element)
    batches, count = ElementBatches(mesh), len(mesh.connectivity)
    return SolidFields(mesh, MATERIAL, 3e7, np.zeros((1, len(mesh.nodes), 3)),
                       np.zeros((1, count, element.pressure_modes)), *batches.point_gradients_and_modes,
                       batches.weights, np.ones(count))


def state(fields: SolidFields, number: int) -> Snapshot:
    """Return the state of the block in a frame, with a dent under the tool."""
    x, y = 0.012 * np.cos(0.3 * number), 0.012 * np.sin(0.3 * number)
    away = np.exp(-((fields.mesh.nodes - [x, y, 0.0]) ** 2).sum(axis=1) / (2 * 0.01**2))
    displacement = -0.004 * away[:, None] * [0.2, 0.1, 1.0]
    pose = Pose((x, y, -0.004), (np.cos(0.5 * LEAN), 0.0, -np.sin(0.5 * LEAN), 0.0))
    return Snapshot(pose, 0.0, fields.with_arrays((displacement[None], fields.pressures)))


def measure(element: Hexahedron, frames: int) -> dict:
    """Return median CPU times of the frames of one block, ms."""
    fields = block(element)
    tool = ts.Tool("round", radius=8e-3)
    experiment = NEEDLE.experiment(specimen=ts.Specimen(0.5 * EDGE, EDGE), protocol=ts.Protocol.ramp(8e-3), tool=tool,
                                   friction=0.3)
    scene = Scene(NEEDLE, experiment, MATERIAL, solver="solid")
    first = SessionFrame(Phase.RUNNING, "running", scene, state(fields, 0), None, PlotCurves(), "hand", 0.0)
    with tempfile.TemporaryDirectory() as folder:
        page = Page(NoSession(), first, Path(folder), port=0)
        try:
            with reading(page.server.get_port()) as messages:
                while not page.server.get_clients():
                    time.sleep(0.01)
                page.show(first)
                spent, due = [], time.monotonic()
                states = [state(fields, number) for number in range(1, frames + 1)]
                for snapshot in states:
                    began = time.process_time()
                    page.show(SessionFrame(Phase.RUNNING, "running", scene, snapshot, None, PlotCurves(), "hand", 0.0))
                    due += 1.0 / RATE
                    time.sleep(max(0.0, due - time.monotonic()))  # meanwhile threads send
                    spent.append(time.process_time() - began)
                received = sum(message[2] for message in messages())
        finally:
            page.close()
        board_path = Path(folder) / "board"
        board = SnapshotWriter(board_path, states[0])
        publishing, taking = [], []
        with board, SnapshotReader(board_path, states[0]) as reader:
            for snapshot in states[:20]:
                began = time.process_time()
                board.publish(0.0, snapshot)
                publishing.append(time.process_time() - began)
                began = time.process_time()
                reader.latest()
                taking.append(time.process_time() - began)
    surface = np.unique(ThreeDimensionalMeshBody.from_geometry(fields.geometry()).nodes).size
    return {"element": element.name, "elements": len(fields.mesh.connectivity), "surface_nodes": int(surface),
            "frames": frames, "frame_ms": 1e3 * statistics.median(spent), "frame_max_ms": 1e3 * max(spent),
            "kB_a_frame": received / 1e3 / frames, "publish_ms": 1e3 * statistics.median(publishing),
            "read_ms": 1e3 * statistics.median(taking)}


def draw(result: dict, console: Console) -> None:
    """Print the table."""
    rows = [(row["element"], f"{row['elements']}", f"{row['surface_nodes']}", f"{row['frame_ms']:.1f}",
             f"{row['frame_max_ms']:.1f}", f"{row['kB_a_frame']:.0f}", f"{row['publish_ms']:.1f}",
             f"{row['read_ms']:.1f}") for row in result["cases"]]
    table(console, f"CPU ms of a frame of a solid; at {RATE:g} Hz there are {1e3 / RATE:g}",
          ("element", "elements", "surface nodes", "median", "at most", "kB sent", "publish", "read"), rows)


def main() -> None:
    options = option_parser(__doc__)
    options.set_defaults(repeats=60)
    asked = options.parse_args()
    cases = [measure(element, asked.repeats) for element in CELLS]
    show({**about("viewer_solid", ("viser",)), "cases": cases}, draw, as_json=asked.json)


if __name__ == "__main__":
    main()
