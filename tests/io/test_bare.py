"""Bare meshes become scenes that show them whole, lit, and in their own colours."""

from dataclasses import replace

import jax
import numpy as np
import pytest
import trimesh

import pathjax as pj
from pathjax.io import bare


@pytest.fixture
def ball(tmp_path):
    """(format, mesh) -> path of a file with the mesh."""

    def write(kind, mesh):
        mesh.export(tmp_path / f"ball.{kind}")
        return tmp_path / f"ball.{kind}"

    return write


# A mesh without normals (STL) has another kernel but the same place in view, so it is slow.
@pytest.mark.parametrize(
    ("kind", "size"), [("obj", 1e-4), ("ply", 1), ("PLY", 1e4), pytest.param("stl", 1, marks=pytest.mark.slow)]
)
def test_a_mesh_is_in_view_as_a_whole_whatever_its_size(ball, kind, size):
    mesh = trimesh.creation.icosphere(2, size)
    mesh.apply_translation([5 * size, -2 * size, size])
    scene = pj.load_scene(ball(kind, mesh), res=32)
    seen = np.asarray(pj.render_aovs(scene, ["depth"], spp=4)["depth"]).reshape(24, 32)
    # The filter spreads samples to the pixels around their own, where they count less than half.
    hit = seen > seen.max() / 2
    assert hit[12, 16]
    assert not (hit[0].any() or hit[-1].any() or hit[:, 0].any() or hit[:, -1].any())
    # The bounding sphere of the ball's box fills the height, and the ball 1/sqrt(3) of it.
    assert 0.5 < hit.any(axis=1).mean() < 0.72


def test_it_is_lit_from_everywhere_and_grey(ball):
    scene = pj.load_scene(ball("stl", trimesh.creation.icosphere(3)), res=16)
    assert set(pj.parameters(scene)) == {"mesh.reflectance", "sky.radiance"}


def test_colours_of_vertices_are_its_own(ball):
    mesh = trimesh.creation.icosphere(2)
    mesh.visual.vertex_colors = [51, 102, 204, 255]
    scene = pj.load_scene(ball("ply", mesh), res=16)
    image = np.asarray(pj.render(scene, spp=16))
    # In a furnace a convex object shows its albedo, up to the noise of the filter's weights.
    assert image[6, 8] == pytest.approx([0.2, 0.4, 0.8], rel=1e-2)
    assert image[0, 0] == pytest.approx([1, 1, 1], rel=1e-2)


def test_notes_say_what_was_added(ball):
    notes = pj.load_scene(ball("stl", trimesh.creation.box())).about.description.notes
    assert any("has no camera" in note for note in notes) and any("has no light" in note for note in notes)


def test_a_file_that_holds_nothing_to_see_is_refused(tmp_path):
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    with pytest.raises(pj.InputError, match=r"empty\.obj"):
        pj.load_scene(tmp_path / "empty.obj")
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 1 1\nv 2 2 2\nf 1 2 3\n")
    with pytest.raises(pj.InputError, match=r"flat\.obj.*no triangle"):
        pj.load_scene(tmp_path / "flat.obj")


@pytest.mark.parametrize("suffix", sorted(bare.SUFFIXES))
def test_a_file_that_is_not_there_is_said_to_be_missing(tmp_path, suffix):
    with pytest.raises(pj.InputError, match=rf"nothing\{suffix}: no such file$"):
        pj.load_scene(tmp_path / f"nothing{suffix}")
    (tmp_path / f"folder{suffix}").mkdir()
    with pytest.raises(pj.InputError, match="not a file$"):
        pj.load_scene(tmp_path / f"folder{suffix}")


def test_a_saved_mesh_is_the_same_scene(ball, tmp_path):
    mesh = trimesh.creation.icosphere(2)
    mesh.visual.vertex_colors = np.random.default_rng(1).integers(0, 256, (len(mesh.vertices), 4))
    scene = pj.load_scene(ball("ply", mesh), res=16)
    pj.save_scene(scene, tmp_path / "saved.xml")
    again = pj.load_scene(tmp_path / "saved.xml")
    jax.tree.map(np.testing.assert_array_equal, *(replace(each, about=None) for each in (scene, again)))


def test_every_suffix_is_a_format_that_can_be_read():
    assert {suffix[1:] for suffix in bare.SUFFIXES} <= set(bare.mesh.READERS)
