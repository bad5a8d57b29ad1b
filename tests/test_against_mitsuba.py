"""Images against Mitsuba 3, by z-tests of means and variances over seeds. Mitsuba runs in its own process."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import pathjax as pj
from pathjax.sensors.filters import Box

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted([*ROOT.glob("scenes/*.xml"), *ROOT.glob("tests/scenes/*.xml")])
QUICK = ("cornell_box",)
SEEDS = 24
SPP = 256
# Two float32 programs: their intersections and offsets differ by some 1e-6 of the scene's size, which shifts edges and
# contacts by less than this.
ROUNDING = 1e-3


@pytest.fixture
def with_border(tmp_path):
    """(scene file) -> path of a copy whose pixels also sample beyond the border of the film."""

    def copy(path):
        for folder in ("meshes", "textures"):
            if (path.parent / folder).exists():
                (tmp_path / folder).symlink_to(path.parent / folder)
        film = '<film type="hdrfilm">'
        text = path.read_text()
        assert text.count(film) == 1
        (tmp_path / path.name).write_text(text.replace(film, film + '<boolean name="sample_border" value="true"/>'))
        return tmp_path / path.name

    return copy


def double_variant():
    """Return a double-precision RGB variant of Mitsuba, or None if this build has none."""
    mi = pytest.importorskip("mitsuba")
    return next((name for name in mi.variants() if name.endswith("rgb_double")), None)


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=() if path.stem in QUICK else pytest.mark.slow)
        for path in FILES
        if path.stem != "nine_spheres"
    ],
)
def test_image_agrees_with_mitsuba(path, with_border, mitsuba, estimate, agree):
    path = with_border(path)
    scene = pj.load_scene(path, res=32)
    # Mitsuba's wide filters share samples between neighbours: pixels are then correlated, and their mean varies more
    # than the pixels' variances suggest.
    independent = isinstance(scene.film.filter, Box)
    ours, theirs = estimate(scene, SPP, SEEDS), mitsuba(path, SPP, SEEDS, res=32)
    agree(ours, theirs, whole=independent, rounding=ROUNDING)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["gaussian", "mitchell", "catmullrom", "lanczos"])
def test_images_through_other_filters_agree_with_mitsuba(kind, with_border, mitsuba, estimate, agree):
    """The border of the lamp shows the filter's lobes."""
    path = with_border(ROOT / "scenes" / "cornell_box.xml")
    path.write_text(path.read_text().replace('<rfilter type="box"/>', f'<rfilter type="{kind}"/>'))
    ours, theirs = estimate(pj.load_scene(path, res=32), SPP, SEEDS), mitsuba(path, SPP, SEEDS, res=32)
    agree(ours, theirs, whole=False, rounding=ROUNDING)


@pytest.mark.slow
def test_nine_spheres_agree_with_double_precision(shipped, mitsuba, estimate, agree, x64):
    """Mitsuba's single precision is 3 to 10 % too dark among walls of radius 1e5, so it is no reference here. Where
    its build has no double precision (the wheels have none), the reference is pathjax in float64 with other seeds."""
    single = estimate(shipped("nine_spheres", res=32), spp=SPP, count=SEEDS)
    if variant := double_variant():
        double = mitsuba(ROOT / "scenes" / "nine_spheres.xml", SPP, SEEDS, variant, res=32)
    else:
        with x64():
            double = estimate(shipped("nine_spheres", jnp.float64, res=32), spp=SPP, count=SEEDS, first_seed=1001)
    # Points on these walls have float32 errors of 0.008 in a box of 80: corners and contacts move by as much.
    agree(single, double, rounding=3e-3)


def test_the_comparison_notices_a_bias_of_one_percent(shipped, estimate, agree):
    scene = shipped("cornell_box", res=32)
    brighter = pj.with_parameters(scene, {"light.radiance": 1.01 * np.asarray(pj.parameters(scene)["light.radiance"])})
    one, other = (estimate(each, spp=64, first_seed=seed) for each, seed in ((scene, 1), (brighter, 101)))
    with pytest.raises(AssertionError, match="disagree"):
        agree(one, other, rounding=ROUNDING)


def test_the_comparison_notices_one_wrong_pixel(shipped, estimate, agree):
    image = estimate(shipped("cornell_box", res=32), spp=64)
    spoiled = image.mean.copy()
    spoiled[20, 9] *= 1.5
    with pytest.raises(AssertionError, match="pixels disagree"):
        agree(image, estimate(shipped("cornell_box", res=32), spp=64, first_seed=101)._replace(mean=spoiled))
