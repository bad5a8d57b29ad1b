"""For any bytes in a file, a loader returns or raises InputError; nothing else escapes, and nothing hangs."""

import re
import zlib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from pathjax.description import Description
from pathjax.errors import InputError
from pathjax.images import read_exr, read_rgb, write_exr, write_png
from pathjax.io import mesh
from pathjax.io.mitsuba.loader import load
from pathjax.shapes import Mesh

SCENE = """<?xml version="1.0"?>
<scene version="3.0.0">
  <default name="res" value="8"/>
  <default name="color" value="0.1, 0.2, 0.3"/>
  <integrator type="moment"><integer name="block_size" value="8"/>
    <integrator type="path"><integer name="max_depth" value="4"/><integer name="rr_depth" value="5"/></integrator>
  </integrator>
  <sensor type="thinlens">
    <float name="fov" value="40"/><string name="fov_axis" value="smaller"/>
    <float name="aperture_radius" value="0.1"/><float name="focus_distance" value="3"/>
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/><rotate x="1" angle="5"/></transform>
    <film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="$res"/>
      <rfilter type="gaussian"><float name="stddev" value="0.4"/></rfilter></film>
    <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
  </sensor>
  <texture type="bitmap" id="picture"><string name="filename" value="picture.png"/>
    <transform name="to_uv"><scale x="2" y="3"/></transform></texture>
  <bsdf type="twosided" id="wall"><bsdf type="diffuse"><ref name="reflectance" id="picture"/></bsdf></bsdf>
  <alias id="metal" as="tin"/>
  <bsdf type="conductor" id="metal"><rgb name="eta" value="1"/><spectrum name="k" value="2"/></bsdf>
  <shape type="sphere" id="ball"><point name="center" x="0" y="1" z="2"/><float name="radius" value="0.5"/>
    <bsdf type="dielectric"><string name="int_ior" value="water"/></bsdf></shape>
  <shape type="rectangle"><ref id="wall"/><emitter type="area"><rgb name="radiance" value="$color"/></emitter></shape>
  <shape type="obj"><string name="filename" value="mesh.obj"/><boolean name="face_normals" value="false"/>
    <transform name="to_world"><matrix value="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/></transform><ref id="tin"/></shape>
  <shape type="shapegroup" id="group">
    <shape type="cylinder"><point name="p0" value="1, 2, 3"/><float name="radius" value="0.5"/></shape>
    <shape type="ply"><string name="filename" value="mesh.ply"/><bsdf type="diffuse">
      <texture type="mesh_attribute" name="reflectance"><string name="name" value="vertex_color"/></texture></bsdf>
    </shape>
  </shape>
  <shape type="instance"><ref id="group"/><transform name="to_world"><scale value="2"/></transform></shape>
  <emitter type="constant"><spectrum name="radiance" value="400:1, 500:2 600:3"/></emitter>
  <emitter type="constant"><spectrum name="radiance" type="d65"><float name="scale" value="2"/></spectrum></emitter>
  <emitter type="point"><point name="position" x="0" y="1" z="2"/><spectrum name="intensity" value="3"/></emitter>
  <emitter type="spot"><float name="cutoff_angle" value="30"/><float name="beam_width" value="20"/>
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform></emitter>
  <emitter type="directional"><vector name="direction" value="1, -2, 0"/></emitter>
  <include filename="part.xml"/>
</scene>
"""

PLY_COLORS = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nproperty uchar r\n"
    "property uchar g\nproperty uchar b\nelement face 1\nproperty list uchar int vertex_indices\nproperty float w_0\n"
    "end_header\n0 0 0 9 8 7\n1 0 0 6 5 4\n0 1 0 3 2 1\n3 0 1 2 0.5\n"
)
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nproperty float u\n"
    "property float v\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0 0 0\n1 0 0 0 0\n0 1 0 0 0\n3 0 1 2\n"
)
STL = b"\0" * 80 + b"\1\0\0\0" + np.array([[0, 0, 1], [0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes() + b"\0\0"
GLTF = (
    '{"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, "scale": [1, 1, 1]}],'
    '"meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}], "bufferViews": [{"buffer": 0, "byteLength": 36}],'
    '"accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}], "buffers": [{'
    '"byteLength": 36, "uri": "data:application/octet-stream;base64,'
    'AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD8AAAAA"}]}'
)
PLY_BINARY = (
    b"ply\nformat binary_big_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 2\nproperty uchar flag\nproperty list uchar int vertex_indices\nend_header\n"
    + np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], ">f4").tobytes()
    + b"".join(bytes([9, len(face)]) + np.array(face, ">i4").tobytes() for face in ([0, 1, 2, 3], [2, 1, 0]))
)
PLY_STRIPS = PLY.replace("element face", "element tristrips").replace("3 0 1 2", "7 0 1 2 -1 2 1 0")
OBJ_ODD = "\ufeffo a\\\r\nv 0 0 0\rv 2 0 0 # \\\nv 1 0.5 \\\n 0\nv 0 2 0 1 1 1\nvt 0\nvn 0 0 1\nf 1/1 -3 3//1 4/1/1\n"
STL_TEXT = (
    "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid a\n"
)
GLTF_SPARSE = GLTF.replace(
    '"type": "VEC3"}',
    '"type": "VEC3", "sparse": {"count": 1, "indices": {"bufferView": 0, "byteOffset": 12, "componentType": 5121},'
    '"values": {"bufferView": 0}}}',
).replace('"POSITION": 0}', '"POSITION": 0}, "mode": 5')
SERIALIZED = b"\x1c\x04\x03\x00" + zlib.compress(
    np.array([0x1000, 3, 0, 1, 0], "<u4").tobytes()
    + np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], "<f4").tobytes()
    + np.arange(3, dtype="<u4").tobytes(),
    level=0,  # so that damage reaches the values themselves
)
MESHES = {
    "obj": ("obj", OBJ.encode(), 1),
    "obj with odd lines": ("obj", OBJ_ODD.encode(), 2),
    "ply": ("ply", PLY.encode(), 1),
    "ply of colours": ("ply", PLY_COLORS.encode(), 1),
    "binary ply of a quad and a triangle": ("ply", PLY_BINARY, 3),
    "ply of strips": ("ply", PLY_STRIPS.encode(), 2),
    "stl": ("stl", STL, 1),
    "text stl": ("stl", STL_TEXT.encode(), 1),
    "gltf": ("gltf", GLTF.encode(), 1),
    "sparse gltf of a strip": ("gltf", GLTF_SPARSE.encode(), 1),
    "serialized": ("serialized", SERIALIZED, 1),
}

WORDS = ["", "nan", "-1", "0", "1e999", "1e38", "true", "x", "$res", "$none", "ball", "wall", "diffuse", "\u0660"]
TAGS = "scene shape bsdf texture emitter sensor film float integer rgb ref transform scale include default path z"
KEYS = ["type", "id", "name", "value", "x", "filename", "foo"]


def quickly(examples: int):
    return settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    )


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "mesh.obj").write_text(OBJ)
    (tmp_path / "mesh.ply").write_text(PLY_COLORS)
    (tmp_path / "part.xml").write_text('<scene version="3.0.0"/>')
    write_png(tmp_path / "picture.png", np.full((2, 2, 3), 0.5))
    return tmp_path


def load_or_refuse(folder, content: bytes) -> Description | None:
    (folder / "scene.xml").write_bytes(content)
    try:
        return load(folder / "scene.xml")
    except InputError as error:
        assert "\n" not in str(error) and re.search(r"\.(xml|png|obj|ply)", str(error)), error
        return None


@st.composite
def mutated_scene(draw) -> str:
    """The scene with a few attributes, tags, or whole elements changed, doubled or removed."""
    text = SCENE
    for _ in range(draw(st.integers(1, 3))):
        attributes = list(re.finditer(r'(\w+)="([^"]*)"', text))
        tags = list(re.finditer(r"<(/?)(\w+)", text))
        elements = list(re.finditer(r"<\w+[^<>]*/>", text))
        kind = draw(st.sampled_from(["value", "key", "tag", "remove", "double", "move"]))
        if kind in ("value", "key"):
            match = draw(st.sampled_from(attributes))
            value = draw(st.sampled_from(WORDS) | st.text("0123456789.-+e ,", max_size=12)) if kind == "value" else None
            new = f'{match[1]}="{value}"' if kind == "value" else f'{draw(st.sampled_from(KEYS))}="{match[2]}"'
        elif kind == "tag":
            match = draw(st.sampled_from(tags))
            new = f"<{match[1]}{draw(st.sampled_from(TAGS.split()))}"
        elif elements:
            match = draw(st.sampled_from(elements))
            new = {"remove": "", "double": match[0] * 2, "move": draw(st.sampled_from(elements))[0]}[kind]
        text = text[: match.start()] + new + text[match.end() :]
    return text


@st.composite
def damaged(draw, data: bytes) -> bytes:
    """Data with a few bytes replaced, inserted, or cut off."""
    piece = st.binary(max_size=6) | st.sampled_from([b"9999999", b"-1", b" nan ", b"\n"])
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data)))
        until = draw(st.sampled_from([at, at + 1, at + 4, len(data)]))
        data = data[:at] + draw(piece) + data[until:]
    return data


def test_the_unchanged_files_load(folder):
    assert load_or_refuse(folder, SCENE.encode()) is not None
    for kind, data, triangles in MESHES.values():
        (folder / f"m.{kind}").write_bytes(data)
        assert len(mesh.load(folder / f"m.{kind}", kind, np.eye(4))[0].faces) == triangles


@quickly(400)
@given(text=mutated_scene())
def test_mutated_scenes_load_or_are_refused(folder, text):
    load_or_refuse(folder, text.encode())


@quickly(150)
@given(data=damaged(SCENE.encode()))
def test_damaged_scenes_load_or_are_refused(folder, data):
    load_or_refuse(folder, data)


@quickly(50)
@given(data=st.binary(max_size=100))
def test_random_bytes_are_no_scene(folder, data):
    assert load_or_refuse(folder, data) is None


@pytest.mark.parametrize("name", MESHES)
@quickly(120)
@given(data=st.data())
def test_damaged_meshes_load_sound_or_are_refused(folder, name, data):
    kind, content, _ = MESHES[name]
    (folder / f"m.{kind}").write_bytes(data.draw(damaged(content) | st.binary(max_size=200)))
    try:
        made, notes = mesh.load(folder / f"m.{kind}", kind, np.eye(4))
    except InputError as error:
        assert f"m.{kind}" in str(error)
        return
    assert isinstance(made, Mesh) and np.isfinite(made.vertices).all()
    if not len(made.faces):
        assert any("degenerate" in note for note in notes)
        return
    assert 0 <= made.faces.min() <= made.faces.max() < len(made.vertices)
    if made.normals is not None:
        np.testing.assert_allclose(np.linalg.norm(made.normals, axis=1), 1, rtol=1e-6)
    assert made.uv is None or made.uv.shape == (len(made.vertices), 2)


@pytest.mark.parametrize("suffix", ["exr", "png", "jpg", "bmp", "tga", "hdr"])
@quickly(120)
@given(data=st.data())
def test_damaged_images_load_or_are_refused(folder, suffix, data):
    path = folder / f"i.{suffix}"
    if suffix == "exr":
        write_exr(path, {name: np.full((3, 4), 0.5) for name in "RGB"}, {})
    elif suffix == "hdr":
        path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 2\n" + bytes((200, 100, 50, 129, 0, 0, 0, 0)))
    else:
        Image.fromarray(np.full((3, 4, 3), 128, np.uint8)).save(path)
    path.write_bytes(data.draw(damaged(path.read_bytes()) | st.binary(max_size=100)))
    for read in (read_rgb, read_exr) if suffix == "exr" else (read_rgb,):
        try:
            read(path)
        except InputError as error:
            assert str(path) in str(error)
