"""The pages are short, link to each other, and describe everything that a user can name."""

from __future__ import annotations

import re
import struct
import zlib

import numpy as np
import pytest

import pathjax as pj
from pathjax.cli import main
from pathjax.errors import InputError
from pathjax.media.gridvolume import write_vol

MOST_LINES = 150
LINK = re.compile(r"\[[^]]*\]\(([^)]+)\)")
CODE = re.compile(r"```.*?```|`[^`\n]+`", re.DOTALL)


def table(root, name):
    """Return the first two cells of each row of the tables of a page."""
    text = (root / "pathjax" / "manual" / f"{name}.md").read_text(encoding="utf-8")
    return re.findall(r"^\| (`.*?) \| (.*?) \|", text, re.MULTILINE)


@pytest.fixture
def usage(capsys):
    """(command) -> the output of its `--help`."""

    def usage(*command):
        with pytest.raises(SystemExit):
            main([*command, "--help"])
        return capsys.readouterr().out

    return usage


def test_a_page_is_short(page):
    assert len(page.read_text(encoding="utf-8").splitlines()) <= MOST_LINES


def test_links_lead_somewhere(page):
    links = LINK.findall(page.read_text(encoding="utf-8"))
    assert links or page.stem not in ("README", "lanes")
    assert not [link for link in links if not (page.parent / link).is_file()]


def test_a_page_can_be_reached_from_the_readme(page, root):
    text = (root / "README.md").read_text(encoding="utf-8")
    assert page.stem == "README" or f"(pathjax/manual/{page.name})" in text


def test_public_names_are_described(all_text):
    code = " ".join(CODE.findall(all_text))
    assert not [name for name in pj.__all__ if not re.search(rf"\bpj\.{name}\b", code)]


def test_commands_and_options_are_described(root, usage):
    """The page of commands describes them and says to which command an option belongs."""
    described = table(root, "commands")
    commands = re.findall(r"^    (\w+) ", usage(), re.MULTILINE)
    assert "render" in commands
    for command in commands:
        assert any(row.startswith(f"`pathjax {command} ") for row, _ in described)
        options = set(re.findall(r"(?<=^  )-[\w-]+|(?<=, )--[\w-]+", usage(command), re.MULTILINE)) - {"-h", "--help"}
        listed = [row for commands, row in described if f"`{command}`" in commands]
        assert options == set(re.findall(r"(?<=`)--?[A-Za-z][\w-]*", " ".join(listed))), command


# ---- the page of scenes against the loader -----------------------------------------------------------------------

# Where a kind stands, with the elements that it needs around it; {} is the element itself.
PLACES = {
    "integrator": '{}<sensor type="perspective"/>',
    "sensor": "{}",
    "film": '<sensor type="perspective">{}</sensor>',
    "rfilter": '<sensor type="perspective"><film type="hdrfilm">{}</film></sensor>',
    "sampler": '<sensor type="perspective">{}</sensor>',
    "shape": '<sensor type="perspective"/>{}',
    "bsdf": '<sensor type="perspective"/><shape type="cube">{}</shape>',
    "texture": '<sensor type="perspective"/><shape type="cube"><bsdf type="diffuse">{}</bsdf></shape>',
    "emitter": '<sensor type="perspective"/>{}',
    "medium": '<sensor type="perspective">{}</sensor>',
    "phase": '<sensor type="perspective"><medium type="homogeneous">{}</medium></sensor>',
    "volume": '<sensor type="perspective"><medium type="homogeneous">{}</medium></sensor>',
    "area light": '<sensor type="perspective"/><shape type="cube">{}</shape>',
}
MESHES = ("obj", "ply", "stl", "glb", "gltf", "serialized")
# Contents without which an element is not read; alternatives where one excludes the other.
NEEDS = {
    **dict.fromkeys(("perspective", "projector"), ["", '<float name="fov" value="40"/>']),
    "thinlens": [f'<float name="aperture_radius" value="1"/>{fov}' for fov in ("", '<float name="fov" value="40"/>')],
    "batch": ['<sensor type="perspective"/>'],
    "instance": ['<shape type="shapegroup"/>'],
    **dict.fromkeys(
        ("radiancemeter", "distant", "irradiancemeter"),
        ['<film type="hdrfilm"><integer name="width" value="1"/><integer name="height" value="1"/></film>'],
    ),
    **dict.fromkeys(("uniform", "constvolume"), ['<float name="value" value="1"/>']),
    "gridvolume": ['<string name="filename" value="grid.vol"/>'],
    "mesh_attribute": ['<string name="name" value="vertex_color"/>'],
    **dict.fromkeys(("bitmap", "envmap"), ['<string name="filename" value="marks.png"/>']),
    **dict.fromkeys(("twosided", "mask"), ['<bsdf type="diffuse"/>']),
    "blendbsdf": ['<bsdf type="diffuse"/><bsdf type="diffuse"/><float name="weight" value="0.5"/>'],
    "tabphase": ['<string name="values" value="1, 2"/>'],
    "blendphase": ['<phase type="isotropic"/><phase type="hg"/><float name="weight" value="0.5"/>'],
    "bumpmap": ['<bsdf type="diffuse"/><texture type="checkerboard"/>'],
    "normalmap": ['<bsdf type="diffuse"/><rgb name="normalmap" value="0.5, 0.5, 1"/>'],
    **dict.fromkeys(("aov", "moment", "stokes"), ['<integrator type="path"/>']),
} | {kind: [f'<string name="filename" value="mesh.{kind}"/>'] for kind in MESHES}

# One triangle, in the only format that trimesh cannot write.
SERIALIZED = b"\x1c\x04\x03\x00" + zlib.compress(
    struct.pack("<IQQ", 0x1000, 3, 1) + struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) + struct.pack("<3I", 0, 1, 2)
)


@pytest.fixture(scope="module")
def refusal(root, tmp_path_factory):
    """(place, type, content) -> the message that refuses a scene with such an element."""
    import trimesh

    folder = tmp_path_factory.mktemp("kinds")
    (folder / "marks.png").write_bytes((root / "tests" / "scenes" / "textures" / "marks.png").read_bytes())
    (folder / "mesh.serialized").write_bytes(SERIALIZED)
    write_vol(folder / "grid.vol", np.ones((1, 1, 1, 1)))
    for kind in MESHES[:-1]:
        mesh = trimesh.creation.box()
        if kind == "gltf":
            for name, data in mesh.export(file_type="gltf").items():
                (folder / ("mesh.gltf" if name.endswith(".gltf") else name)).write_bytes(data)
        else:
            mesh.export(folder / f"mesh.{kind}")

    def refusal(place, kind, inside=""):
        if kind == "mesh":  # files cannot hold its arrays
            shape = {"type": "mesh", "vertices": np.eye(3), "faces": [[0, 1, 2]], "unknown": 1.0}
            with pytest.raises(InputError) as error:
                pj.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "shape": shape})
            return str(error.value)
        tag = "emitter" if place == "area light" else place
        name = {"texture": ' name="reflectance"', "volume": ' name="albedo"'}.get(tag, "")
        element = f'<{tag} type="{kind}"{name}>{inside}</{tag}>'
        if kind == "irradiancemeter":
            element = f'<shape type="disk">{element}</shape>'
        file = folder / "scene.xml"
        file.write_text(f'<scene version="3.0.0">{PLACES[place].format(element)}</scene>')
        with pytest.raises(InputError) as error:
            pj.load_scene(file)
        return str(error.value)

    return refusal


@pytest.fixture(scope="module")
def described(root):
    """Kind -> names of its parameters on the page; "the same" refers to the row above."""
    kinds, names = {}, set()
    for which, parameters in table(root, "scenes"):
        names = set(re.findall(r"`(\w+)`", parameters)) | (names if "the same" in parameters else set())
        kinds |= dict.fromkeys(re.findall(r"`(\w+)`", which), names)
    return kinds


@pytest.mark.parametrize("place", PLACES)
def test_kinds_and_parameters_of_scene_files_are_described(place, described, refusal):
    kinds = re.search(r"use one of ([\w, ]+)", refusal(place, "none"))[1].split(", ")
    for kind in kinds:
        names = set()
        for needs in NEEDS.get(kind, [""]):
            message = refusal(place, kind, needs + '<float name="unknown" value="1"/>')
            names |= set(re.search(r"it has: ([\w, ]+)", message)[1].split(", "))
        assert described[kind] == names - {"none", "flip_normals", "silhouette_sampling_weight"}, kind


@pytest.mark.parametrize("scene", ["glass_and_mirror", "cornell_box"])
def test_parameters_are_described(scene, root):
    described = {name for _, names in table(root, "parameters") for name in re.findall(r"`(\w+)`", names)}
    assert {
        name.rpartition(".")[2] for name in pj.parameters(pj.load_scene(root / "scenes" / f"{scene}.xml"))
    } <= described
