"""Keys of the compiled programs of fits: scenes share programs if everything compiled into them is the same."""

import jax
import numpy as np
import pytest

import pathjax as pj
from pathjax.inverse import problem

COLORS = np.linspace(0.2, 0.8, 15).reshape(5, 3)


def sheet(order=(0, 1, 2, 3, 4), name="sheet"):
    """Return a scene of a mesh of two triangles and a vertex that neither uses, the fifth in `order`."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 5]], float)
    paint = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    faces = np.asarray(order)[[[0, 1, 2], [0, 2, 3]]]
    mesh = {"type": "mesh", "id": name, "vertices": corners[np.argsort(order)], "faces": faces, "bsdf": paint}
    film = {"type": "hdrfilm", "width": 2, "height": 2}
    view = {"type": "perspective", "to_world": pj.Transform().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]), "film": film}
    return pj.load_dict(
        {"type": "scene", "sheet": mesh | {"vertex_color": COLORS}, "sky": {"type": "constant"}, "view": view}
    )


def groups(*scenes, names=("sheet.vertex_color",)):
    return problem.build(list(scenes), [np.full((2, 2, 3), 0.5)] * len(scenes), names, {}).groups


def structure(scene):
    (views,) = groups(scene)
    return jax.tree.structure(views)


def test_a_scene_loaded_again_has_the_same_structure():
    assert structure(sheet()) == structure(sheet())


def test_meshes_of_as_many_vertices_have_colours_at_other_corners():
    one, other = sheet(), sheet([4, 1, 2, 3, 0])
    assert structure(one) != structure(other)
    assert len(groups(one, other)) == 2


def test_views_are_one_group_whatever_else_their_scenes_hold():
    assert len(groups(sheet(), sheet())) == 1


if __name__ == "__main__":
    pytest.main([__file__])
