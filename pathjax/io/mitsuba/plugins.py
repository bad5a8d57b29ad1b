"""Names of Mitsuba's plugins, to distinguish plugins that are not modelled from misspelt names."""

from __future__ import annotations

# Tag of an element -> names.
PLUGINS = {
    tag: frozenset(names.split())
    for tag, names in {
        "integrator": "aov depth direct direct_projective moment path prb prb_basic prb_projective prbvolpath ptracer "
        "stokes volpath volpathmis volprim_rf_basic",
        "sensor": "batch circular distant irradiancemeter orthographic perspective radiancemeter thinlens",
        "sampler": "independent ldsampler multijitter orthogonal stratified",
        "film": "hdrfilm specfilm",
        "rfilter": "box catmullrom gaussian lanczos mitchell tent",
        "shape": "bsplinecurve cube cylinder disk ellipsoids ellipsoidsmesh instance linearcurve merge obj ply "
        "rectangle sdfgrid serialized shapegroup sphere",
        "bsdf": "blendbsdf bumpmap circular conductor dielectric diffuse hair mask measured measured_polarized "
        "normalmap null plastic polarizer pplastic principled principledthin retarder roughconductor roughdielectric "
        "roughplastic thindielectric twosided",
        "texture": "bitmap checkerboard mesh_attribute uniform volume",
        "medium": "heterogeneous homogeneous",
        "phase": "blendphase hg isotropic rayleigh sggx tabphase",
        "volume": "constvolume gridvolume",
        "emitter": "area constant directional directionalarea envmap point projector spot sunsky timed_sunsky",
    }.items()
}

_MEASURED = "files of measured reflectance are not read"
# Why some of these are not modelled; others are reported as not supported yet.
REASONS = {
    "measured_polarized": _MEASURED,
    "specfilm": "images are linear RGB",
    "depth": "it shows distances, which `pathjax render --aov depth` writes",
    "volprim_rf_basic": "ellipsoids that emit are not modelled",
    "hair": "it stands on curves, which no ray is tested against",
    "bsplinecurve": "rays are not tested against curves",
    "linearcurve": "rays are not tested against curves",
    "sdfgrid": "rays are not tested against grids of distances",
    "measured": _MEASURED,
    "directionalarea": "each point shines in one direction, which no path from the camera meets",
    "timed_sunsky": "light does not change with time; <emitter type=\"sunsky\"> is its sky at one time",
}
