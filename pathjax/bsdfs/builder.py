"""From what a file says of materials to their tables."""

from __future__ import annotations

import numpy as np

from pathjax import description as desc
from pathjax.bsdfs import ConductorTable, DielectricTable, DiffuseTable, Materials
from pathjax.description.parameter import Parameter
from pathjax.textures.texture import WRAPS, Bitmaps, Textures


def build_materials(description, dtype, parameters) -> Materials:
    rows: dict[type, list] = {}  # kind of bsdf -> its bsdfs, in order of appearance

    def place(bsdf):
        same_kind = rows.setdefault(type(bsdf), [])
        for row, other in enumerate(same_kind):
            if other is bsdf:
                return type(bsdf), row
        same_kind.append(bsdf)
        return type(bsdf), len(same_kind) - 1

    sides = []
    for shape in description.shapes:
        match shape.bsdf:
            case desc.Twosided(front=front, back=back):
                sides.append((place(front), place(back)))
            case desc.Dielectric() as glass:
                sides.append((place(glass), place(glass)))
            case reflector:
                sides.append((place(reflector), None))

    tables, kinds = [], {}
    for kind, make in ((desc.Diffuse, _diffuse), (desc.Conductor, _conductor), (desc.Dielectric, _dielectric)):
        if kind in rows:
            kinds[kind] = len(tables)
            path = ("materials", "tables", len(tables))
            tables.append(make(rows[kind], dtype, parameters, path))
    codes = [[(-1, 0) if side is None else (kinds[side[0]], side[1]) for side in pair] for pair in sides]
    return Materials(tuple(tables), np.asarray(np.reshape(codes, (-1, 2, 2)), np.int32))


def _diffuse(bsdfs, dtype, parameters, path) -> DiffuseTable:
    reflectance = np.zeros((len(bsdfs), 3))
    textures, texture_of = [], np.full(len(bsdfs), -1, np.int32)
    for row, bsdf in enumerate(bsdfs):
        if isinstance(bsdf.reflectance, desc.Bitmap | desc.Checkerboard):
            known = [i for i, texture in enumerate(textures) if texture is bsdf.reflectance]
            texture_of[row] = known[0] if known else len(textures)
            if not known:
                textures.append(bsdf.reflectance)
        else:
            reflectance[row] = bsdf.reflectance
            parameters[f"{bsdf.name}.reflectance"] = Parameter((*path, "reflectance"), (row,), (3,), (0, 1))
    if not textures:
        return DiffuseTable(np.asarray(reflectance, dtype), None, None)
    table = _textures(textures, dtype, parameters, (*path, "textures"))
    return DiffuseTable(np.asarray(reflectance, dtype), np.asarray(texture_of), table)


def _textures(textures, dtype, parameters, path) -> Textures:
    to_uv = np.stack([texture.to_uv[:2] for texture in textures])
    colors = np.zeros((len(textures), 2, 3))
    images, first, size, nearest, wrap = [], [], [], [], []
    for row, texture in enumerate(textures):
        bitmap = isinstance(texture, desc.Bitmap)
        first.append(sum(len(image) for image in images))
        size.append(texture.texels.shape[:2] if bitmap else (0, 0))
        nearest.append(bitmap and texture.interpolation == "nearest")
        wrap.append(WRAPS.index(texture.wrap) if bitmap else 0)
        if bitmap:
            images.append(texture.texels.reshape(-1, 3))
        else:
            colors[row] = texture.color0, texture.color1
            for place in (0, 1):
                parameter = Parameter((*path, "colors"), (row, place), (3,), (0, 1))
                parameters[f"{texture.name}.color{place}"] = parameter
    bitmaps = None
    if images:
        bitmaps = Bitmaps(
            np.asarray(np.concatenate(images), dtype),
            np.asarray(first, np.int32),
            np.asarray(size, np.int32),
            np.asarray(nearest),
            np.asarray(wrap, np.int32),
        )
    checkers = any(isinstance(texture, desc.Checkerboard) for texture in textures)
    return Textures(np.asarray(to_uv, dtype), np.asarray(colors, dtype) if checkers else None, bitmaps)


def _conductor(bsdfs, dtype, parameters, path) -> ConductorTable:
    ideal = np.array([bsdf.eta is None for bsdf in bsdfs])
    # Rows of ideal mirrors hold some metal's numbers, which nothing reads.
    eta = np.stack([np.ones(3) if bsdf.eta is None else bsdf.eta for bsdf in bsdfs])
    k = np.stack([np.ones(3) if bsdf.k is None else bsdf.k for bsdf in bsdfs])
    for row, bsdf in enumerate(bsdfs):
        specular = Parameter((*path, "specular_reflectance"), (row,), (3,), (0, 1))
        parameters[f"{bsdf.name}.specular_reflectance"] = specular
        if bsdf.eta is not None:
            parameters[f"{bsdf.name}.eta"] = Parameter((*path, "eta"), (row,), (3,), (0, np.inf))
            parameters[f"{bsdf.name}.k"] = Parameter((*path, "k"), (row,), (3,), (0, np.inf))
    specular = np.asarray(np.stack([bsdf.specular_reflectance for bsdf in bsdfs]), dtype)
    if ideal.all():
        return ConductorTable(specular, None, None, None)
    return ConductorTable(specular, np.asarray(eta, dtype), np.asarray(k, dtype), np.asarray(ideal))


def _dielectric(bsdfs, dtype, parameters, path) -> DielectricTable:
    for row, bsdf in enumerate(bsdfs):
        for name in ("int_ior", "ext_ior"):
            positive = (float(np.finfo(np.float32).tiny), np.inf)
            parameters[f"{bsdf.name}.{name}"] = Parameter((*path, name), (row,), (), positive)
    int_ior, ext_ior = (np.array([getattr(bsdf, name) for bsdf in bsdfs]) for name in ("int_ior", "ext_ior"))
    return DielectricTable(np.asarray(int_ior, dtype), np.asarray(ext_ior, dtype))
