"""Meshes from files: what is read, what is named, and what is refused."""

import hashlib
import os

import meshio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from solid_meshes import block

import tissue_sim as ts
from tissue_sim.bounded import run_in_sandbox
from tissue_sim.errors import MESSAGE_LIMITS
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1, TET15P1
from tissue_sim.mesh.solid_file import convert_file_mesh, read_file_mesh, read_solid_mesh

#: Of our corners of a hexahedron the order of VTK, and of our 27 nodes.
VTK_8 = [0, 1, 3, 2, 4, 5, 7, 6]
VTK_27 = [0, 2, 8, 6, 18, 20, 26, 24, 1, 5, 7, 3, 19, 23, 25, 21, 9, 11, 17, 15, 12, 14, 10, 16, 4, 22, 13]
LINES = [0.0, 8.0, 20.0], [0.0, 10.0], [-15.0, -6.0, 0.0]
FORMATS = {"gmsh 4.1": (".msh", "gmsh", False), "gmsh 2.2": (".msh", "gmsh22", False), "binary": (".msh", "gmsh", True),
           "vtu": (".vtu", "vtu", None), "vtk": (".vtk", "vtk", None)}


def bricks(kind):
    """Points, mm, and elements of a block of 20 x 10 x 15 mm, in the order of VTK."""
    if kind.startswith("tetra"):
        mesh = block(*LINES, TET15P1)
        count = 4 if kind == "tetra" else 10
        used, numbers = np.unique(mesh.connectivity[:, :count], return_inverse=True)
        return mesh.nodes[used], numbers.reshape(-1, count)
    mesh = block(*LINES, HEX8P0 if kind == "hexahedron" else HEX27P1)
    order = VTK_8 if kind == "hexahedron" else VTK_27[: int(kind[10:])]
    used, numbers = np.unique(mesh.connectivity[:, order], return_inverse=True)
    return mesh.nodes[used], numbers.reshape(-1, len(order))


def write(folder, kind="tetra", format="gmsh 4.1", change=None, **parts):
    points, cells = bricks(kind)
    mesh = meshio.Mesh(points, [(kind, cells)], **parts)
    if change is not None:
        mesh = change(mesh) or mesh
    ending, name, binary = FORMATS[format]
    path = folder / f"mesh{ending}"
    mesh.write(path, file_format=name, **({} if binary is None else {"binary": binary}))
    return path


def inp(folder, kind="tetra", first=101, nodes_from=11, more="", change=None):
    """A file of Abaqus whose numbers begin anywhere."""
    points, cells = bricks(kind)
    rows = cells + nodes_from
    if change is not None:
        change(points, rows)
    name = {"tetra": "C3D4", "tetra10": "C3D10", "hexahedron": "C3D8R", "hexahedron20": "C3D20R"}[kind]
    text = ["*Heading", "** a block", "*Node", *(f"{n}, {x:.9g}, {y:.9g}, {z:.9g}" for n, (x, y, z)
                                                 in enumerate(points, nodes_from)), f"*Element, type={name}, elset=Gel"]
    for number, row in enumerate(rows, first):
        words = [str(number), *map(str, row)]
        text += [", ".join(words[:11]) + ("," if len(words) > 11 else ""), ", ".join(words[11:])]
    path = folder / "mesh.inp"
    path.write_text("\n".join([*text, more]) + "\n", encoding="utf-8")
    return path


def volume(mesh):
    points, weights = mesh.element.quadrature
    _, slopes = mesh.element.evaluate_shape_functions_and_gradients(points)
    return (np.linalg.det(np.einsum("eai,qaj->eqij", mesh.nodes[mesh.connectivity], slopes)) * weights).sum()


def check_block(mesh, order):
    """All of it, in m, with the middle of the top at the origin."""
    assert volume(mesh) == pytest.approx(0.02 * 0.01 * 0.015, rel=1e-12) and mesh.element.order == order
    np.testing.assert_allclose(mesh.nodes.min(axis=0), [-0.01, -0.005, -0.015], atol=1e-15)
    np.testing.assert_allclose(mesh.nodes.max(axis=0), [0.01, 0.005, 0.0], atol=1e-15)
    areas = {name: 0.5
             * np.linalg.norm(np.cross(corners := mesh.nodes[sides[:, mesh.element.corner_indices_within_face]],
                                       np.roll(corners, -1, axis=1)).sum(axis=1), axis=1).sum()
             for name, sides in mesh.faces.items()}
    assert areas == pytest.approx({"top": 2e-4, "base": 2e-4, "side": 0.06 * 0.015}, rel=1e-9)
    assert mesh.surface_node_areas.sum() == pytest.approx(sum(areas.values()), rel=1e-9)


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("kind", ["tetra", "tetra10", "hexahedron", "hexahedron20", "hexahedron27"])
def test_formats_and_elements(tmp_path, format, kind):
    mesh = read_file_mesh(write(tmp_path, kind, format))
    for order in (1, 2):
        check_block(convert_file_mesh(mesh, order), order)


def test_one_process_reads_one_mesh_after_the_other(tmp_path):
    """Loading the libraries takes a hundred times as long as reading a small mesh."""
    path = write(tmp_path)
    processes = [(read_file_mesh(path), run_in_sandbox(os.getpid, file=path))[1] for _ in range(3)]
    assert len(set(processes)) == 1


@pytest.mark.parametrize("kind", ["tetra", "tetra10", "hexahedron", "hexahedron20"])
def test_abaqus(tmp_path, kind):
    mesh = read_solid_mesh(inp(tmp_path, kind))
    check_block(mesh, 2)
    assert not mesh.regions, "a set of all elements is no region"


@pytest.mark.parametrize(("kind", "close"), [("tetra10", 2e-3), ("hexahedron20", 1e-12), ("hexahedron27", 1e-12)])
def test_middles_of_curved_edges_are_kept(tmp_path, kind, close):
    """Sides that bulge with the square of the height; straight elements miss 4 % of the volume."""
    def bulge(mesh):
        x, _, z = mesh.points.T
        mesh.points[:, 0] = 10.0 + (x - 10.0) * (1.0 + 0.2 * (1.0 - (1.0 + z / 7.5) ** 2))

    path = write(tmp_path, kind, change=bulge)
    exact = 0.02 * 0.01 * 0.015 * (1.0 + 0.2 * 2.0 / 3.0)
    assert volume(read_solid_mesh(path)) == pytest.approx(exact, rel=close)
    assert volume(read_solid_mesh(path, order=1)) < 0.98 * exact


def sides_of(points, cells, kind, where):
    """Triangles or quads of the sides of elements whose corners all fulfil a condition."""
    from tissue_sim.mesh.formats.checks import SIDES

    corners = cells[:, np.array(SIDES[kind])].reshape(-1, len(SIDES[kind][0]))
    return corners[where(points[corners]).all(axis=1)]


def test_physical_groups_name_sides_and_regions(tmp_path):
    points, cells = bricks("tetra")
    left = points[cells].mean(axis=1)[:, 0] < 8.0
    glued = sides_of(points, cells, "tetra", lambda place: place[..., 0] == 0.0)
    tops = sides_of(points, cells, "tetra", lambda place: place[..., 2] == 0.0)
    path = tmp_path / "mesh.msh"
    meshio.Mesh(points, [("triangle", glued), ("triangle", tops), ("tetra", cells[left]), ("tetra", cells[~left])],
                cell_data={"gmsh:physical": [np.full(len(glued), 1), np.full(len(tops), 2),
                                             np.full(left.sum(), 3), np.full((~left).sum(), 4)],
                           "gmsh:geometrical": [np.full(len(glued), 1), np.full(len(tops), 2),
                                                np.full(left.sum(), 1), np.full((~left).sum(), 2)]},
                field_data={"glued": [1, 2], "dome": [2, 2], "soft": [3, 3], "stiff": [4, 3]}
                ).write(path, file_format="gmsh22", binary=False)
    mesh = read_solid_mesh(path, base="glued", top="dome")
    assert np.ptp(mesh.nodes[mesh.sets["base"], 0]) == 0.0 and len(mesh.faces["base"]) == len(glued)
    assert (mesh.nodes[mesh.sets["top"], 2] == 0.0).all()
    assert set(mesh.regions) == {"soft", "stiff"}
    middles = mesh.nodes[mesh.connectivity].mean(axis=1)[:, 0]
    assert middles[mesh.regions["soft"]].max() < middles[mesh.regions["stiff"]].min()
    with pytest.raises(ts.InputError, match="named 'glue'; did you mean 'glued'") as caught:
        read_solid_mesh(path, base="glue")
    assert caught.value.field == "mesh_base"


def test_sets_and_surfaces_of_abaqus_name_sides_and_regions(tmp_path):
    points, cells = bricks("tetra")
    on_side = np.flatnonzero(points[:, 0] == 0.0) + 11
    beneath = [(row + 101, side) for row, nodes in enumerate(cells)
               for side, local in enumerate([(0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 3)], start=1)
               if (points[nodes[list(local)], 2] == -15.0).all()]
    more = ["*NSET, NSET=Glued", ", ".join(map(str, on_side)), "*ELSET, ELSET=HALF, GENERATE", "101, 106, 1",
            "*SURFACE, NAME=Floor, TYPE=ELEMENT", *(f"{number}, S{side}" for number, side in beneath)]
    path = inp(tmp_path, more="\n".join(more))
    assert np.ptp(read_solid_mesh(path, base="GLUED").nodes[read_solid_mesh(path, base="glued").sets["base"], 0]) == 0.0
    mesh = read_solid_mesh(path, base="Floor")
    assert np.ptp(mesh.nodes[mesh.sets["base"], 2]) < 1e-15 and len(mesh.faces["base"]) == len(beneath)
    assert mesh.regions["HALF"].tolist() == list(range(6))


def test_cell_data_of_vtk_names_regions_and_sides(tmp_path):
    points, cells = bricks("hexahedron")
    glued = sides_of(points, cells, "hexahedron", lambda place: place[..., 0] == 0.0)
    path = tmp_path / "mesh.vtu"
    meshio.Mesh(points, [("quad", glued), ("hexahedron", cells)],
                cell_data={"part": [np.full(len(glued), 7), np.arange(len(cells)) % 2],
                           "glue": [np.ones(len(glued), int), np.zeros(len(cells), int)]}).write(path)
    mesh = read_solid_mesh(path, base="glue")
    assert np.ptp(mesh.nodes[mesh.sets["base"], 0]) == 0.0
    assert {name: places.tolist() for name, places in mesh.regions.items()} == {"part:0": [0, 2], "part:1": [1, 3]}


def test_what_looks_up_is_the_top_of_a_dome(tmp_path):
    def dome(mesh):
        x, y, z = mesh.points.T
        mesh.points[:, 2] += (1.0 + z / 15.0) * (4.0 - 0.03 * ((x - 10.0) ** 2 + (y - 5.0) ** 2))

    mesh = read_solid_mesh(write(tmp_path, "hexahedron", change=dome))
    assert len(mesh.faces["top"]) == 2 and mesh.nodes[:, 2].max() == 0.0


def turn(points, rows):
    rows[3, [0, 1]] = rows[3, [1, 0]]


def turn_all(points, rows):
    rows[:, [0, 1]] = rows[:, [1, 0]]


def flatten(points, rows):
    points[rows[3, 3] - 11] = points[rows[3, :3] - 11].mean(axis=0)


def repeat(points, rows):
    rows[3, 1] = rows[3, 0]


def no_number(points, rows):
    points[4, 1] = np.nan


def stranger(points, rows):
    rows[3, 2] = 999


def twice(points, rows):
    rows[3] = rows[5]


@pytest.mark.parametrize(("change", "more", "expected"), [
    (turn, "", "element 104 is turned inside out"), (turn_all, "", "all elements are turned inside out, element 101"),
    (flatten, "", "element 10[0-9] is (degenerate|turned inside out)"),
    (repeat, "", "element 104 is degenerate: it has a node twice; remove this element"),
    (no_number, "", "node 15 has a coordinate that is not finite"),
    (stranger, "", "element 104 has the node 999, which is not in the file"),
    (twice, "", "elements 104 and 106 have the same corners"),
    (None, "*NODE\n500, 1, 1, 1", "node 500 belongs to no element"),
    (None, "*NODE\n11, 1, 1, 1", "node 11 is stated twice"),
    (None, "*ELEMENT, TYPE=C3D4\n101, 11, 12, 13, 14", "element 101 is stated twice"),
    (None, "*ELEMENT, TYPE=C3D8\n900, 11, 12, 13, 14, 15, 16, 17, 18",
     "mixes kinds of elements: element 101 is a tetra, element 900 a hexahedron"),
    (None, "*ELEMENT, TYPE=C3D6\n900, 11, 12, 13, 14, 15, 16", "element 900 is a wedge; the solid takes"),
    (None, "*ELEMENT, TYPE=C3D99\n900, 11", "elements must have the type .* got C3D99"),
    (None, "*ELEMENT, TYPE=C3D4\n900, 11, 12", "must be its number and 4 nodes"),
    (None, "*NODE\n500, 90, 90, 90\n501, 91, 90, 90\n502, 90, 91, 90\n503, 90, 90, 91\n*ELEMENT, TYPE=C3D4\n"
     "900, 500, 501, 502, 503", "is not one connected body: element 101 and element"),
    (None, "*NODE\n500, 0, 0, 0", "node 500 belongs to no element|nodes .* have the same position"),
    (None, "*INCLUDE, INPUT=/etc/passwd", "INCLUDE is not supported"),
    (None, "*NSET, NSET=A\nB", "names the set 'B', which is not defined before this line"),
    (None, "*NSET, NSET=A, GENERATE\n1, 9999999999, 1", "at most 10000000 members"),
    (None, "*ELEMENT, TYPE=C3D4\n900, a, b, c, d", "the data of .ELEMENT must be integers"),
])
def test_a_bad_mesh_is_refused_with_the_number_in_its_file(tmp_path, change, more, expected):
    with pytest.raises(ts.InputError, match=expected) as caught:
        read_solid_mesh(inp(tmp_path, change=change, more=more))
    assert "mesh.inp" in str(caught.value) and len(str(caught.value)) <= MESSAGE_LIMITS.message


def test_a_mesh_that_is_torn_or_touches_itself_is_refused(tmp_path):
    cube = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)
    hexahedron = np.array([VTK_8])
    torn = meshio.Mesh(np.concatenate([cube, cube + np.array([1, 0, 0])]), [("hexahedron", np.concatenate([hexahedron,
                                                                                                           hexahedron
                                                                                                           + 8]))])
    torn.write(tmp_path / "torn.vtu")
    with pytest.raises(ts.InputError, match="nodes 1 and 8 have the same position, so the mesh is not connected there"):
        read_file_mesh(tmp_path / "torn.vtu")
    # Five of eight cubes round a point, of which the first and the last meet along an edge alone.
    points = np.array([(x, y, z) for z in range(3) for y in range(3) for x in range(3)], dtype=float)

    def at(i, j, k):
        return [i + x + 3 * (j + y) + 9 * (k + z) for x, y, z in cube[VTK_8].astype(int)]

    cubes = np.array([at(0, 0, 0), at(0, 0, 1), at(1, 0, 1), at(1, 1, 1), at(1, 1, 0)])
    used, numbers = np.unique(cubes, return_inverse=True)
    meshio.Mesh(points[used], [("hexahedron", numbers.reshape(cubes.shape))]).write(tmp_path / "edge.vtu")
    with pytest.raises(ts.InputError, match="the surface does not close, or touches itself, at an edge of element 0"):
        read_file_mesh(tmp_path / "edge.vtu")
    # And one element on a side that two others share.
    points, cells = bricks("tetra")
    third = np.vstack([points, points[cells[0]].mean(axis=0) + np.array([0.0, 0.0, 1.0])])
    a, b, c = next(side for side in sides_of(points, cells, "tetra", lambda place: place[..., 0] < 8.1)
                   if sum(set(side) <= set(row) for row in cells) == 2)
    extra = np.array([[a, b, c, len(points)]])
    volume = np.linalg.det(third[extra[0, 1:]] - third[extra[0, 0]])
    meshio.Mesh(third, [("tetra", np.concatenate([cells, extra if volume > 0 else extra[:, [0, 2, 1, 3]]]))
                        ]).write(tmp_path / "three.vtu")
    with pytest.raises(ts.InputError, match="share one side, but a side belongs to at most two "
                       "elements; the mesh overlaps itself"):
        read_file_mesh(tmp_path / "three.vtu")


@pytest.mark.parametrize(("unit", "expected"), [("m", "got 20 m with the unit m"),
                                                ("um", "got 2e-05 m with the unit um"),
                                                ("furlong", "unknown unit 'furlong'; known: m, cm")])
def test_a_wrong_scale_is_refused(tmp_path, unit, expected):
    with pytest.raises(ts.InputError, match=expected):
        read_file_mesh(write(tmp_path), unit)


def test_what_has_no_volume_or_cannot_stand(tmp_path):
    points, cells = bricks("tetra")
    meshio.Mesh(points, [("triangle", cells[:, :3])]).write(tmp_path / "a.vtu")
    with pytest.raises(ts.InputError, match="contains no volume elements, it has only triangle"):
        read_file_mesh(tmp_path / "a.vtu")
    turned = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turned *= np.sign(np.linalg.det(turned))
    meshio.Mesh(points @ turned.T, [("tetra", cells)]).write(tmp_path / "b.vtu")
    with pytest.raises(ts.InputError, match="no side of the mesh lies in its lowest plane"):
        read_solid_mesh(tmp_path / "b.vtu")


@pytest.mark.parametrize("ending", [".msh", ".vtu", ".vtk", ".inp"])
@pytest.mark.parametrize("content", [b"", b"\0" * 100, b"\xff\xfe\xfd" * 100, b"9" * 5000, b"<" * 10_000, b"*NODE\n1",
                                     b"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n1 999999999999 1 1\n",
                                     b"$MeshFormat\n2.2 1 8\n\1\0\0\0\n$EndMeshFormat\n$Nodes\n2000000000\n",
                                     b"# vtk DataFile Version 5.1\nx\nBINARY\nDATASET UNSTRUCTURED_GRID\n"
                                     b"POINTS 99999999999 double\n"],
                         ids=["empty", "nul", "no text", "digits", "xml", "node", "huge", "huge binary", "huge vtk"])
def test_garbage_is_refused_in_a_sentence(tmp_path, ending, content):
    path = tmp_path / f"mesh{ending}"
    path.write_bytes(content)
    with pytest.raises(ts.InputError) as caught:
        read_file_mesh(path)
    assert len(str(caught.value)) <= MESSAGE_LIMITS.message and str(caught.value).isprintable()


def test_other_endings_and_no_file(tmp_path):
    with pytest.raises(ts.InputError, match=r"the ending '.stl', expected a mesh with one of .msh, .vtu, .vtk, .inp"):
        read_file_mesh(tmp_path / "mesh.stl")
    for ending in (".msh", ".inp"):
        with pytest.raises(ts.InputError, match="no such file"):
            read_file_mesh(tmp_path / f"none{ending}")
    (tmp_path / "large.msh").write_bytes(b"")
    with (tmp_path / "large.msh").open("r+b") as file:
        file.truncate(200_000_000)
    with pytest.raises(ts.InputError, match="has 200 MB, expected a mesh of at most 100 MB"):
        read_file_mesh(tmp_path / "large.msh")


def twice_as_large(points, _):
    points *= 2.0


def test_the_digest_is_that_of_the_mesh_in_use(tmp_path):
    """And not that of a file that another program wrote in its place meanwhile."""
    path = inp(tmp_path)
    first = path.read_bytes()
    specimen = ts.Specimen(shape="mesh", mesh_file=path)
    inp(tmp_path, change=twice_as_large)
    assert specimen.digest_of_files == hashlib.sha256(first).hexdigest()
    other = ts.Specimen(shape="mesh", mesh_file=path)
    assert other.height == 2.0 * specimen.height
    assert other.digest_of_files == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize("make", [write, inp])
def test_a_file_is_opened_once(tmp_path, monkeypatch, make):
    path, opened = make(tmp_path), []

    def counting(true):
        def opens(name, *rest, **more):
            opened.append(os.fspath(name) if isinstance(name, str | os.PathLike) else "")
            return true(name, *rest, **more)

        return opens

    monkeypatch.setattr("tissue_sim.mesh.solid_file.run_in_sandbox", lambda function, *words, file: function(*words))
    monkeypatch.setattr("os.open", counting(os.open))
    monkeypatch.setattr("builtins.open", counting(open))
    assert read_file_mesh(path).digest == hashlib.sha256(path.read_bytes()).hexdigest()
    assert opened.count(str(path)) == 1
    path.write_bytes(b"<")
    with pytest.raises(ts.InputError) as caught:
        read_file_mesh(path)
    assert str(caught.value).startswith(str(path)) and "tissue_sim_" not in str(caught.value)


def test_without_meshio_the_extra_is_named(tmp_path, monkeypatch):
    from tissue_sim.mesh.formats.through_meshio import read_through_meshio

    path = write(tmp_path)
    monkeypatch.setitem(__import__("sys").modules, "meshio.gmsh", None)
    with pytest.raises(ts.InputError, match=r"pip install 'tissue-sim\[meshes\]', or save the mesh as .inp"):
        read_through_meshio(path, 1_000_000)


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meshes")
    paths = []
    for name in FORMATS:
        (folder / name).mkdir()
        paths.append(write(folder / name, "tetra", name))
    return [(path.suffix, path.read_bytes()) for path in (*paths, inp(folder))]


@settings(max_examples=60)
@given(data=st.data())
def test_a_damaged_file_is_refused_or_read(samples, tmp_path_factory, data):
    """Never anything but a sound mesh or one sentence."""
    ending, content = data.draw(st.sampled_from(samples))
    content = bytearray(content)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        if data.draw(st.booleans()):
            content[at] = data.draw(st.integers(0, 255))
        else:
            del content[at : at + data.draw(st.integers(1, 200))]
    path = tmp_path_factory.mktemp("damaged") / f"mesh{ending}"
    path.write_bytes(content)
    try:
        mesh = read_file_mesh(path)
        assert np.isfinite(mesh.points).all() and len(mesh.sides) and mesh.cells.nodes.max() < len(mesh.points)
    except ts.InputError as error:
        assert len(str(error)) <= MESSAGE_LIMITS.message
