"""glTF 2.0 scenes with materials, cameras and lights, as dictionaries for `load_dict`.

Materials become `principled`, where roughness and metalness mean the same. One candela is read as 1 W/sr, one lux as
1 W/m^2 and an emission of 1 as a radiance of 1, which keeps the ratios that the format defines.
"""

from __future__ import annotations

import io
import itertools
import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pathjax.description.transform import Transform
from pathjax.errors import InputError
from pathjax.images.read import decoded
from pathjax.io.mesh import gltf
from pathjax.io.mesh.raw import Raw

WRAPS = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
NEAREST = 9728
# Extensions that are modelled, so that a file may require them.
KNOWN = re.compile(
    "KHR_(lights_punctual|mesh_quantization|texture_transform"
    "|materials_(ior|emissive_strength|transmission|unlit|volume))|EXT_texture_webp"
)
MOST_PIXELS = 10**9
NO_LIMIT = 1e10  # far clip distance of a camera without one


def scene(path: Path) -> tuple[dict[str, dict], list[str], list[Path]]:
    """Return the objects of a scene by name, notes on what is left out, and the files that were read.

    Raises:
        InputError: the file is damaged, a part of it is missing, or it requires a feature that is not modelled.
    """
    try:
        file = gltf.opened(path, KNOWN)
        return *_Scene(file).objects(), [path, *file.beside]
    except InputError:
        raise
    except Exception as error:  # any, as a malformed header may fail anywhere
        raise InputError(f"{path}: cannot be read as glTF ({type(error).__name__}: {error})"[:300]) from None


def unused(name: str, taken: Mapping[str, object]) -> str:
    """Return the name, with a number appended if it is taken or is a reserved key ("type", "id")."""
    names = itertools.chain([name], (f"{name}_{number}" for number in itertools.count(1)))
    return next(each for each in names if each not in taken and each not in ("type", "id"))


class _Scene:
    def __init__(self, file: gltf.File):
        self.file = file
        self.notes: dict[str, None] = {}  # an ordered set
        self.made: dict[str, dict] = {}
        self.materials: dict[tuple[int | None, bool], str] = {}  # (index, whether vertices have colours) -> name
        self.emissions: dict[int | None, dict | None] = {}
        self.media: dict[int | None, dict | None] = {}  # index of a material -> reference to what is inside
        self.pictures: dict[int, np.ndarray] = {}

    def objects(self) -> tuple[dict[str, dict], list[str]]:
        header = self.file.header
        for name in sorted(set(header.get("extensionsUsed", []))):
            if not KNOWN.fullmatch(name):
                self.note(f"its extension {name} is left out")
        if header.get("animations"):
            self.note("its animations are left out; objects are where its nodes place them")
        if len(header.get("scenes", [])) > 1:
            self.note(f"scene {header.get('scene', 0)} of its {len(header['scenes'])} is read")
        for node, matrix in gltf.placed(self.file):
            if "camera" in node:
                self.add(node, "camera", self.camera(self.file.entry("cameras", node["camera"]), matrix))
            if light := node.get("extensions", {}).get("KHR_lights_punctual"):
                self.add(node, "light", self.light(light["light"], matrix))
            for primitive in self.file.entry("meshes", node["mesh"])["primitives"] if "mesh" in node else ():
                self.add(node, "mesh", self.mesh(primitive, matrix))
        return self.made, [f"{self.file.path}: {note}" for note in self.notes]

    def note(self, text: str) -> None:
        self.notes[text] = None

    def add(self, node: dict, kind: str, made: dict | None) -> None:
        if made is not None:
            self.made[self.free(node.get("name") or kind)] = made

    def free(self, name: str) -> str:
        """Return the name as a valid key, with a number appended if it is taken."""
        return unused(re.sub(r"[^\w-]+", "_", name) or "_", self.made)

    # ---- cameras and lights

    def camera(self, camera: dict, matrix: np.ndarray) -> dict:
        """Return a camera, with `aspect` in place of a film."""
        seen = camera[camera["type"]]
        to_world = _looking(matrix)
        clip = {"near_clip": float(seen["znear"] or 1e-2), "far_clip": float(seen.get("zfar", NO_LIMIT))}
        if camera["type"] == "perspective":
            fov = {"fov": math.degrees(seen["yfov"]), "fov_axis": "y"}
            return {"type": "perspective", "to_world": to_world, **fov, **clip, "aspect": seen.get("aspectRatio")}
        aspect = seen["xmag"] / seen["ymag"]
        to_world = to_world.scale([abs(seen["xmag"]), abs(seen["xmag"]), 1])
        return {"type": "orthographic", "to_world": to_world, **clip, "aspect": abs(aspect)}

    def light(self, number: int, matrix: np.ndarray) -> dict:
        lights = self.file.header["extensions"]["KHR_lights_punctual"]["lights"]
        if not 0 <= number < len(lights):
            raise InputError(f"{self.file.path}: light {number} does not exist; there are {len(lights)}")
        light, to_world = lights[number], _looking(matrix)
        color = _rgb(np.array(light.get("color", [1, 1, 1])) * light.get("intensity", 1.0))
        if "range" in light:
            self.note("the range of its lights is left out; they reach everywhere")
        if light["type"] == "directional":
            return {"type": "directional", "irradiance": color, "direction": to_world.matrix[:3, 2]}
        if light["type"] == "point":
            return {"type": "point", "intensity": color, "position": to_world.matrix[:3, 3]}
        cone = {"innerConeAngle": 0.0, "outerConeAngle": math.pi / 4} | light.get("spot", {})
        angles = {
            "beam_width": math.degrees(cone["innerConeAngle"]),
            "cutoff_angle": math.degrees(cone["outerConeAngle"]),
        }
        return {"type": "spot", "intensity": color, "to_world": to_world, **angles}

    # ---- surfaces

    def mesh(self, primitive: dict, matrix: np.ndarray) -> dict | None:
        if primitive.get("mode", gltf.TRIANGLES) < gltf.TRIANGLES:
            self.note("its points and lines are left out")
            return None
        number = primitive.get("material")
        material = {} if number is None else self.file.entry("materials", number)
        part = gltf.triangles_of(self.file, primitive, matrix, self.coordinates(material))
        made = {"type": "mesh", "vertices": part.vertices, "faces": part.corners.reshape(-1, 3)}
        made |= {name: value for name, value in (("normals", part.normals), ("uv", part.uv)) if value is not None}
        if (colors := self.colors(primitive, part)) is not None:
            made["vertex_color"] = colors
        kind = number, colors is not None
        if kind not in self.materials:
            name = self.free(material.get("name") or "material")
            self.made[name], self.materials[kind] = self.bsdf(material, colored=colors is not None), name
        made["bsdf"] = {"type": "ref", "id": self.materials[kind]}
        if number not in self.media:
            self.media[number] = self.medium(material)
        if (medium := self.media[number]) is not None:
            made["interior"] = medium
        if number not in self.emissions:
            self.emissions[number] = self.emission(material)
        if (radiance := self.emissions[number]) is not None:
            made["emitter"] = {"type": "area", "radiance": radiance}
        return made

    def colors(self, primitive: dict, part: Raw) -> np.ndarray | None:
        """Return (V, 3) vertex colours in [0, 1], which multiply those of the material; None: there are none."""
        if "COLOR_0" not in primitive["attributes"]:
            return None
        colors = self.file.accessor(primitive["attributes"]["COLOR_0"])
        if len(colors) != len(part.vertices) or colors.shape[1] < 3 or colors.dtype.kind != "f":
            raise InputError(
                f"{self.file.path}: COLOR_0 has the shape {colors.shape} beside {len(part.vertices)} positions"
            )
        return np.clip(colors[:, :3], 0, 1)

    def bsdf(self, material: dict, colored: bool) -> dict:
        """Return the BSDF, two-sided unless it transmits (the format would by default show front faces only)."""
        pbr = material.get("pbrMetallicRoughness", {})
        factor = np.array(pbr.get("baseColorFactor", [1.0, 1.0, 1.0, 1.0]))
        base = self.texture(pbr.get("baseColorTexture"))
        color = _rgb(factor[:3]) if base is None else base.times(slice(0, 3), factor[:3], raw=False)
        if colored and (base is not None or (factor[:3] != 1).any()):
            self.note("the colours of its vertices are left out where a material has a colour of its own")
        elif colored:
            color = {"type": "mesh_attribute", "name": "vertex_color"}
        extensions = material.get("extensions", {})
        two_sided = True
        if "KHR_materials_unlit" in extensions:
            self.note("its unlit materials are lit, as diffuse ones of their colour")
            bsdf = {"type": "diffuse", "reflectance": color}
        else:
            bsdf = {"type": "principled", "base_color": color}
            both = self.texture(pbr.get("metallicRoughnessTexture"))
            for key, channel, usual in (("roughness", 1, "roughnessFactor"), ("metallic", 2, "metallicFactor")):
                share = float(pbr.get(usual, 1.0))
                bsdf[key] = share if both is None else both.times(slice(channel, channel + 1), share, raw=True)
            if "KHR_materials_ior" in extensions:
                bsdf["eta"] = float(extensions["KHR_materials_ior"].get("ior", 1.5))
            if bsdf.get("eta") == 0:
                bsdf = _reflecting(bsdf)
            elif (through := self.transmission(extensions)) is not None:
                bsdf, two_sided = self.glass(bsdf | {"spec_trans": through}, extensions), False
            if (normals := self.texture(material.get("normalTexture"))) is not None:
                normal = normals.normals(float(material["normalTexture"].get("scale", 1.0)))
                bsdf = {"type": "normalmap", "normalmap": normal, "bsdf": bsdf}
        if "occlusionTexture" in material:
            self.note("the occlusion in its materials is left out, as light is traced")
        bsdf = {"type": "twosided", "bsdf": bsdf} if two_sided else bsdf
        if (mode := material.get("alphaMode", "OPAQUE")) == "OPAQUE":
            return bsdf
        if mode not in ("MASK", "BLEND"):
            raise InputError(f'{self.file.path}: alphaMode must be OPAQUE, MASK or BLEND, is "{str(mode)[:40]}"')
        cutoff = float(material.get("alphaCutoff", 0.5)) if mode == "MASK" else None
        if base is not None:
            opacity = base.alpha(float(factor[3]), cutoff)
        else:
            opacity = float(factor[3]) if cutoff is None else float(factor[3] >= cutoff)
        return {"type": "mask", "opacity": opacity, "bsdf": bsdf}

    def transmission(self, extensions: dict) -> float | dict | None:
        """Return the share of light that is transmitted; None: none."""
        extension = extensions.get("KHR_materials_transmission", {})
        factor = float(extension.get("transmissionFactor", 0.0))
        picture = self.texture(extension.get("transmissionTexture")) if factor else None
        return picture.times(slice(0, 1), factor, raw=True) if picture is not None else factor or None

    def glass(self, bsdf: dict, extensions: dict) -> dict:
        """Return the transmitting bsdf: `principled` for a solid, which has a thickness, else a sheet without metal."""
        if extensions.get("KHR_materials_volume", {}).get("thicknessFactor", 0.0):
            return bsdf
        if bsdf.pop("metallic") != 0:
            self.note("the metal in its sheets that let light through is left out")
        return bsdf | {"type": "principledthin"}

    def medium(self, material: dict) -> dict | None:
        """Return the medium inside solid glass, which absorbs; None: the glass is clear, or there is none."""
        extensions = material.get("extensions", {})
        volume = extensions.get("KHR_materials_volume", {})
        distance = float(volume.get("attenuationDistance", math.inf))
        color = np.array(volume.get("attenuationColor", [1.0, 1.0, 1.0]))
        if not volume.get("thicknessFactor", 0.0) or self.transmission(extensions) is None:
            return None
        if extensions.get("KHR_materials_ior", {}).get("ior") == 0:
            return None
        if not distance > 0 or not ((color >= 0) & (color <= 1)).all():
            raise InputError(f"{self.file.path}: attenuationDistance must be above 0, attenuationColor in [0, 1]")
        # A channel of 0 transmits the least positive float32, since its extinction would be infinite.
        absorbed = np.log(1 / np.maximum(color, np.finfo(np.float32).tiny)) / distance
        if not absorbed.any():
            return None
        name = self.free(f"{material.get('name') or 'material'}_inside")
        self.made[name] = {"type": "homogeneous", "sigma_t": _rgb(absorbed), "albedo": 0.0}
        return {"type": "ref", "id": name}

    def emission(self, material: dict) -> dict | None:
        """Return the emitted radiance; None: the material does not emit."""
        factor = np.array(material.get("emissiveFactor", [0.0, 0.0, 0.0]))
        extension = material.get("extensions", {}).get("KHR_materials_emissive_strength", {})
        factor = factor * extension.get("emissiveStrength", 1.0)
        texture = self.texture(material.get("emissiveTexture")) if factor.any() else None
        if texture is None:
            return _rgb(factor) if factor.any() else None
        if not texture.pixels[..., :3].any():
            return None
        name = self.free(f"{material.get('name') or 'material'}_emission")
        self.made[name] = texture.times(slice(0, 3), factor, raw=False)
        return {"type": "ref", "id": name}

    # ---- textures

    def coordinates(self, material: dict) -> int:
        """Return the index of the texture coordinates that the textures of a material use."""
        pbr = material.get("pbrMetallicRoughness", {})
        infos = [pbr.get("baseColorTexture"), pbr.get("metallicRoughnessTexture")]
        infos += [material.get("normalTexture"), material.get("emissiveTexture")]
        infos += [material.get("extensions", {}).get("KHR_materials_transmission", {}).get("transmissionTexture")]
        used = {_transform_of(info).get("texCoord", info.get("texCoord", 0)) for info in infos if info}
        if len(used) > 1:
            raise self.file.refuse("textures of one material that use different texture coordinates")
        return used.pop() if used else 0

    def texture(self, info: dict | None) -> _Picture | None:
        if not info:
            return None
        texture = self.file.entry("textures", info["index"])
        webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
        source = texture.get("source", webp.get("source"))
        if source is None:
            raise self.file.refuse("images of another format than PNG, JPEG and WebP")
        if source not in self.pictures:
            self.pictures[source] = self.picture(source)
        sampler = self.file.entry("samplers", texture["sampler"]) if "sampler" in texture else {}
        wraps = {WRAPS[sampler.get(axis, 10497)] for axis in ("wrapS", "wrapT")}
        if len(wraps) > 1:
            self.note("its textures wrap the same way along u and v, that of u")
        how = {"wrap_mode": WRAPS[sampler.get("wrapS", 10497)]}
        how |= {"filter_type": "nearest"} if sampler.get("magFilter") == NEAREST else {}
        if placed := _transform_of(info):
            turn = Transform().translate([*placed.get("offset", [0, 0]), 0])
            turn = turn.rotate([0, 0, 1], -math.degrees(placed.get("rotation", 0)))
            how["to_uv"] = turn.scale([*placed.get("scale", [1, 1]), 1])
        return _Picture(self.pictures[source], how)

    def picture(self, number: int) -> np.ndarray:
        """Return (H, W, 4) uint8 pixels of an image."""
        from PIL import Image

        data = self.file.image(number)
        try:
            with Image.open(io.BytesIO(data or b"")) as image:
                if image.width * image.height > MOST_PIXELS:
                    raise InputError(f"{self.file.path}: image {number} has more than {MOST_PIXELS:.0e} pixels")
                return np.asarray(image.convert("RGBA"))
        except InputError:
            raise
        except Exception as error:  # the decoder raises many kinds
            raise InputError(
                f"{self.file.path}: image {number} cannot be read: {' '.join(str(error).split())}"
            ) from None


class _Picture:
    """An image, and how it is filtered, wrapped and mapped to a surface."""

    def __init__(self, pixels: np.ndarray, how: dict):
        self.pixels, self.how = pixels, how

    def bitmap(self, data: np.ndarray, raw: bool, **more) -> dict:
        return {"type": "bitmap", "data": data, "raw": raw, **self.how, **more}

    def times(self, channels: slice, factor: float | np.ndarray, raw: bool) -> dict:
        """Return some channels times a factor, or their stored bytes if that is 1. raw: plain values, not sRGB."""
        stored = self.pixels[..., channels]
        if np.all(factor == 1):
            return self.bitmap(stored, raw)
        return self.bitmap(decoded(stored, raw) * np.asarray(factor, np.float32), raw=True)

    def normals(self, scale: float) -> dict:
        """Return the normal map with x and y scaled."""
        if scale == 1:
            return self.bitmap(self.pixels[..., :3], raw=True)
        normal = (2 * decoded(self.pixels[..., :3], raw=True) - 1) * np.array([scale, scale, 1], np.float32)
        length = np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), np.finfo(np.float32).tiny)
        return self.bitmap((normal / length + 1) / 2, raw=True)

    def alpha(self, factor: float, cutoff: float | None) -> dict:
        """Return the opacity; with a cutoff it is 0 or 1."""
        alpha = decoded(self.pixels[..., 3:], raw=True) * np.float32(factor)
        if cutoff is None:
            return self.bitmap(alpha, raw=True)
        return self.bitmap((alpha >= cutoff).astype(np.float32), raw=True, filter_type="nearest")


def _reflecting(bsdf: dict) -> dict:
    """Return the bsdf for an IOR of 0, by which the format means that all light is reflected, except by metal."""
    share = bsdf["metallic"]
    metal = bsdf | {"metallic": 1.0}
    del metal["eta"]
    white = metal | {"base_color": 1.0}
    mixed = {"type": "blendbsdf", "weight": share, "white": white, "metal": metal}
    return white if share == 0 else metal if share == 1 else mixed


def _rgb(color: np.ndarray) -> dict:
    return {"type": "rgb", "value": color}


def _transform_of(info: dict) -> dict:
    return info.get("extensions", {}).get("KHR_texture_transform", {})


def _looking(matrix: np.ndarray) -> Transform:
    """Return the frame, without scale, whose z axis is where the format's cameras and lights look: along -z."""
    origin = matrix[:3, 3]
    return Transform().look_at(origin, origin - matrix[:3, 2] / np.linalg.norm(matrix[:3, 2]), matrix[:3, 1])
