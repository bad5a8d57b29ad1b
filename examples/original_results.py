"""Reproduce the two results of the work that pathjax continues, with their size, tent filter, thin lens and gamma.

    python examples/original_results.py [--mesh car.obj]

The results are a Cornell box whose walls are triangles, and a mesh over which its bounding volume hierarchy is drawn,
level by level. Prints the cost of the hierarchy under each of the three split rules: the mean numbers of nodes, boxes
and triangles that a camera ray tests. Writes original_results.png.
"""

import argparse
from pathlib import Path

import jax
import numpy as np
from PIL import Image, ImageDraw

import pathjax as pj
from pathjax.bench.walk import walk
from pathjax.io import mesh
from pathjax.shapes.accel.build import RULES

SCENES = Path(__file__).resolve().parents[1] / "scenes"
GAMMA = 2.2
ZOOM, SMOOTH = 2, 2  # scale of the panels; and of the canvas for lines, which antialiases them
COLORS = "#ffffff", "#ff5a4d", "#ffc400", "#39d353", "#2fb8ff", "#c77dff"  # of the levels, the root's first
# The mesh stands on a floor, with its bounds scaled to a sphere of radius 1. It is flat-shaded, as smooth normals of
# coarse meshes turn away from the camera at silhouettes, which are then black.
SCENE = """<scene version="3.0.0">
  <integrator type="path"><integer name="max_depth" value="8"/></integrator>
  <sensor type="thinlens"><float name="fov" value="30"/>
    <float name="aperture_radius" value="0.02"/><float name="focus_distance" value="4.2"/>
    <transform name="to_world"><lookat origin="2.6, 1.6, 3.1" target="0, 0.33, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="$res"/>
      <rfilter type="tent"/></film></sensor>
  <bsdf type="diffuse" id="paint"><rgb name="reflectance" value="0.7, 0.18, 0.12"/></bsdf>
  <bsdf type="twosided" id="body"><ref id="paint"/></bsdf>
  <bsdf type="diffuse" id="ground"><rgb name="reflectance" value="0.6, 0.6, 0.58"/></bsdf>
  <shape type="$kind"><string name="filename" value="$mesh"/><boolean name="face_normals" value="true"/>
    <transform name="to_world"><translate value="$shift"/><scale value="$scale"/></transform><ref id="body"/></shape>
  <shape type="rectangle"><transform name="to_world"><scale value="40"/><rotate x="1" angle="-90"/></transform>
    <ref id="ground"/></shape>
  <shape type="rectangle"><transform name="to_world"><scale value="1.5"/>
    <lookat origin="-2, 5, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
    <emitter type="area"><rgb name="radiance" value="12, 11, 9.5"/></emitter></shape>
  <emitter type="constant"><rgb name="radiance" value="0.35, 0.42, 0.55"/></emitter>
</scene>"""


def describe(file, output, res):
    """Write a scene file for a mesh file beside the output, and return its path and parameters."""
    kind = file.suffix.lower().lstrip(".")
    vertices = mesh.load(file, kind, np.eye(4))[0].vertices
    low, high = vertices.min(0), vertices.max(0)
    shift = -np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    scene = output.with_suffix(".xml")
    scene.write_text(SCENE)
    numbers = {"shift": ", ".join(map(str, shift)), "scale": 2 / np.linalg.norm(high - low)}
    return scene, {"mesh": file.resolve(), "kind": kind, "res": res, **numbers}


def camera_rays(scene, res):
    """Return origins and directions (N, 3) of rays through every pixel's center and a random point on the lens."""
    middles = (np.stack(np.meshgrid(range(res), range(res)), -1).reshape(-1, 2) + 0.5) / res
    lens = np.random.default_rng(0).random((len(middles), 2))
    rays = jax.vmap(scene.camera.sample_ray)(np.float32(middles), np.float32(lens))
    return np.asarray(rays.o), np.asarray(rays.d)


def figures_of(scene, rule, rays):
    """Return a line of the table."""
    tree = scene.about.trees["triangle"]  # triangles are the last of the tables
    found = walk(tree, scene.geometry.tables[-1].vertices, *rays)
    counts = (np.mean(count) for count in (found.nodes, found.boxes, found.leaves, found.triangles))
    cells = " ".join(f"{count:9.2f}" for count in counts)
    return f"{rule:8}{len(tree.child):7}{len(tree.leaf_first):8}{tree.depth:7}{tree.sah_cost:10.2f} {cells}"


def boxes_by_level(tree):
    """Return [(n, 2, 3)] lo and hi of the boxes of each level: the root's, then the children of each level of nodes."""
    inside = [np.stack([np.nanmin(tree.bounds[:1, 0], -1), np.nanmax(tree.bounds[:1, 1], -1)], 1)]
    nodes = np.zeros(1, int)
    while len(nodes):
        node, slot = np.nonzero(tree.child[nodes])
        inside.append(tree.bounds[nodes[node], :, :, slot])
        children = tree.child[nodes[node], slot]
        nodes = children[children > 0]
    return inside


def draw_boxes(picture, camera, levels, first=0):
    """Draw the edges of boxes over a picture. levels: boxes of levels first, first + 1, ..., which set the colours."""
    large = picture.resize((picture.width * SMOOTH, picture.height * SMOOTH), Image.Resampling.BICUBIC)
    draw = ImageDraw.Draw(large)
    corners = np.indices((2, 2, 2)).reshape(3, 8)
    edges = [(a, b) for a in range(8) for b in range(a) if (corners[:, a] != corners[:, b]).sum() == 1]
    origin, axes, corner, extent = (np.asarray(x) for x in (camera.origin, camera.axes, camera.corner, camera.extent))
    for level, boxes in reversed([*enumerate(levels, first)]):
        points = np.stack([boxes[:, corners[axis], axis] for axis in range(3)], -1)
        local = (points - origin) @ axes.T
        on_film = (local[..., :2] / local[..., 2:] - corner) / extent * large.size
        for box in on_film:
            for a, b in edges:
                draw.line([*box[a], *box[b]], fill=COLORS[level % len(COLORS)], width=SMOOTH)
    return large.resize(picture.size, Image.Resampling.LANCZOS)


def encode(image):
    """Convert linear RGB to an enlarged PIL image."""
    values = np.clip(np.asarray(image), 0, 1) ** (1 / GAMMA)
    picture = Image.fromarray(np.rint(values * 255).astype(np.uint8))
    return picture.resize((picture.width * ZOOM, picture.height * ZOOM), Image.Resampling.BICUBIC)


def labelled(picture, text):
    ImageDraw.Draw(picture).text((8, 6), text, fill="white", stroke_fill="black", stroke_width=2, font_size=18)
    return picture


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", type=Path, default=SCENES / "meshes" / "knot.ply", help=".obj, .ply, .stl or .glb")
    parser.add_argument("--res", type=int, default=280)
    parser.add_argument("--spp", type=int, default=256)
    parser.add_argument("-o", "--output", type=Path, default=Path("original_results.png"))
    options = parser.parse_args()

    box = encode(pj.render(pj.load_scene(SCENES / "triangle_box.xml", res=options.res), options.spp))
    file, parameters = describe(options.mesh, options.output, options.res)
    scenes = {rule: pj.load_scene(file, parameters=parameters, split_rule=rule) for rule in RULES}
    scene = scenes["sah"]
    if "triangle" not in scene.about.trees:
        parser.error(f"{options.mesh} has too few triangles for a hierarchy; give a mesh of 33 or more")
    rays = camera_rays(scene, options.res)
    print(f"{options.mesh.name}: {len(scene.geometry.tables[-1].vertices)} triangles; per ray of the camera:")
    print("rule      nodes  leaves  depth  SAH cost     nodes     boxes    leaves triangles")
    for rule in RULES:
        print(figures_of(scenes[rule], rule, rays))

    picture = encode(pj.render(scene, options.spp))
    levels = boxes_by_level(scene.about.trees["triangle"])
    dimmed = Image.blend(picture, Image.new("RGB", picture.size), 0.5)
    panels = [labelled(box, "box of triangles"), labelled(picture.copy(), options.mesh.stem)]
    panels.append(labelled(draw_boxes(dimmed, scene.camera, levels), "all levels"))
    for level, boxes in enumerate(levels[1:], 1):
        panels.append(labelled(draw_boxes(dimmed, scene.camera, [boxes], level), f"level {level}: {len(boxes)} boxes"))
    columns = 3
    size = columns * picture.width, -(-len(panels) // columns) * picture.height
    whole = Image.new("RGB", size, "white")
    for k, panel in enumerate(panels):
        whole.paste(panel, (k % columns * picture.width, k // columns * picture.height))
    whole.save(options.output)


if __name__ == "__main__":
    main()
