"""PLY: every layout that a header can describe is read; other files are refused."""

import struct

import numpy as np
import pytest

POINTS = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (-1, 1, 0), (3, 0, 0), (3.5, 1, 0), (3, 2, 0)]
# A quad of area 4, a triangle of 1 and a pentagon of 2.5, all counterclockwise.
FACES = [[0, 1, 2, 3], [4, 0, 3], [1, 5, 6, 7, 2]]
AREA = 7.5
CODES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
CODES |= {"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "float32": "f"}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def ply(form, elements, end="\n", comments=()):
    """Return a file of elements: (name, [(property name, its type or (type of the length, type))], rows)."""
    header, rows, data = ["ply", f"format {form} 1.0", *comments], [], b""
    for name, properties, values in elements:
        header.append(f"element {name} {len(values)}")
        for key, kind in properties:
            header.append(f"property {kind if isinstance(kind, str) else 'list ' + ' '.join(kind)} {key}")
        for row in values:
            words = []
            for value, (_, kind) in zip(row, properties, strict=True):
                if isinstance(kind, str):
                    words.append((CODES[kind], value))
                else:
                    words += [(CODES[kind[0]], len(value)), *((CODES[kind[1]], each) for each in value)]
            rows.append(" ".join(str(value) for _, value in words))
            if form != "ascii":
                data += b"".join(struct.pack(ORDERS[form] + code, value) for code, value in words)
    text = end.join([*header, "end_header", *(rows if form == "ascii" else []), ""])
    return text.encode("latin-1") + data


def mesh(form, faces=FACES, length="uchar", index="int", real="float", name="vertex_indices"):
    vertices = ("vertex", [(axis, real) for axis in "xyz"], POINTS)
    return ply(form, [vertices, ("face", [(name, (length, index))], [(face,) for face in faces])])


def assert_read(loaded, area=AREA):
    assert loaded.area == pytest.approx(area) and loaded.area_vectors.sum(axis=0) == pytest.approx([0, 0, area])


@pytest.mark.parametrize("form", ORDERS)
def test_faces_of_different_sizes(load, form):
    loaded = load("ply", mesh(form))
    assert_read(loaded)
    assert len(loaded.mesh.faces) == 2 + 1 + 3 and loaded.notes == []
    areas = np.linalg.norm(loaded.area_vectors, axis=1)
    assert [areas[:2].sum(), areas[2], areas[3:].sum()] == pytest.approx([4, 1, 2.5])  # in the file's order


@pytest.mark.parametrize("form", ORDERS)
@pytest.mark.parametrize("index", ["char", "uchar", "short", "ushort", "int", "uint", "int8", "uint16", "int32"])
@pytest.mark.parametrize("length", ["char", "ushort", "int", "uint8", "uint32"])
def test_lists_of_every_type(load, form, length, index):
    assert_read(load("ply", mesh(form, length=length, index=index)))
    assert_read(load("ply", mesh(form, FACES[1:2], length, index, "double", "vertex_index")), 1)


@pytest.mark.parametrize("form", ORDERS)
@pytest.mark.parametrize("faces", [FACES, FACES[:1] * 3], ids=["uneven", "even"])
def test_properties_and_elements_that_are_not_needed_are_passed_over(load, form, faces):
    vertices = [(7, x, -1.5, y, z, [1, 2, 3][: k % 3], k) for k, (x, y, z) in enumerate(POINTS)]
    names = [("flag", "uchar"), ("x", "double"), ("quality", "float"), ("y", "float"), ("z", "short")]
    names += [("neighbours", ("uint16", "double")), ("last", "int")]
    rows = [([0.5] * (k % 3), 9, face, 200, [1, 2]) for k, face in enumerate(faces)]
    lists = [("weights", ("uchar", "float")), ("before", "short"), ("vertex_indices", ("int", "ushort"))]
    lists += [("red", "uchar"), ("after", ("char", "uint"))]
    elements = [("camera", [("fov", "float")], [(40,)]), ("face", lists, rows), ("empty", [("no", "int")], [])]
    elements += [("vertex", names, vertices), ("edge", [("pair", ("uchar", "int"))], [([0, 1],), ([],)])]
    assert_read(load("ply", ply(form, elements)), AREA if faces is FACES else 12)


@pytest.mark.parametrize("form", ORDERS)
@pytest.mark.parametrize("uv", ["uv", "st"])
def test_normals_and_uv_of_uneven_faces_stay_with_their_vertices(load, form, uv):
    names = [*"xyz", "nx", "ny", "nz", *uv]
    rows = [(*point, 0, 0.6, 0.8, point[0] / 4, point[1] / 4) for point in POINTS]
    faces = [(face,) for face in FACES]
    elements = [("vertex", [(name, "float") for name in names], rows)]
    loaded = load("ply", ply(form, [*elements, ("face", [("vertex_indices", ("uchar", "int"))], faces)]))
    np.testing.assert_allclose(loaded.mesh.normals, [[0, 0.6, 0.8]] * len(POINTS), rtol=1e-6)
    np.testing.assert_allclose(loaded.mesh.uv, np.array(POINTS)[:, :2] / 4)
    assert loaded.uv_areas.sum() == pytest.approx(AREA / 16) and (loaded.uv_areas > 0).all()


@pytest.mark.parametrize("form", ORDERS)
@pytest.mark.parametrize(
    ("strips", "area"),
    [
        ([[1, 0, 3, 2, 5, 4, 7, 6]], 3),
        ([[1, 0, 3, -1, 2, 3, 0, -1, 3, 2, 5, 4, 7, 6]], 3),
        ([[1, 0, 3, 2], [3, 2, 5, 4, 7, 6, -1]], 3),
        ([[1, 0, 3, 2, 2, 3, 3, 2, 5, 4]], 2),
    ],
    ids=["one", "ended by -1", "two", "joined by repeated vertices"],
)
def test_triangle_strips(load, form, strips, area):
    """Every second triangle is wound the other way, counted from the start of the strip."""
    points = [(x, y, 0) for x in range(4) for y in (0, 1)]
    elements = [("vertex", [(axis, "float") for axis in "xyz"], points)]
    elements += [("tristrips", [("vertex_indices", ("int", "int"))], [(strip,) for strip in strips])]
    loaded = load("ply", ply(form, elements))
    assert_read(loaded, area)
    assert loaded.notes == []


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_line_ends_and_names_in_other_encodings(load, end):
    vertices = ("vertex", [(axis, "float") for axis in "xyz"], POINTS)
    faces = ("face", [("vertex_indices", ("uchar", "int"))], [(face,) for face in FACES])
    for form in ORDERS:
        assert_read(
            load("ply", ply(form, [vertices, faces], end, ["comment caf\xe9", "obj_info end_header", "comment"]))
        )


def test_numbers_of_a_text_are_rounded_to_their_type(load):
    """So text and binary files of one mesh give the same mesh."""
    third = [(x / 3, y / 3, z) for x, y, z in POINTS]
    faces = ("face", [("vertex_indices", ("uchar", "int"))], [([0, 1, 2],)])
    kinds = [(axis, "float") for axis in "xyz"]
    text, binary = (load("ply", ply(form, [("vertex", kinds, third), faces])) for form in list(ORDERS)[:2])
    np.testing.assert_array_equal(text.mesh.vertices, binary.mesh.vertices)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data + b"\1\2\3", "3 bytes are left behind the last element"),
        (lambda data: data[:-1], "the file ends after 2 of 3 face rows"),
        (lambda data: data.replace(b"float y", b"float w"), "element vertex lacks the property y"),
        (lambda data: data.replace(b"vertex_indices", b"texcoord"), "texture coordinates per face"),
        (lambda data: data.replace(b"vertex_indices", b"corners"), "element face lacks the list vertex_indices"),
        (lambda data: data.replace(b"uchar int", b"uchar real"), 'the header says "property list uchar real'),
        (lambda data: data.replace(b"element face", b"elemend face"), 'the header says "elemend face 3"'),
        (lambda data: data.replace(b"1.0", b"2.0"), 'the header says "format binary_little_endian 2.0"'),
        (lambda data: data.replace(b"\nend_header\n", b"\n"), "no line end_header"),
        (lambda data: data.replace(b"uchar int", b"char int").replace(b"\5\1\0\0\0", b"\xff\1\0\0\0"), "length -1"),
    ],
)
def test_what_the_header_does_not_describe_is_refused(refused, change, words):
    assert words in refused("ply", change(mesh("binary_little_endian")))


def test_faces_of_two_vertices_and_fractions_of_vertices_are_refused(refused):
    for form in ORDERS:
        assert "face 1 (counting from 0) has 2 vertices" in refused("ply", mesh(form, [[0, 1, 2], [0, 1]]))
        message = refused("ply", mesh(form, [[0, 1, 2.5]], index="float"))
        assert "the list vertex_indices holds something that is not a whole number" in message
