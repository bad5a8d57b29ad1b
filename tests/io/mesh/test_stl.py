"""STL: binary and text, told apart by their content, not by the first word."""

import numpy as np
import pytest

# A tetrahedron of volume 1/6, wound outwards.
CORNERS = np.eye(4)[:, 1:][[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]]
ROW = [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")]


def binary(header=b"", count=None, normal=0.0):
    rows = np.zeros(len(CORNERS), ROW)
    rows["corners"], rows["normal"], rows["attributes"] = CORNERS, normal, 0x7FFF
    count = len(rows) if count is None else count
    return header.ljust(80, b"\0")[:80] + count.to_bytes(4, "little") + rows.tobytes()


def text(name="tetrahedron", normal="0 0 0"):
    lines = [f"solid {name}"]
    for triangle in CORNERS:
        lines += [f"  facet normal {normal}", "    outer loop"]
        lines += [f"      vertex {x:e} {y:e} {z:e}" for x, y, z in triangle] + ["    endloop", "  endfacet"]
    return "\n".join([*lines, f"endsolid {name}", ""])


def assert_tetrahedron(loaded, solids=1):
    assert len(loaded.mesh.faces) == 4 * solids and loaded.volume == pytest.approx(solids / 6)
    assert loaded.mesh.normals is None and loaded.mesh.uv is None


@pytest.mark.parametrize("normal", [0, 1, np.nan])
@pytest.mark.parametrize("header", [b"", b"solid", b"solid caf\xe9\nfacet normal 0 0 1\nouter loop\n", b"\xff" * 80])
def test_binary_whatever_its_header_and_normals(load, header, normal):
    loaded = load("stl", binary(header, normal=normal))
    assert_tetrahedron(loaded)
    assert loaded.notes == []


@pytest.mark.parametrize("behind", [b"\n", b"\0", b"\0" * 50, b"made by caf\xe9", bytes(range(256)) * 4])
@pytest.mark.parametrize("header", [b"", b"solid"])
def test_bytes_behind_the_triangles_are_noted(load, header, behind):
    loaded = load("stl", binary(header) + behind)
    assert_tetrahedron(loaded)
    assert any(f"{len(behind)} bytes behind its 4 triangles" in note for note in loaded.notes)


@pytest.mark.parametrize(
    "content",
    [
        text(),
        text("facet normal vertex 1 2 3"),
        text(""),
        text(normal="nan nan nan"),
        text(normal="-1.#IND 0 0"),
        text().upper(),
        text().replace("\n", "\r\n"),
        text().replace("\n", "\r"),
        text().replace(" ", "\t"),
        text().replace("\n", "\n\n"),
        text("caf\xe9").encode("latin-1"),
        "\ufeff" + text(),
        text().encode("utf-16"),
        text().replace("endsolid tetrahedron", ""),
        "\n " + text() + " \n\0".replace("\0", " "),
    ],
)
def test_text_however_it_is_written(load, content):
    assert_tetrahedron(load("stl", content))


def test_several_solids_of_one_text_are_one_mesh(load):
    assert_tetrahedron(load("stl", text("a") + text("b") + text("a")), solids=3)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (binary(count=5), "the file ends after 4 of 5 triangles"),
        (binary(b"solid", count=5), "the file ends after 4 of 5 triangles"),
        (binary()[:-1], "the file ends after 3 of 4 triangles"),
        (binary(count=0), "the mesh is empty"),
        (b"\0" * 83, "too short to be binary"),
        (text().replace("1.0", "x.0"), "cannot be read as STL"),
        (text().replace("1.000000e+00", "nan"), "is not finite"),
        (text().replace("endloop", "vertex 1 1 1\nendloop"), "facets have three vertices each"),
        (text().replace("outer", "inner"), '"inner" for "outer"'),
        (text()[:-40], "facets have three vertices each"),
        ("solid a\nendsolid a\n", "the mesh is empty"),
    ],
)
def test_what_is_no_stl_is_refused(refused, content, words):
    assert words in refused("stl", content)
