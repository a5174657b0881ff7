"""Runner of tests with bonded tools in FElupe: the exported material on the elements of the mesh.

Source of names: FElupe 11.3, https://felupe.readthedocs.io.
"""

from __future__ import annotations

import importlib.util
import time
from typing import Any, NamedTuple

import numpy as np

from calibration.targets.runner import Progress, TargetCurve, TargetRunner, TargetTest
from tissue_sim.errors import InputError
from tissue_sim.exports import ExportContent, find_export_target
from tissue_sim.exports.elastic_constants import ElasticConstants
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh


class FelupeElement(NamedTuple):
    """Element of FElupe for an element of a mesh.

    Attributes:
        region: name of the class of the region.
        cell: name of the type of cells.
        nodes: indices of its nodes among those of the element of the mesh, in the order of FElupe.
        is_mixed: whether pressure and volume ratio are fields; otherwise they are constant and condensed.
    """

    region: str
    cell: str
    nodes: tuple[int, ...]
    is_mixed: bool


#: Element of a mesh -> element of FElupe.
ELEMENTS = {
    "H8/P0": FelupeElement("RegionHexahedron", "hexahedron", (0, 1, 3, 2, 4, 5, 7, 6), False),
    "H27/P-1": FelupeElement("RegionTriQuadraticHexahedron", "hexahedron27", (
        0, 2, 8, 6, 18, 20, 26, 24, 1, 5, 7, 3, 19, 23, 25, 21, 9, 11, 17, 15, 12, 14, 10, 16, 4, 22, 13), True),
    "T8/P0": FelupeElement("RegionTetra", "tetra", (0, 1, 2, 3), False),
    "T15/P-1": FelupeElement("RegionQuadraticTetra", "tetra10", tuple(range(10)), True),
}
#: Largest number of bisections of the motion between two positions.
_MAX_HALVINGS = 5
#: Largest relative residual of Newton's method, 1.
_TOLERANCE = 1e-8
#: Largest number of iterations of Newton's method.
_MAX_ITERATIONS = 12
#: Remedy of a missing program.
_MISSING = "FElupe or tensortrax is not installed. Run: pip install felupe tensortrax"


class FelupeRunner(TargetRunner):
    """FElupe with a bonded tool, static.

    Elements are those of `ELEMENTS` at the nodes of the mesh. The material is the exported module. The force on the
    tool is the reaction of the node set ``face``. A motion that does not converge is bisected.
    """

    title = "FElupe, static"
    uses_elastic_constants = False
    is_static = True

    def describe_missing_program(self) -> str:
        """Return why FElupe cannot run, with the remedy; an empty text if it can."""
        return "" if all(importlib.util.find_spec(name) for name in ("felupe", "tensortrax")) else _MISSING

    def run(self, test: TargetTest, material: Material | ElasticConstants, progress: Progress | None = None
            ) -> TargetCurve:
        """Simulate a test; see `TargetRunner.run`. A position may take `TargetTest.max_seconds`."""
        if missing := self.describe_missing_program():
            raise InputError(missing)
        if isinstance(material, ElasticConstants):
            raise InputError("must be a Material; got ElasticConstants. FElupe has the calibrated law.",
                             field="material")
        if not test.is_bonded:
            raise InputError("must be True: FElupe has no contact with the side wall of a tool, and no friction. Use "
                             "a bonded tool, or CalculiX.", field="is_bonded")
        import felupe

        problem = _BondedProblem(test.mesh, material)
        positions = np.asarray(test.positions, dtype=float)
        forces, seconds, ended = [np.zeros(3)], [], ""
        for number, position in enumerate(positions[1:], start=1):
            began = time.process_time(), time.monotonic()
            reached = problem.move(position - positions[0], began[1] + test.max_seconds)
            seconds.append(time.process_time() - began[0])
            if not reached:
                place = f"position {number + 1} of {len(positions)} (depth {-1e3 * position[2]:.4g} mm)"
                ended = (f"FElupe needed more than {test.max_seconds:g} s for {place}."
                         if time.monotonic() > began[1] + test.max_seconds else
                         f"FElupe did not converge at {place}, after {_MAX_HALVINGS} bisections of the motion.")
                break
            forces.append(problem.compute_force())
            if progress is not None:
                progress(1 + number, len(positions))
        count = len(forces)
        return TargetCurve(positions[:count], np.array(forces), ended=ended,
                           step_seconds=float(np.median(seconds)) if seconds else float("nan"),
                           steps=np.zeros(count, dtype=int), version=f"FElupe {felupe.__version__}")


RUNNER = FelupeRunner()


class _BondedProblem:
    """Boundary-value problem in FElupe, SI: node set ``base`` fixed, node set ``face`` moved.

    Args:
        mesh: mesh of the specimen.
        material: material.

    Raises:
        InputError: FElupe has no equivalent of the mesh or of a part of the material.
    """

    def __init__(self, mesh: SolidMesh, material: Material):
        import felupe

        if mesh.element.name not in ELEMENTS:
            raise InputError(f"must be one of {', '.join(ELEMENTS)}; got {mesh.element.name}. Use a mesh of these "
                             "elements.", field="mesh.element")
        element = ELEMENTS[mesh.element.name]
        used, cells = np.unique(mesh.connectivity[:, element.nodes], return_inverse=True)
        region = getattr(felupe, element.region)(felupe.Mesh(
            mesh.nodes[used], cells.reshape(-1, len(element.nodes)), element.cell))
        content = ExportContent((material,))
        module: dict[str, Any] = {}
        exec(find_export_target("felupe").write(content), module)  # the module that a user of the export imports
        if element.is_mixed:
            self._field = (_make_fields_with_linear_pressures(region) if element.cell == "hexahedron27"
                           else felupe.FieldsMixed(region, n=3))
            self._body = felupe.SolidBody(module["make_mixed_material"](), self._field)
        else:
            self._field = felupe.FieldContainer([felupe.Field(region, dim=3)])
            self._body = felupe.SolidBodyNearlyIncompressible(module["make_isochoric_material"](), self._field,
                                                              bulk=module["BULK"][content.labels[0]])
        self._face = np.isin(used, mesh.sets["face"])
        self._bounds = {"base": felupe.Boundary(self._field[0], mask=np.isin(used, mesh.sets["base"]))}
        for axis, name in enumerate("xyz"):
            skip = tuple(other != axis for other in range(3))
            self._bounds[name] = felupe.Boundary(self._field[0], mask=self._face, skip=skip)
        self._motion = np.zeros(3)

    def move(self, motion: np.ndarray, deadline: float) -> bool:
        """Move the face, and bisect the motion until Newton's method converges.

        Args:
            motion: displacement of the face from its initial position, m, shape (3,).
            deadline: value of `time.monotonic` after which no iteration begins.

        Returns:
            Whether the face reached the position; otherwise the state is that before the call.
        """
        start, first = self._body.checkpoint(), self._motion
        fraction, size = 0.0, 1.0
        while fraction < 1.0:
            before = self._body.checkpoint()
            if self._solve(first + (fraction + size) * (motion - first), deadline):
                fraction += size
                continue
            self._body.restore(before)
            size *= 0.5
            if size < 0.5**_MAX_HALVINGS or time.monotonic() > deadline:
                self._body.restore(start)
                return False
        self._motion = motion
        return True

    def compute_force(self) -> np.ndarray:
        """Return the force on the tool, N, shape (3,)."""
        forces = self._body.assemble.vector(self._field).toarray().ravel()[:3 * len(self._face)].reshape(-1, 3)
        return -forces[self._face].sum(axis=0)

    def _solve(self, motion: np.ndarray, deadline: float) -> bool:
        """Solve for equilibrium by Newton's method; return whether it converged."""
        import felupe

        field, body = self._field, self._body
        for name, part in zip("xyz", motion, strict=True):
            self._bounds[name].update(part)
        dof0, dof1 = felupe.dof.partition(field, self._bounds)
        prescribed = felupe.dof.apply(field, self._bounds, dof0)
        for iteration in range(_MAX_ITERATIONS):
            # A diverging iterate may give numbers that are not finite.
            with np.errstate(all="ignore"):
                residual = body.assemble.vector(field)
                values = residual.toarray().ravel()
                if not np.isfinite(values).all() or time.monotonic() > deadline:
                    return False
                if iteration and np.linalg.norm(values[dof1]) <= _TOLERANCE * np.linalg.norm(values[dof0]):
                    # Isochoric energies are finite in an element that is turned inside out, too.
                    return bool((np.linalg.det(np.moveaxis(field.extract()[0], (0, 1), (-2, -1))) > 0.0).all())
                system = felupe.solve.partition(field, body.assemble.matrix(field), dof1, dof0, residual)
                field += felupe.solve.solve(*system, prescribed, solver=_solve_linear_system)
        return False


def _make_fields_with_linear_pressures(region: Any) -> Any:
    """Return displacements, and discontinuous pressures and volume ratios with the modes 1, x, y, z of each cell."""
    import felupe

    class LinearModes(felupe.Element):
        def __init__(self):
            self.points, self.cells, self.cell_type = np.zeros((4, 3)), np.arange(4)[None], "polygon"

        def function(self, point):
            return np.array([1.0, *point])

        def gradient(self, point):
            return np.array([np.zeros(3), *np.eye(3)])

    count = region.mesh.ncells
    cells = np.arange(4 * count).reshape(-1, 4)
    dual = felupe.Region(felupe.Mesh(np.zeros((4 * count, 3)), cells, "polygon"), LinearModes(), region.quadrature,
                         grad=False)
    ratios = np.tile([1.0, 0.0, 0.0, 0.0], count)[:, None]
    return felupe.FieldContainer([felupe.Field(region, dim=3), felupe.Field(dual), felupe.Field(dual, values=ratios)])


def _solve_linear_system(matrix: Any, right: np.ndarray) -> np.ndarray:
    """Solve a symmetric sparse system, which is indefinite with pressures."""
    from scipy.sparse.linalg import splu

    factor = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=1e-3, options={"SymmetricMode": True})
    return factor.solve(np.asarray(right).ravel())
