"""glTF files become the scenes that they describe (materials, textures, cameras, lights); notes list omissions."""

import io
import json
import math
import struct
from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

import pathjax as pj
from pathjax.io import bare, gltf

CORNERS = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], "<f4")
UV = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], "<f4")
FACES = np.array([0, 1, 2, 0, 2, 3], "<u2")
CODES = {"<f4": 5126, "<u2": 5123, "|u1": 5121}
PIXELS = np.random.default_rng(1).integers(0, 256, (4, 6, 4)).astype(np.uint8)


class Gltf:
    """A glTF file of a square in the xy plane with one material."""

    def __init__(self, material=(), **header):
        self.data = b""
        self.header = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": [], "images": [], "textures": []}
        attributes = {"POSITION": self.accessor(CORNERS), "TEXCOORD_0": self.accessor(UV)}
        self.primitive = {"attributes": attributes, "indices": self.accessor(FACES), "material": 0}
        self.header |= {
            "meshes": [{"primitives": [self.primitive]}],
            "materials": [dict(material)],
            "nodes": [{"mesh": 0, "name": "square"}],
            "scenes": [{"nodes": [0]}],
            **header,
        }

    def view(self, content):
        self.header["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)})
        self.data += content + b"\0" * (-len(content) % 4)
        return len(self.header["bufferViews"]) - 1

    def accessor(self, values, **more):
        kind = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
        made = {"bufferView": self.view(values.tobytes()), "type": kind, "count": len(values)}
        self.header["accessors"].append(made | {"componentType": CODES[values.dtype.str], **more})
        return len(self.header["accessors"]) - 1

    def texture(self, pixels=PIXELS, **more):
        """Add a texture and return its textureInfo."""
        encoded = io.BytesIO()
        Image.fromarray(pixels).save(encoded, "PNG")
        self.header["images"].append({"bufferView": self.view(encoded.getvalue()), "mimeType": "image/png"})
        self.header["textures"].append({"source": len(self.header["images"]) - 1, **more})
        return {"index": len(self.header["textures"]) - 1}

    def node(self, **node):
        self.header["nodes"].append(node)
        self.header["scenes"][0]["nodes"].append(len(self.header["nodes"]) - 1)

    def glb(self):
        header = {key: value for key, value in self.header.items() if value != []}
        text = json.dumps({**header, "buffers": [{"byteLength": len(self.data)}]}).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(self.data), b"BIN\0")
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks) + len(self.data)) + chunks + self.data


@pytest.fixture
def objects(tmp_path):
    """(file) -> objects and notes."""

    def objects(file):
        (tmp_path / "file.glb").write_bytes(file if isinstance(file, bytes) else file.glb())
        return gltf.scene(tmp_path / "file.glb")[:2]

    return objects


@pytest.fixture
def material(objects):
    """(file) -> the bsdf of its square, and notes."""

    def material(file):
        made, notes = objects(file)
        return made[made["square"]["bsdf"]["id"]], notes

    return material


@pytest.fixture
def write(tmp_path):
    """(file) -> its path."""

    def write(file):
        (tmp_path / "file.glb").write_bytes(file.glb())
        return tmp_path / "file.glb"

    return write


# ---- materials ----------------------------------------------------------------------------------------------------


def test_a_material_without_anything_is_that_of_the_format(material):
    bsdf, notes = material(Gltf())
    inner = bsdf["bsdf"]
    assert (bsdf["type"], inner["type"]) == ("twosided", "principled")
    assert (inner["roughness"], inner["metallic"]) == (1, 1)
    assert list(inner["base_color"]["value"]) == [1, 1, 1]
    assert not notes


def test_factors_are_linear_and_roughness_and_metalness_as_they_are(material):
    pbr = {"baseColorFactor": [0.5, 0.25, 0.125, 1], "roughnessFactor": 0.5, "metallicFactor": 0.25}
    extensions = {"KHR_materials_ior": {"ior": 1.25}}
    bsdf, _ = material(Gltf({"pbrMetallicRoughness": pbr, "extensions": extensions}))
    inner = bsdf["bsdf"]
    assert (inner["roughness"], inner["metallic"], inner["eta"]) == (0.5, 0.25, 1.25)
    assert list(inner["base_color"]["value"]) == [0.5, 0.25, 0.125]


def test_textures_keep_their_bytes_where_factors_are_1(material):
    file = Gltf()
    pbr = {"baseColorTexture": file.texture(), "metallicRoughnessTexture": file.texture()}
    file.header["materials"] = [{"pbrMetallicRoughness": pbr}]
    inner = material(file)[0]["bsdf"]
    np.testing.assert_array_equal(inner["base_color"]["data"], PIXELS[..., :3])
    np.testing.assert_array_equal(inner["roughness"]["data"], PIXELS[..., 1:2])
    np.testing.assert_array_equal(inner["metallic"]["data"], PIXELS[..., 2:3])
    assert not inner["base_color"]["raw"] and inner["roughness"]["raw"] and inner["metallic"]["raw"]


def test_factors_multiply_textures_in_linear_light(material):
    file = Gltf()
    pbr = {"baseColorTexture": file.texture(), "metallicRoughnessTexture": file.texture()}
    pbr |= {"baseColorFactor": [0.5, 0.25, 1, 1], "roughnessFactor": 0.5}
    file.header["materials"] = [{"pbrMetallicRoughness": pbr}]
    inner = material(file)[0]["bsdf"]
    linear = pj.images.srgb_to_linear(PIXELS[..., :3] / 255) * [0.5, 0.25, 1]
    np.testing.assert_allclose(inner["base_color"]["data"], linear, rtol=1e-6)
    np.testing.assert_allclose(inner["roughness"]["data"], PIXELS[..., 1:2] / 510, rtol=1e-6)
    assert inner["metallic"]["data"].dtype == np.uint8


def test_normal_maps_turn_the_shading(material):
    file = Gltf()
    flat = np.full((2, 2, 3), (255, 128, 128), np.uint8)
    file.header["materials"] = [{"normalTexture": file.texture(flat)}]
    turned = material(file)[0]["bsdf"]
    assert (turned["type"], turned["bsdf"]["type"]) == ("normalmap", "principled")
    np.testing.assert_array_equal(turned["normalmap"]["data"], flat)
    file.header["materials"][0]["normalTexture"]["scale"] = 0.5
    scaled = material(file)[0]["bsdf"]["normalmap"]["data"][0, 0] * 2 - 1
    assert np.linalg.norm(scaled) == pytest.approx(1)
    assert scaled[0] / scaled[2] == pytest.approx(0.5 * 255, rel=1e-4)


SHEET = {"KHR_materials_transmission": {"transmissionFactor": 0.75}}
TINTED = {"thicknessFactor": 1, "attenuationDistance": 2, "attenuationColor": [0.25, 0.5, 1]}
SOLID = {"KHR_materials_volume": TINTED}


@pytest.mark.parametrize(("thickness", "kind"), [(None, "principledthin"), (0, "principledthin"), (0.1, "principled")])
def test_glass_is_solid_where_it_has_a_thickness_and_a_sheet_elsewhere(material, thickness, kind):
    solid = {} if thickness is None else {"KHR_materials_volume": {"thicknessFactor": thickness}}
    pbr = {"metallicFactor": 0, "roughnessFactor": 0.1}
    bsdf, notes = material(Gltf({"pbrMetallicRoughness": pbr, "extensions": SHEET | solid}))
    assert (bsdf["type"], bsdf["spec_trans"], bsdf["roughness"]) == (kind, 0.75, 0.1)
    assert not notes


def test_solid_glass_absorbs_what_its_colour_lacks_over_the_distance(objects):
    made, notes = objects(Gltf({"extensions": SHEET | SOLID}))
    inside = made[made["square"]["interior"]["id"]]
    np.testing.assert_allclose(np.exp(-2 * inside["sigma_t"]["value"]), [0.25, 0.5, 1])
    assert (inside["type"], inside["albedo"]) == ("homogeneous", 0) and not notes


@pytest.mark.parametrize("extensions", [SOLID, SHEET, SHEET | SOLID | {"KHR_materials_ior": {"ior": 0}}])
def test_what_is_no_solid_glass_absorbs_nothing_inside(objects, extensions):
    made, _ = objects(Gltf({"extensions": extensions}))
    assert "interior" not in made["square"]


@pytest.mark.slow  # a kernel of its own, for glass with a medium in it
def test_a_sky_is_seen_through_a_solid_that_absorbs(write):
    """Of an IOR of 1, so that it does nothing else: two squares, a unit apart."""
    glass = SHEET | SOLID | {"KHR_materials_ior": {"ior": 1}, "KHR_materials_transmission": {"transmissionFactor": 1}}
    file = Gltf({"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 0}, "extensions": glass})
    file.node(mesh=0, translation=[0, 0, -1], rotation=[0, 1, 0, 0])
    file.header["cameras"] = [{"type": "orthographic", "orthographic": {"xmag": 0.1, "ymag": 0.1, "znear": 0.1}}]
    file.node(camera=0, translation=[0, 0, 3])
    image = np.asarray(pj.render(pj.load_scene(write(file), res=4), 256))
    np.testing.assert_allclose(image.mean((0, 1)), [0.5, 0.5**0.5, 1], rtol=5e-3)


@pytest.mark.parametrize(("metallic", "kind"), [(0, "principled"), (1, "principled"), (0.25, "blendbsdf")])
def test_an_ior_of_0_reflects_all_light_where_there_is_no_metal(material, metallic, kind):
    pbr = {"metallicFactor": metallic, "baseColorFactor": [0.5, 0.25, 0.125, 1]}
    bsdf = material(Gltf({"pbrMetallicRoughness": pbr, "extensions": {"KHR_materials_ior": {"ior": 0}}}))[0]["bsdf"]
    assert bsdf["type"] == kind
    parts = [bsdf["white"], bsdf["metal"]] if kind == "blendbsdf" else [bsdf]
    assert all(part["metallic"] == 1 and "eta" not in part for part in parts)
    assert bsdf.get("weight", metallic) == metallic
    assert metallic == 1 or parts[0]["base_color"] == 1
    assert metallic == 0 or list(parts[-1]["base_color"]["value"]) == [0.5, 0.25, 0.125]


def test_transmission_has_textures_and_lacks_metal(material):
    file = Gltf()
    glass = {"KHR_materials_transmission": {"transmissionFactor": 1, "transmissionTexture": file.texture()}}
    file.header["materials"] = [{"extensions": glass}]
    bsdf, notes = material(file)
    np.testing.assert_array_equal(bsdf["spec_trans"]["data"], PIXELS[..., :1])
    assert "metallic" not in bsdf and any("metal" in note for note in notes)


@pytest.mark.parametrize(("through", "expected"), [(1, 0.96), (0, 0)])
def test_a_lamp_shines_through_a_sheet_that_lets_it(write, through, expected):
    """At normal incidence, where glass reflects 4 %; the lamp behind the sheet is the only light."""
    sheet = Gltf({"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 0.0}})
    lamp = {"emissiveFactor": [1, 1, 1], "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}}
    sheet.header["materials"][0]["extensions"] = {"KHR_materials_transmission": {"transmissionFactor": through}}
    sheet.header["materials"].append(lamp)
    sheet.header["meshes"].append({"primitives": [sheet.primitive | {"material": 1}]})
    sheet.node(mesh=1, translation=[0, 0, -0.5], scale=[3, 3, 1])
    image = pj.render(pj.load_scene(write(sheet), res=33), 64)
    height, width, _ = image.shape
    # Directions are a few degrees off the normal, and the least roughness hardly spreads them.
    np.testing.assert_allclose(image[height // 2, width // 2], expected, atol=0.02)


@pytest.mark.parametrize(("mode", "expected"), [("OPAQUE", None), ("BLEND", 0.25), ("MASK", 0.0)])
def test_alpha_is_opacity(material, mode, expected):
    bsdf, _ = material(Gltf({"alphaMode": mode, "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.25]}}))
    if expected is None:
        assert bsdf["type"] == "twosided"
    else:
        assert (bsdf["type"], bsdf["opacity"], bsdf["bsdf"]["type"]) == ("mask", expected, "twosided")


def test_alpha_of_a_texture_is_cut_off_where_the_material_says(material):
    file = Gltf()
    pbr = {"baseColorTexture": file.texture(), "baseColorFactor": [1, 1, 1, 0.5]}
    file.header["materials"] = [{"alphaMode": "MASK", "alphaCutoff": 0.25, "pbrMetallicRoughness": pbr}]
    opacity = material(file)[0]["opacity"]
    np.testing.assert_array_equal(opacity["data"], PIXELS[..., 3:] / 255 * 0.5 >= 0.25)
    assert opacity["filter_type"] == "nearest"
    file.header["materials"][0]["alphaMode"] = "BLEND"
    np.testing.assert_allclose(material(file)[0]["opacity"]["data"], PIXELS[..., 3:] / 510, rtol=1e-6)


def test_what_glows_is_a_light(objects):
    strength = {"KHR_materials_emissive_strength": {"emissiveStrength": 4.0}}
    file = Gltf({"emissiveFactor": [1, 0.5, 0], "extensions": strength})
    assert list(objects(file)[0]["square"]["emitter"]["radiance"]["value"]) == [4, 2, 0]
    file.header["materials"][0]["emissiveTexture"] = file.texture()
    file.header["nodes"].append({"mesh": 0})
    file.header["scenes"] = [{"nodes": [0, 1]}]
    made, _ = objects(file)
    shared = {"type": "ref", "id": "material_emission"}
    assert made["square"]["emitter"]["radiance"] == made["mesh"]["emitter"]["radiance"] == shared
    linear = pj.images.srgb_to_linear(PIXELS[..., :3] / 255) * [4, 2, 0]
    np.testing.assert_allclose(made["material_emission"]["data"], linear, rtol=1e-6)
    file.header["materials"][0]["emissiveTexture"] = file.texture(np.zeros((1, 1, 3), np.uint8))
    assert "emitter" not in objects(file)[0]["square"]


def test_settings_of_textures(material):
    file = Gltf(samplers=[{"wrapS": 33071, "wrapT": 33071, "magFilter": 9728}])
    move = {"offset": [0.25, 0.5], "rotation": math.pi / 2, "scale": [2, 3]}
    info = file.texture(sampler=0) | {"extensions": {"KHR_texture_transform": move}}
    file.header["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": info}}]
    texture = material(file)[0]["bsdf"]["base_color"]
    assert (texture["wrap_mode"], texture["filter_type"]) == ("clamp", "nearest")
    # Scaled, then turned counterclockwise as seen, with v pointing down, then shifted.
    np.testing.assert_allclose(texture["to_uv"] @ [1, 0, 0], [0.25, 0.5 - 2, 0], atol=1e-12)
    np.testing.assert_allclose(texture["to_uv"] @ [0, 1, 0], [0.25 + 3, 0.5, 0], atol=1e-12)


def test_other_texture_coordinates_are_found(objects, tmp_path):
    file = Gltf()
    file.primitive["attributes"]["TEXCOORD_1"] = file.accessor(UV[::-1].copy())
    info = file.texture() | {"texCoord": 1}
    file.header["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": info}}]
    np.testing.assert_array_equal(objects(file)[0]["square"]["uv"], UV[::-1])
    file.header["materials"][0]["normalTexture"] = file.texture()
    with pytest.raises(pj.InputError, match="different texture coordinates is not supported"):
        objects(file)


def test_colours_of_vertices_are_those_of_a_white_material(objects):
    file = Gltf()
    colors = np.random.default_rng(1).random((4, 4)).astype("<f4")
    file.primitive["attributes"]["COLOR_0"] = file.accessor(colors)
    made, notes = objects(file)
    np.testing.assert_array_equal(made["square"]["vertex_color"], colors[:, :3])
    assert made["material"]["bsdf"]["base_color"] == {"type": "mesh_attribute", "name": "vertex_color"}
    assert not notes
    file.header["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": file.texture()}}]
    made, notes = objects(file)
    assert made["material"]["bsdf"]["base_color"]["type"] == "bitmap"
    assert any("colours of its vertices" in note for note in notes)


def test_materials_are_shared_and_named(objects):
    file = Gltf({"name": "red paint."})
    file.header["nodes"].append({"mesh": 0, "name": "square", "translation": [0, 0, 1]})
    file.header["scenes"] = [{"nodes": [0, 1]}]
    made, _ = objects(file)
    assert list(made) == ["red_paint_", "square", "square_1"]
    assert made["square"]["bsdf"] == made["square_1"]["bsdf"] == {"type": "ref", "id": "red_paint_"}


@pytest.mark.parametrize(
    "name", ["type", "id", "camera", "sky", "integrator", "material", "a.b c", "$x", "\n", "\U0001f600"]
)
def test_nodes_may_have_any_name(write, name):
    file = Gltf()
    file.header["nodes"][0]["name"] = name
    scene = pj.load_scene(write(file), res=8)
    assert len(scene.about.description.shapes) == 1 and len(scene.emitters) == 1


# ---- cameras and lights -------------------------------------------------------------------------------------------

TURNED = {"translation": [1, 2, 3], "rotation": [0, math.sqrt(0.5), 0, math.sqrt(0.5)]}  # a quarter about y


def with_node(**node):
    file = Gltf(cameras=[CAMERA], extensions={"KHR_lights_punctual": {"lights": LIGHTS}})
    file.node(**TURNED, name="it", **node)
    return file


CAMERA = {"type": "perspective", "perspective": {"yfov": 0.5, "aspectRatio": 2.0, "znear": 0.5, "zfar": 50}}
LIGHTS = [
    {"type": "point", "color": [1, 0.5, 0], "intensity": 8},
    {"type": "directional"},
    {"type": "spot", "intensity": 2, "spot": {"innerConeAngle": 0.25, "outerConeAngle": 0.5}},
]


def test_cameras_look_along_minus_z(objects):
    camera = objects(with_node(camera=0))[0]["it"]
    assert (camera["type"], camera["fov"], camera["fov_axis"]) == ("perspective", pytest.approx(math.degrees(0.5)), "y")
    assert (camera["near_clip"], camera["far_clip"], camera["aspect"]) == (0.5, 50, 2)
    to_world = camera["to_world"]
    np.testing.assert_allclose(to_world @ [0, 0, 0], [1, 2, 3])
    np.testing.assert_allclose(to_world @ [0, 0, 1], [0, 2, 3], atol=1e-7)
    np.testing.assert_allclose(to_world @ [0, 1, 0], [1, 3, 3], atol=1e-7)


def test_orthographic_cameras(objects):
    file = with_node(camera=0)
    seen = {"xmag": 3.0, "ymag": 1.5, "znear": 0.5, "zfar": 50}
    file.header["cameras"] = [{"type": "orthographic", "orthographic": seen}]
    camera = objects(file)[0]["it"]
    assert (camera["type"], camera["aspect"]) == ("orthographic", 2)
    np.testing.assert_allclose(np.linalg.norm(camera["to_world"].matrix[:3, :3], axis=0), [3, 3, 1])


@pytest.mark.parametrize("number", range(3))
def test_lights_shine_along_minus_z(objects, number):
    light = objects(with_node(extensions={"KHR_lights_punctual": {"light": number}}))[0]["it"]
    if light["type"] == "point":
        assert list(light["intensity"]["value"]) == [8, 4, 0]
        assert list(light["position"]) == [1, 2, 3]
    elif light["type"] == "directional":
        np.testing.assert_allclose(light["direction"], [-1, 0, 0], atol=1e-7)
        assert list(light["irradiance"]["value"]) == [1, 1, 1]
    else:
        np.testing.assert_allclose(light["to_world"].matrix[:3, 2], [-1, 0, 0], atol=1e-7)
        assert (light["beam_width"], light["cutoff_angle"]) == (math.degrees(0.25), math.degrees(0.5))


def test_a_spot_without_settings_has_those_of_the_format(objects):
    file = Gltf(extensions={"KHR_lights_punctual": {"lights": [{"type": "spot"}]}})
    file.node(name="it", extensions={"KHR_lights_punctual": {"light": 0}})
    light = objects(file)[0]["it"]
    assert (light["beam_width"], light["cutoff_angle"]) == (0, 45)


def test_the_film_has_the_cameras_shape_and_what_is_lacking_is_added(write):
    made, notes, _ = bare.scene(write(with_node(camera=0)), {"res": 100})
    assert (made["it"]["film"]["width"], made["it"]["film"]["height"]) == (100, 50)
    assert made["sky"] == {"type": "constant"} and any("has no light" in note for note in notes)
    made, notes, _ = bare.scene(write(with_node(extensions={"KHR_lights_punctual": {"light": 0}})), {})
    assert (made["camera"]["film"]["width"], made["camera"]["film"]["height"]) == (768, 576)
    assert "sky" not in made and any("has no camera" in note for note in notes)


# ---- scenes -------------------------------------------------------------------------------------------------------


def everything(alpha="MASK"):
    """Return a file of a square with all textures in front of a glowing one, with a camera and lights."""
    file = Gltf(cameras=[CAMERA], extensions={"KHR_lights_punctual": {"lights": LIGHTS}})
    bumps = np.full((4, 4, 3), (128, 128, 255), np.uint8)
    bumps[1:3, 1:3] = (90, 190, 220)
    pbr = {"baseColorTexture": file.texture(), "metallicRoughnessTexture": file.texture(), "roughnessFactor": 0.8}
    square = {"pbrMetallicRoughness": pbr, "normalTexture": file.texture(bumps), "alphaMode": alpha}
    file.header["materials"] = [square, {"emissiveFactor": [0.5, 0.25, 1], "name": "glow"}]
    file.header["materials"][1]["emissiveTexture"] = file.texture()
    file.header["meshes"].append({"primitives": [file.primitive | {"material": 1}]})
    file.node(mesh=1, translation=[0, 0, -1], name="back")
    file.node(camera=0, translation=[0.5, 0.25, 5])
    for number in range(3):
        file.node(translation=[0.5, 0.5 * number, 3], extensions={"KHR_lights_punctual": {"light": number}})
    return file


def test_nothing_is_told_of_what_the_file_does_not_hold(write):
    file = with_node(camera=0, extensions={"KHR_lights_punctual": {"light": 2}})
    file.header["materials"] = [{"extensions": SHEET | SOLID}]
    notes = pj.load_scene(write(file)).about.description.notes
    assert len(notes) == 1 and "is open" in notes[0]


def test_a_file_is_a_scene_that_can_be_saved(write, tmp_path):
    scene = pj.load_scene(write(everything()), res=32)
    assert {"glow.base_color", "glow.roughness", "light.intensity"} < set(pj.parameters(scene))
    assert len(pj.save_scene(scene, tmp_path / "saved.xml")) == 9
    again = pj.load_scene(tmp_path / "saved.xml")
    jax.tree.map(np.testing.assert_array_equal, *(replace(each, about=None) for each in (scene, again)))


@pytest.mark.slow
def test_normals_point_up_and_right_where_maps_say_so(write):
    """Green and red above a half tilt the normal up and right: light from there makes the surface brighter."""

    def seen(pixel, axis):
        file = Gltf(cameras=[CAMERA], extensions={"KHR_lights_punctual": {"lights": [LIGHTS[1]]}})
        normals = file.texture(np.full((2, 2, 3), pixel, np.uint8))
        file.header["materials"] = [{"pbrMetallicRoughness": {"metallicFactor": 0.0}, "normalTexture": normals}]
        file.node(camera=0, translation=[0, 0, 5])
        turn = [*(math.sin(math.pi / 8) * np.array(axis)), math.cos(math.pi / 8)]
        file.node(rotation=turn, extensions={"KHR_lights_punctual": {"light": 0}})
        return float(np.mean(pj.render(pj.load_scene(write(file), res=2), spp=4)))

    from_above, from_the_right = [-1, 0, 0], [0, 1, 0]
    assert seen((128, 218, 218), from_above) > 20 * seen((128, 38, 218), from_above) > 0
    assert seen((218, 128, 218), from_the_right) > 20 * seen((38, 128, 218), from_the_right) > 0


def test_what_was_read_is_not_overwritten(tmp_path):
    file = everything()
    (tmp_path / "b_square.ply").write_bytes(file.data)
    buffers = [{"byteLength": len(file.data), "uri": "b_square.ply"}]
    header = {key: value for key, value in file.header.items() if value != []}
    (tmp_path / "a.gltf").write_text(json.dumps(header | {"buffers": buffers}))
    scene = pj.load_scene(tmp_path / "a.gltf", res=32)
    with pytest.raises(pj.InputError, match=r"b_square\.ply: is read by the same command"):
        pj.save_scene(scene, tmp_path / "b.xml")
    assert len(pj.save_scene(scene, tmp_path / "c.xml")) == 9


@pytest.mark.slow
def test_mitsuba_renders_what_is_saved(write, tmp_path, mitsuba, estimate, agree):
    # Opaque, as masked surfaces are to Mitsuba's shadow rays, and only shadow rays find lights without size.
    scene = pj.load_scene(write(everything("OPAQUE")), res=32)
    pj.save_scene(scene, tmp_path / "saved.xml")
    theirs = mitsuba(tmp_path / "saved.xml", 64, 12)
    # The filter shares samples between pixels, so their mean varies more than the pixels' variances suggest.
    agree(estimate(scene, spp=64, count=12), theirs, whole=False, rounding=1e-3)


# ---- omissions and errors -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"animations": [{}]}, "animations are left out"),
        ({"extensionsUsed": ["KHR_materials_sheen"]}, "KHR_materials_sheen is left out"),
        ({"scenes": [{"nodes": [0]}, {"nodes": []}]}, "scene 0 of its 2"),
        ({"materials": [{"occlusionTexture": {"index": 0}}]}, "occlusion"),
        ({"materials": [{"extensions": {"KHR_materials_unlit": {}}}]}, "unlit materials are lit"),
    ],
)
def test_notes_tell_what_is_left_out(objects, change, says):
    _, notes = objects(
        Gltf(**{key: value for key, value in change.items()}) if "materials" not in change else _of(change)
    )
    assert any(says in note for note in notes)


def _of(change):
    file = Gltf()
    file.header |= change
    return file


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"extensionsRequired": ["KHR_materials_sheen"]}, "KHR_materials_sheen is not supported"),
        ({"materials": [{"alphaMode": "Blend"}]}, 'alphaMode must be OPAQUE, MASK or BLEND, is "Blend"'),
        (
            {"materials": [{"extensions": SHEET | {"KHR_materials_volume": TINTED | {"attenuationDistance": 0}}}]},
            "attenuationDistance must be above 0",
        ),
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "KHR_draco_mesh_compression is not supported"),
        ({"skins": [{}]}, "skins is not supported"),
        ({"materials": []}, "materials 0 does not exist"),
        ({"materials": [{"emissiveFactor": [1, 1, 1], "emissiveTexture": {"index": 7}}]}, "textures 7 does not exist"),
        ({"materials": [{"normalTexture": {"index": 0}}], "textures": [{"source": 0}]}, "images 0 does not exist"),
        ({"materials": [{"normalTexture": {"index": 0}}], "textures": [{}]}, "images of another format"),
        (
            {
                "materials": [{"normalTexture": {"index": 0}}],
                "textures": [{"source": 0}],
                "images": [{"uri": "no.png"}],
            },
            "no.png, which it names, is not beside it",
        ),
        (
            {
                "materials": [{"normalTexture": {"index": 0}}],
                "textures": [{"source": 0}],
                "images": [{"uri": "data:,x"}],
            },
            "image 0 cannot be read",
        ),
        ({"materials": [{"emissiveFactor": "much"}]}, "cannot be read as glTF"),
        ({"nodes": [{"camera": 3}]}, "cameras 3 does not exist"),
        ({"nodes": [{"extensions": {"KHR_lights_punctual": {"light": 3}}}]}, "cannot be read as glTF|light 3 does not"),
    ],
)
def test_what_is_missing_or_not_modelled_is_refused(objects, change, says):
    with pytest.raises(pj.InputError, match=rf"file\.glb.*({says})"):
        objects(_of(change))


def test_a_file_of_no_triangles_is_refused(write):
    file = Gltf()
    file.primitive["mode"] = 1
    with pytest.raises(pj.InputError, match="holds no triangles"):
        bare.scene(write(file), {})


@settings(max_examples=150, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_damaged_files_are_scenes_or_refused(tmp_path, data):
    file = with_node(camera=0, extensions={"KHR_lights_punctual": {"light": 2}})
    pbr = {"baseColorTexture": file.texture(), "metallicRoughnessTexture": file.texture()}
    file.header["materials"] = [{"pbrMetallicRoughness": pbr, "alphaMode": "MASK", "emissiveFactor": [1, 1, 1]}]
    content = file.glb()
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(12, len(content) - 1))
        piece = data.draw(st.binary(max_size=3) | st.sampled_from([b"-1", b"9", b"null", b'"x"', b"[]", b"{}"]))
        content = content[:at] + piece + content[at + data.draw(st.sampled_from([0, len(piece)])) :]
    (tmp_path / "file.glb").write_bytes(content)
    try:
        bare.scene(tmp_path / "file.glb", {})
    except pj.InputError as error:
        assert "file.glb" in str(error) and "\n" not in str(error)
