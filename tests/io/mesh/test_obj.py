"""OBJ: lines are read in every way to write them; a line with other content is refused by its number."""

import numpy as np
import pytest

SQUARE = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"


def assert_square(loaded):
    assert loaded.area == pytest.approx(4) and loaded.area_vectors.sum(axis=0) == pytest.approx([0, 0, 4])
    assert loaded.uv_areas.sum() == pytest.approx(-1)  # v is flipped
    assert len(loaded.mesh.vertices) == 4 and loaded.notes == []


@pytest.mark.parametrize("line", ["# comment", "usemtl wood", "g wood", "o wood", "mtllib C:\\lost", "s 1"])
@pytest.mark.parametrize("place", range(11))
def test_a_backslash_behind_a_comment_or_a_name_swallows_nothing(load, line, place):
    lines = SQUARE.split("\n")
    lines.insert(place, line + "\\")
    assert_square(load("obj", "\n".join(lines)))


def test_lines_of_numbers_and_of_names_are_continued(load):
    assert_square(load("obj", "g one \\\ntwo\\\nthree\n" + SQUARE.replace(" ", " \\\n ").replace("/", "/")))
    assert_square(load("obj", SQUARE.rstrip() + "\\"))


def test_lines_are_counted_as_in_the_file(refused):
    assert "mesh.obj:9: " in refused(
        "obj", "g a\\\nb # c\\\nv 0 \\\n0 \\\n0\r\nusemtl x\\\nv 1 0 0\nv 0 1 0\nf 1 2 4\n"
    )
    assert "mesh.obj:3: " in refused("obj", "v 0 0 0\rv 1 0 0\rv 0 1 x\rf 1 2 3\r")


@pytest.mark.parametrize(
    "change",
    [
        lambda text: "\ufeff" + text,
        lambda text: text.encode("utf-16"),
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\r"),
        lambda text: text.replace(" ", "\t \t"),
        lambda text: text.replace("\n", "  \n\n\t"),
        lambda text: text.replace("\n", " # f 1 2 3\n#\n"),
        lambda text: text.replace("\n", "# v 1 1\n"),
        lambda text: ("o caf\xe9\nusemtl \xa0\n" + text).encode("latin-1"),
        lambda text: "mtllib nowhere.mtl\nl 1 2\np 3\nmg 1 0.5\ng\no\n" + text,
        lambda text: text.rstrip(),
        lambda text: text.replace("v 2 2 0", "v +2.0 2e0 -0.0"),
        lambda text: "".join(line + " 1 0.5 0.2\n" * line.startswith("v ") + "\n" for line in text.split("\n")),
        lambda text: "".join(line + " 1" * line.startswith(("v ", "vt ")) + "\n" for line in text.split("\n")),
        lambda text: text.replace("f 1/1 3/3 4/4", "f -4/-4 -2/-2 -1/-1"),
        lambda text: text.replace("f 1/1 3/3 4/4", "f 1/1 3/-2 4/4/"),
        lambda text: text + "v 9 9 9\nvn 0 0 1\nvt 5 5\n",
    ],
)
def test_every_way_to_write_a_square(load, change):
    assert_square(load("obj", change(SQUARE)))


def test_indices_may_come_before_what_they_name(load):
    lines = SQUARE.split("\n")
    assert_square(load("obj", "\n".join(lines[8:] + lines[:8])))


def test_negative_indices_of_each_kind_count_from_their_line(load):
    """Two groups, each with its own vertices, uv and normals."""
    group = "v {0} 0 0\nv {0} 1 0\nv {0} 0 1\nvt 0.{0} 0\nvn {1} 0 0\nf -3/-1/-1 -2/-1/-1 -1/-1/-1\n"
    loaded = load("obj", group.format(1, 1) + group.format(2, -1), flip_tex_coords=False)
    np.testing.assert_array_equal(loaded.corners[:, :, 0], [[1] * 3, [2] * 3])
    np.testing.assert_allclose(loaded.mesh.uv[loaded.mesh.faces][:, :, 0], [[0.1] * 3, [0.2] * 3])
    np.testing.assert_array_equal(loaded.mesh.normals[loaded.mesh.faces][:, :, 0], [[1] * 3, [-1] * 3])


def test_uv_or_normals_on_some_faces_alone_do_not_shift_the_others(load):
    text = SQUARE.replace("f 1/1 3/3 4/4", "vn 0 0 2\nf 1 3 4\nf 1//1 2//1 3//1\nf 1/1/1 2/2/1 3/3/1")
    loaded = load("obj", text, flip_tex_coords=False)
    uv = loaded.mesh.uv[loaded.mesh.faces]
    np.testing.assert_array_equal(uv[[0, 3]], [[[0, 0], [1, 0], [1, 1]]] * 2)
    assert (uv[[1, 2]] == 0).all()
    np.testing.assert_allclose(loaded.mesh.normals, [[0, 0, 1]] * len(loaded.mesh.normals))
    assert any("6 vertices without texture coordinates" in note for note in loaded.notes)
    assert any("without a normal" in note for note in loaded.notes)


def test_corners_that_differ_in_one_index_are_vertices_of_their_own(load):
    loaded = load("obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 1\nvn 0 0 1\nvn 0 1 1\n"
                  "f 1/1/1 2/1/1 3/1/1\nf 1/2/1 2/1/1 3/1/2\nf 1/1/1 2/1/1 3/1/2\n")  # fmt: skip
    np.testing.assert_array_equal(loaded.mesh.faces, [[0, 1, 2], [3, 1, 4], [0, 1, 4]])


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("vt 1.#QNAN 0", "could not convert"),
        ("v 0,5 0 0", "could not convert"),
        ("v 1-2 3", "could not convert"),
        ("v 0 0 0 red", "could not convert"),
        ("vt", "vt has too few numbers"),
        ("f 1 2 3.5", "invalid literal"),
        ("f 1 2-3", "invalid literal"),
        ("f 1 2 a", "invalid literal"),
        ("f 1 2 /3", "is no corner of a face"),
        ("f 1/1/1/1 2 3", "is no corner of a face"),
        ("f 1/0 2/1 3/1", "indices count from 1"),
        ("f", "a face of 0 vertices"),
        ("f 1 2", "a face of 2 vertices"),
        ("f 1 2 99999999999999999999", "does not exist; there are 4"),
        ("f 1 2 -5", "v -5 does not exist; there are 4"),
        ("f 1/1 2/2 3/5", "vt 5 does not exist; there are 4"),
        ("f 1//1 2//1 3//1", "vn 1 does not exist; there are 0"),
        ("fo 1 2 3", '"fo" is not supported'),
        ("surf 0 1 0 1 1 2 3 4", '"surf" is not supported'),
        ("call other.obj", '"call" is not supported'),
    ],
)
def test_a_line_that_says_something_else_is_refused_by_its_number(refused, line, words):
    message = refused("obj", SQUARE + line + "\nusemtl last\n")
    assert "mesh.obj:11: " in message and words in message
