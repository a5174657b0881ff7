"""The elements of a mesh a few at a time, as the arrays that the kernels work on."""

from __future__ import annotations

import numpy as np

from tissue_sim.fem.linear import band
from tissue_sim.mesh import Mesh

#: Elements that a kernel works on at once, one in each lane of its vectors. Eight, the width of AVX-512, are no faster
#: where a processor has it, slower on others, and take half as long again to compile (docs/performance.md).
LANES = 4


class ElementBatches:
    """Lane l of batch b is element LANES b + l; lanes that are left over repeat the last element and write nowhere.

    Arrays of vectors have one row of `LANES` numbers for each batch times whatever stands in brackets; pairs are those
    of shared nodes (c, a), a <= c, at place c (c + 1) / 2 + a.

    Attributes:
        elements: their numbers; real: 1, or 0 in a lane that is left over; moduli, in units of the law's.
        dofs: first freedom of each node [nodes]; equations: of r, then of z [shared nodes], into the residual, whose
            last entry is nobody's.
        gradients: of the shape functions along r and z, and value over r, three arrays [points, nodes].
        weights: [points]; modes: of the pressure [points, modes]; volumes: of the nodes, m3 [nodes].
        places: of the stiffness of each pair in the flattened band matrix, rr, zr, rz, zz, shape (batches, 4 pairs
            LANES); its last entry is nobody's.
        pulls: number of the first of each batch, and rows (target, place of the stiffness): the forces of what moves
            with the tool. Targets are the equations, and the last one what meets itself; `pull_factors` multiply.
        stiffness: of one batch's pairs, rr, zr, rz, zz, [pairs] each.
        volume: dV/du of each pressure mode along r and along z [modes, nodes]; gap: what the volume differs from what
            the pressure asks for [modes]; known_volume: dV/du that the matrix holds.
        centre_rows: motion of the interior node for one of the shared nodes, sign turned, rr, rz, zr, zz [shared
            nodes]; centre_inverse: of its own block, rr, rz, zz; centre_force: its motion for its forces, r, z.
    """

    def __init__(self, mesh: Mesh, gradients: np.ndarray, weights: np.ndarray, modes: np.ndarray, volumes: np.ndarray):
        """Args: gradients (elements, q, nodes, 3), weights (elements, q), modes (elements, q, m), volumes (elements,
        nodes)."""
        count, nodes = mesh.connectivity.shape
        shared = mesh.element.boundary_nodes
        pairs = shared * (shared + 1) // 2
        batches = -(-count // LANES)
        self.count, self.batches, self.pairs = count, batches, pairs
        numbers = np.arange(batches * LANES).reshape(batches, LANES)
        self.elements = np.minimum(numbers, count - 1).astype(np.int32)
        self.real = (numbers < count).astype(float)
        self.moduli = np.ones((batches, LANES))
        self.dofs = self._lanes(2 * mesh.connectivity.astype(np.int32))
        self.gradients = tuple(self._lanes(gradients[..., i]) for i in range(3))
        self.weights, self.modes, self.volumes = self._lanes(weights), self._lanes(modes), self._lanes(volumes)
        self.stiffness = np.zeros((4 * pairs, LANES))
        m = mesh.element.pressure_modes
        self.volume, self.known_volume = np.zeros((2, 2, batches * m * nodes, LANES))
        self.gap = np.zeros((batches * m, LANES))
        self.centre_rows = tuple(np.zeros((batches * shared, LANES)) for _ in range(4))
        self.centre_inverse = tuple(np.zeros((batches, LANES)) for _ in range(3))
        self.centre_force = tuple(np.zeros((batches, LANES)) for _ in range(2))

    def _lanes(self, values: np.ndarray) -> np.ndarray:
        """Values of the elements, shape (elements, ...), with the lanes last: (batches times the rest, LANES)."""
        taken = values[self.elements]
        return np.ascontiguousarray(np.moveaxis(taken, 1, -1).reshape(-1, LANES))

    def eliminated(self) -> dict[str, np.ndarray]:
        """Arrays of what is eliminated from each element, by their names in the kernels."""
        named = dict(zip(("volume_r", "volume_z"), self.volume, strict=True))
        named |= zip(("known_volume_r", "known_volume_z"), self.known_volume, strict=True)
        named |= zip(("rows_rr", "rows_rz", "rows_zr", "rows_zz"), self.centre_rows, strict=True)
        return named | dict(zip(("inverse_rr", "inverse_rz", "inverse_zz"), self.centre_inverse, strict=True))

    def arrays(self) -> dict[str, np.ndarray]:
        """All other arrays, by their names in the kernel of a step."""
        named = {"elements": self.elements, "dofs": self.dofs, "real": self.real, "point_weights": self.weights,
                 "mode_values": self.modes, "volumes": self.volumes, "moduli": self.moduli, "places": self.places,
                 "pull_starts": self.pull_starts, "pulls": self.pulls, "pull_factors": self.pull_factors,
                 "element_stiffness": self.stiffness.reshape(-1), "gap": self.gap}
        named |= zip(("gradient_r", "gradient_z", "value_r"), self.gradients, strict=True)
        named |= zip(("equations_r", "equations_z"), self.equations, strict=True)
        named |= zip(("k_rr", "k_zr", "k_rz", "k_zz"), np.split(self.stiffness, 4), strict=True)
        return named | dict(zip(("force_r", "force_z"), self.centre_force, strict=True))

    def follow_shared(self, way: np.ndarray) -> None:
        """Fill in how the interior nodes move where the shared ones move so, shape (freedoms,)."""
        count, shared = self.count, self.centre_rows[0].shape[0] // self.batches
        dofs = self.dofs.reshape(self.batches, -1, LANES)
        if dofs.shape[1] == shared:
            return
        r = dofs[:, :shared].reshape(-1, LANES)
        along_r, along_z = way[r], way[r + 1]
        rr, rz, zr, zz = self.centre_rows
        inside = dofs[:, shared].reshape(-1)[:count]
        for place, on_r, on_z in ((inside, rr, rz), (inside + 1, zr, zz)):
            moved = (on_r * along_r + on_z * along_z).reshape(self.batches, shared, LANES).sum(axis=1)
            way[place] = -moved.reshape(-1)[:count]

    def set_moduli(self, moduli: np.ndarray) -> None:
        """Moduli of the elements, shape (elements,)."""
        self.moduli[:] = moduli[self.elements]

    def number(self, mesh: Mesh, equation: np.ndarray, free: int, direction: np.ndarray,
               shape: tuple[int, int]) -> None:
        """Say where everything goes: equation and direction of each freedom, and block rows and width of the band."""
        shared = mesh.element.boundary_nodes
        nobody = max(shape[0] * band.BLOCK, int(equation.max()) + 1)
        own = equation.reshape(-1, 2)[mesh.connectivity[:, :shared]]  # (elements, shared, 2)
        lanes = np.where(self.real[:, :, None, None] > 0, own[self.elements], nobody)
        self.equations = tuple(np.ascontiguousarray(np.moveaxis(lanes[..., i], 1, -1).reshape(-1, LANES),
                                                    dtype=np.int32) for i in range(2))
        c, a = np.array([(c, a) for c in range(shared) for a in range(c + 1)]).T
        # Force on a along i for a motion of c along k: rr, zr, rz, zz.
        i, k = np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1])
        rows, columns = own[:, a][:, :, i].swapaxes(1, 2), own[:, c][:, :, k].swapaxes(1, 2)  # (elements, 4, pairs)
        # Of the block of one node and itself rz is zr once more.
        twice = (c == a) & ((i == 0) & (k == 1))[:, None]
        places = np.where(twice, -1, _band_places(rows, columns, free, shape))
        last = shape[0] * shape[1] * band.BLOCK**2
        places = np.where(places < 0, last, places)
        lanes = np.where(self.real[:, :, None, None] > 0, places[self.elements], last)
        self.places = np.ascontiguousarray(np.moveaxis(lanes, 1, -1).reshape(self.batches, -1), dtype=np.int32)
        self._note_pulls(mesh, own, direction, rows, columns, twice, free)

    def _note_pulls(self, mesh, own, direction, rows, columns, twice, free) -> None:
        """Where the stiffness between what moves with the tool and what is free goes, and that within what moves."""
        shared = mesh.element.boundary_nodes
        way = np.zeros(int(own.max()) + 1)
        way[own] = direction.reshape(-1, 2)[mesh.connectivity[:, :shared]]
        moved_row, moved_column = way[rows], way[columns]
        found = []
        for row, factor in ((rows, moved_column), (columns, moved_row)):
            found.append(np.where((row < free) & (factor != 0), factor, 0.0))
        itself = np.where((rows == columns), 1.0, 2.0) * moved_row * moved_column
        entries = []
        for target, factor in ((rows, found[0]), (columns, found[1]), (np.full_like(rows, free), itself)):
            e, four, pair = np.nonzero(np.where(twice, 0.0, factor))
            stiffness = (four * self.pairs + pair) * LANES + e % LANES
            entries.append(np.stack([e // LANES, target[e, four, pair], stiffness], axis=1))
            entries[-1] = np.concatenate([entries[-1], factor[e, four, pair][:, None]], axis=1)
        table = np.concatenate(entries)
        table = table[np.argsort(table[:, 0], kind="stable")]
        if not len(table):
            table = np.zeros((1, 4))
            table[0, 0] = self.batches
        self.pull_starts = np.searchsorted(table[:, 0], np.arange(self.batches + 1)).astype(np.int32)
        self.pulls = np.ascontiguousarray(table[:, 1:3], dtype=np.int32)
        self.pull_factors = np.ascontiguousarray(table[:, 3])


def _band_places(rows: np.ndarray, columns: np.ndarray, free: int, shape: tuple[int, int]) -> np.ndarray:
    """Place of each entry in the flattened lower band, -1 for what is not free."""
    low, high = np.minimum(rows, columns), np.maximum(rows, columns)
    I, J, width = high // band.BLOCK, low // band.BLOCK, shape[1]
    places = ((I * width + J - I + width - 1) * band.BLOCK + low % band.BLOCK) * band.BLOCK + high % band.BLOCK
    return np.where(high < free, places, -1)
