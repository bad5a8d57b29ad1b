"""Read shapes, lights and sensors with the objects that their elements hold besides the parameters of their kind.

`loader.make` calls these functions in place of a kind's own `read`.
"""

from __future__ import annotations

from dataclasses import replace

from pathjax import description as d
from pathjax import emitters, sensors
from pathjax.description.elements import Element
from pathjax.description.fields import Fields
from pathjax.io.mitsuba import samplers
from pathjax.kinds import Instance
from pathjax.sensors import Sensor, film
from pathjax.shapes import KINDS as SHAPES
from pathjax.textures import mesh_attribute


def shape(loader, fields: Fields, name: str) -> d.Shape | None:
    """Read a shape. None: all triangles of a mesh are degenerate, so that no ray hits it and it does not emit."""
    geometry = SHAPES[fields.type].read(loader, fields)
    flip_normals = fields.boolean("flip_normals", False) != geometry.mirrored
    emitter = None
    for element in fields.objects("emitter"):
        other = loader.on_shapes.setdefault(element, fields.element)
        if other is not fields.element:
            raise fields.element.error(f"{element} shines from {other} already, at {other.place}; give each its own")
        emitter = loader.emitter(element, element.id or name, inside=True)
    meters = fields.objects("sensor")
    inherited = fields.element.id or None
    (nested,) = fields.objects("bsdf") or [_usual_bsdf(fields.element, lit=emitter is not None)]
    bsdf = loader.bsdf(nested, nested.id or inherited or loader.numbered("bsdf"))
    interior, exterior = (_side(loader, fields, name, side) for side in ("interior", "exterior"))
    for medium in fields.objects("medium", limit=1):
        sides = '<medium name="interior"> and one <medium name="exterior">'
        raise medium.error(f"{fields.element} takes one {sides}, themselves or by <ref>, and no other <medium>")
    if interior or exterior:
        _note_boundary(loader, fields.element, geometry, bsdf)
    if why := mesh_attribute.fault(bsdf, geometry.attributes):
        raise fields.element.error(f"{fields.element} {why}")
    made = d.Shape(name, geometry, bsdf, emitter, flip_normals, interior, exterior)
    if geometry.empty:
        light = "" if emitter is None else ", and its light too"
        loader.note(fields.element, f"is left out, as no triangle has an area{light}")
        made = None
    loader.on_surfaces.update(dict.fromkeys(meters, (fields.element, made)))
    return made


def _side(loader, fields: Fields, name: str, side: str) -> Instance | None:
    """Return the medium on one side of a shape; None: there is none."""
    element = fields.object("medium", side)
    return None if element is None else loader.shared(element, element.id or f"{name}_{side}")


def _note_boundary(loader, shape: Element, geometry: object, bsdf: Instance) -> None:
    """Add notes on probable mistakes at the boundary of a medium."""
    if not geometry.closed:
        loader.note(shape, "bounds a medium and is open: paths that go around it stay in the medium that they were in")
    if not any(leaf.kind.passes or leaf.kind.sided for leaf in bsdf.kind.leaves(bsdf)):
        loader.note(shape, 'bounds a medium and lets no light in; <bsdf type="null"/> inside lets it pass')


def emitter(loader, fields: Fields, name: str) -> Instance:
    for medium in fields.objects("medium"):
        loader.note(medium, f"has no effect inside {fields.element}: paths come from the camera")
    return emitters.KINDS[fields.type].read(loader, fields, name)


def _usual_bsdf(shape: Element, lit: bool) -> Element:
    """Add the bsdf that Mitsuba gives a shape without one: diffuse, grey or, if the shape emits, black."""
    reflectance = Element("float", {"name": "reflectance", "value": "0" if lit else "0.5"}, shape.file, shape.line)
    shape.children.append(Element("bsdf", {"type": "diffuse"}, shape.file, shape.line, [reflectance]))
    return shape.children[-1]


def sensor(loader, fields: Fields) -> d.View:
    camera = sensors.KINDS[fields.type].read(loader, fields)
    films, drawn = fields.objects("film"), fields.objects("sampler")
    made = loader.make(films[0], film.KINDS) if films else film.HDRFilm()
    if camera.one_pixel:
        if (made.width, made.height) != (1, 1):
            place = films[0] if films else fields.element
            raise place.error(f"{fields.element} measures one number: its film must have width and height 1")
        made = replace(made, filter=sensors.filters.Box())
    if made.width % camera.parts:
        place = films[0] if films else fields.element
        raise place.error(f"{fields.element} has {camera.parts} sensors; the width must be a multiple of that")
    spp = loader.make(drawn[0], samplers.KINDS) if drawn else samplers.DEFAULT_COUNT
    sampler = drawn[0].attributes["type"] if drawn else "independent"
    around = fields.objects("medium")
    medium = loader.shared(around[0], around[0].id or "sensor_medium") if around else None
    return d.View(camera, made, spp, sampler, medium)


def inner_sensor(loader, fields: Fields) -> Sensor:
    for tag, kinds in (("film", film.KINDS), ("sampler", samplers.KINDS)):
        for element in fields.objects(tag):
            loader.make(element, kinds)
            loader.note(element, "has no effect inside a sensor that is part of another")
    return sensors.KINDS[fields.type].read(loader, fields)
