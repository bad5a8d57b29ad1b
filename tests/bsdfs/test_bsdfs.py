"""Densities and weights of samples, energy, reciprocity, Snell's law, sides of surfaces, and kinds of users."""

from __future__ import annotations

import subprocess
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import pathjax as pj
from pathjax import bsdfs, testing
from pathjax.bsdfs import Conductor, Dielectric, Diffuse, TwoSided
from pathjax.kinds import Color, Number, Parameters, Row

# Chance that a correct bsdf fails one of the statistical tests here; seeds are fixed.
FALSE_ALARM = 1e-4
ALBEDO = np.array([0.9, 0.5, 0.1])
SURFACE = SimpleNamespace(uv=jnp.zeros(2))
METAL = {"eta": np.array([0.2, 0.9, 1.1]), "k": np.array([3.9, 2.4, 2.1])}


def table_of(*instances, dtype=np.float32):
    """Return the table of bsdfs of one kind."""
    (table,) = bsdfs.build(list(instances), dtype, (), Parameters()).tables
    return jax.device_put(table)


def uniform(*shape, seed=1):
    return jnp.asarray(np.random.default_rng(seed).integers(0, 1 << 24, shape) * 2.0**-24, jnp.float32)


def directions(n, seed=2, upper=True):
    w = np.random.default_rng(seed).normal(size=(n, 3))
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    w[:, 2] = np.abs(w[:, 2]) if upper else w[:, 2]
    return jnp.asarray(w, jnp.float32)


@partial(jax.jit, static_argnames="other")
def _draw(table, row, wi, u, other=False):
    how = {"other": True} if other else {}
    return jax.vmap(lambda wi, u: table.kind.sample(Row(table, row), wi, u, **how))(wi, u)


def draw(table, wi, u, row=0, other=False):
    drawn = _draw(table, row, wi, u, other)
    return jax.tree.map(lambda x: np.asarray(x, np.float64) if x.dtype != bool else np.asarray(x), drawn)


@pytest.mark.parametrize(
    "kind, values",
    [
        (Diffuse, {"reflectance": ALBEDO}),
        (Diffuse, {"reflectance": 1.0}),
        (Diffuse, {"reflectance": 0.0}),
        (Dielectric, {}),
        (Dielectric, {"int_ior": 1.0, "ext_ior": 1.33}),
        (Conductor, {}),
        (Conductor, METAL),
    ],
)
def test_kinds_of_the_package_pass_the_checks_that_users_get(kind, values):
    testing.check_bsdf(kind, false_alarm=FALSE_ALARM, **values)


# ---- the checks themselves ------------------------------------------------------------------------------------------


class Uneven(Diffuse):
    """Samples the upper hemisphere uniformly, but reports the density of cosine sampling."""

    @staticmethod
    def sample(p, wi, u):
        drawn = Diffuse.sample(p, wi, u)
        z = u[0]
        r, phi = jnp.sqrt(1 - z * z), 2 * jnp.pi * u[1]
        wo = jnp.stack([r * jnp.cos(phi), r * jnp.sin(phi), z])
        f, pdf = Diffuse.evaluate(p, wi, wo)
        return drawn._replace(wo=wo, weight=f / jnp.maximum(pdf, 1e-9), pdf=pdf)


class Glowing(Diffuse):
    """Scatters 1.2 times the light that arrives."""

    @staticmethod
    def evaluate(p, wi, wo):
        f, pdf = Diffuse.evaluate(p, wi, wo)
        return 1.2 * f, pdf

    @staticmethod
    def sample(p, wi, u):
        drawn = Diffuse.sample(p, wi, u)
        return drawn._replace(weight=1.2 * drawn.weight)


class OneWay(Diffuse):
    """Not reciprocal."""

    @staticmethod
    def evaluate(p, wi, wo):
        f, pdf = Diffuse.evaluate(p, wi, wo)
        return f * wi[2], pdf

    @staticmethod
    def sample(p, wi, u):
        drawn = Diffuse.sample(p, wi, u)
        return drawn._replace(weight=drawn.weight * wi[2])


class Numb(Diffuse):
    """The weight has no derivative in the reflectance."""

    @staticmethod
    def sample(p, wi, u):
        drawn = Diffuse.sample(p, wi, u)
        return drawn._replace(weight=jax.lax.stop_gradient(drawn.weight))


class Attached(Diffuse):
    """The density has a derivative in the reflectance."""

    @staticmethod
    def sample(p, wi, u):
        drawn = Diffuse.sample(p, wi, u)
        return drawn._replace(pdf=drawn.pdf + (p.reflectance[0] - jax.lax.stop_gradient(p.reflectance[0])))


class Grazing(Diffuse):
    """Divides by a cosine that may be 0."""

    @staticmethod
    def sample(p, wi, u):
        drawn = Diffuse.sample(p, wi, u)
        return drawn._replace(weight=drawn.weight * (wi[2] / wi[2]))


@pytest.mark.parametrize(
    "kind, complaint",
    [
        (Uneven, "do not follow|where the density is 0"),
        (Glowing, "of the light is scattered"),
        (OneWay, "the other"),
        (Numb, "derivative in reflectance is"),
        (Attached, "stop_gradient"),
        (Grazing, "weight of wi"),
    ],
)
def test_a_fault_of_a_bsdf_is_found_and_named(kind, complaint):
    values = {"reflectance": 1.0} if kind is Glowing else {}
    with pytest.raises(AssertionError, match=complaint):
        testing.check_bsdf(kind, samples=20_000, **values)


# ---- diffuse --------------------------------------------------------------------------------------------------------


def test_diffuse_is_black_below_the_surface():
    up = jnp.array([0.6, 0.0, 0.8])
    f, pdf = Diffuse.evaluate(Row(table_of(Diffuse.instance()), 0), up, -up)
    assert not f.any() and pdf == 0


def test_diffuse_white_furnace_returns_the_albedo():
    # Midpoints in z and azimuth: exact for the linear integrand.
    z = (np.arange(64) + 0.5) / 64
    wo = jnp.asarray(np.stack([np.sqrt(1 - z**2), 0 * z, z], -1), jnp.float32)
    p = Row(table_of(Diffuse.instance(reflectance=ALBEDO)), 0)
    f = np.asarray(jax.vmap(lambda wo: Diffuse.evaluate(p, wo, wo)[0])(wo), np.float64)
    np.testing.assert_allclose(f.mean(0) * 2 * np.pi, ALBEDO, rtol=1e-6)


def test_diffuse_derivative_in_the_albedo_is_right_at_zero():
    up = jnp.array([0.6, 0.0, 0.8])
    table = table_of(Diffuse.instance())

    def of(albedo):
        p = Row(table.with_column("reflectance", albedo[None]), 0)
        return Diffuse.sample(p, up, jnp.array([0.2, 0.3])).weight

    np.testing.assert_array_equal(jax.jacfwd(of)(jnp.zeros(3)), np.eye(3))


# ---- dielectric -----------------------------------------------------------------------------------------------------

IORS = ((1.5, 1.0), (1.0, 1.0), (1.33, 1.5))
RATIO = [inside / outside for inside, outside in IORS]
GLASS = table_of(*(Dielectric.instance(int_ior=inside, ext_ior=outside) for inside, outside in IORS))


def test_dielectric_reflects_as_often_as_fresnel_says():
    n = 100_000
    for row, cos in ((0, 0.9), (0, 0.1), (0, -0.8), (2, 0.6), (2, -0.3)):
        wi = jnp.broadcast_to(jnp.array([np.sqrt(1 - cos**2), 0, cos], jnp.float32), (n, 3))
        drawn = draw(GLASS, wi, uniform(n, 2, seed=row + 10), row)
        reflected = drawn.wo[:, 2] * cos > 0
        pdf = drawn.pdf[reflected]
        assert len(np.unique(pdf)) == 1 and drawn.delta.all()
        assert stats.binomtest(int(reflected.sum()), n, float(pdf[0])).pvalue > FALSE_ALARM
        np.testing.assert_allclose(drawn.pdf[~reflected], 1 - pdf[0], rtol=1e-6)


@pytest.mark.parametrize("row", [0, 1, 2])
def test_dielectric_obeys_snell_and_scales_radiance(row):
    n = 20_000
    wi = directions(n, upper=False)
    drawn = draw(GLASS, wi, uniform(n, 2), row)
    wi = np.asarray(wi, np.float64)
    np.testing.assert_allclose(np.linalg.norm(drawn.wo, axis=1), 1, atol=2e-6)
    reflected = drawn.wo[:, 2] * wi[:, 2] > 0
    np.testing.assert_array_equal(drawn.wo[reflected], wi[reflected] * [-1, -1, 1])
    assert (drawn.weight[reflected] == 1).all() and (drawn.passive[reflected] == 1).all()

    eta = RATIO[row] ** np.where(wi[:, 2] > 0, 1.0, -1.0)[~reflected]
    np.testing.assert_allclose(drawn.wo[~reflected, :2] * eta[:, None], -wi[~reflected, :2], atol=1e-6)
    np.testing.assert_allclose(drawn.weight[~reflected], np.repeat(1 / eta[:, None] ** 2, 3, 1), rtol=1e-6)
    np.testing.assert_allclose(drawn.passive[~reflected], 1 / eta**2, rtol=1e-6)
    assert reflected.any() == (row != 1)


def test_dielectric_reflects_totally_beyond_the_critical_angle():
    cos = np.linspace(-np.sqrt(1 - 1 / 1.5**2) + 1e-4, 0, 1000)
    wi = jnp.asarray(np.stack([np.sqrt(1 - cos**2), 0 * cos, cos], -1), jnp.float32)
    drawn = draw(GLASS, wi, jnp.full((1000, 2), 1 - 2**-24, jnp.float32))
    np.testing.assert_array_equal(drawn.wo, np.asarray(wi) * [-1, -1, 1])
    assert (drawn.weight == 1).all() and (drawn.pdf == 1).all()


def test_dielectric_of_equal_media_is_invisible_at_any_angle():
    cos = np.geomspace(1e-4, 1, 1000)
    wi = jnp.asarray(np.stack([np.sqrt(1 - cos**2), 0 * cos, cos], -1), jnp.float32)
    drawn = draw(GLASS, wi, uniform(1000, 2), row=1)
    np.testing.assert_allclose(drawn.wo, -np.asarray(wi, np.float64), atol=2e-6)


def test_dielectric_returns_all_energy():
    """The weight, times eta^2 where refracted, is the share of power, which is 1 for every sample."""
    wi = directions(10_000, upper=False)
    drawn = draw(GLASS, wi, uniform(10_000, 2))
    z = np.asarray(wi)[:, 2]
    eta = np.where(drawn.wo[:, 2] * z > 0, 1, np.where(z > 0, 1.5, 1 / 1.5))
    np.testing.assert_allclose(drawn.weight * eta[:, None] ** 2, 1, rtol=1e-6)


@pytest.mark.parametrize("fresnel", bsdfs.FRESNEL)
@pytest.mark.parametrize("row", [0, 1, 2])
def test_dielectric_and_its_other_branch_share_the_light(row, fresnel):
    """One branch reflects and the other refracts; an impossible branch has pdf 0."""
    glass, n = GLASS.with_setting("fresnel", fresnel), 10_000
    wi, u = directions(n, upper=False), uniform(n, 2)
    drawn = draw(glass, wi, u, row)
    other = draw(glass, wi, u, row, other=True)
    z = np.asarray(wi)[:, 2]
    eta = RATIO[row] ** np.sign(z)
    power = [b.pdf * b.weight[:, 0] * np.where(b.wo[:, 2] * z > 0, 1, eta**2) for b in (drawn, other)]
    np.testing.assert_allclose(sum(power), 1, atol=1e-6)
    possible = other.pdf > 0
    assert ((drawn.wo[:, 2] * other.wo[:, 2] < 0) | ~possible).all()
    assert possible.any() == (row != 1 or fresnel == "schlick")


# ---- conductor ------------------------------------------------------------------------------------------------------


def test_conductor_mirrors_and_weighs_by_fresnel():
    eta, k = METAL["eta"], METAL["k"]
    mirror = Conductor.instance(specular_reflectance=np.array([0.9, 0.8, 0.7]))
    table = table_of(Conductor.instance(eta=eta, k=k), mirror)
    wi = directions(1000)
    drawn = draw(table, wi, uniform(1000, 2))
    np.testing.assert_array_equal(drawn.wo, np.asarray(wi) * [-1, -1, 1])
    n, cos = eta + 1j * k, np.asarray(wi, np.float64)[:, 2:]
    cos_t = np.sqrt(1 - (1 - cos**2) / n**2)
    r = (abs((cos - n * cos_t) / (cos + n * cos_t)) ** 2 + abs((n * cos - cos_t) / (n * cos + cos_t)) ** 2) / 2
    np.testing.assert_allclose(drawn.weight, r, atol=3e-6)
    assert drawn.delta.all() and (drawn.pdf == 1).all() and (drawn.weight <= 1 + 1e-6).all()
    ideal = draw(table, wi, uniform(1000, 2), row=1)
    np.testing.assert_allclose(ideal.weight, np.broadcast_to([0.9, 0.8, 0.7], (1000, 3)), rtol=1e-6)


# ---- dispatch -------------------------------------------------------------------------------------------------------


def test_sides_of_a_shape_are_told_apart():
    red = Diffuse.instance("red", reflectance=np.array([1.0, 0, 0]))
    green = Diffuse.instance("green", reflectance=np.array([0, 1.0, 0]))
    mirror = Conductor.instance("mirror", specular_reflectance=np.array([0.5, 0.6, 0.7]))
    glass = Dielectric.instance("glass", int_ior=1.5, ext_ior=1.0)
    shapes = [red, TwoSided.of("t", red, green), TwoSided.of("u", mirror, red), glass]
    materials = jax.device_put(bsdfs.build(shapes, np.float32, (), Parameters()))
    wi, u = jnp.array([0.6, 0, 0.8]), jnp.array([0.999, 0.3])

    @jax.jit
    def draw_side(shape, front):
        kind, row = bsdfs.select(materials, shape, front)
        drawn = bsdfs.sample(materials, kind, row, SURFACE, wi, u)
        return kind, drawn, bsdfs.has(materials, kind, "smooth"), bsdfs.has(materials, kind, "sided")

    def weight(shape, front):
        kind, drawn, smooth, _ = draw_side(shape, front)
        return int(kind), np.asarray(drawn.weight), bool(smooth)

    np.testing.assert_array_equal(weight(0, True)[1], [1, 0, 0])
    assert weight(0, False)[0] == -1  # one-sided: absorbs
    np.testing.assert_array_equal(weight(1, False)[1], [0, 1, 0])
    np.testing.assert_allclose(weight(2, True)[1], [0.5, 0.6, 0.7])
    assert weight(2, True)[2] is False and weight(2, False)[2] is True
    for front in (True, False):
        _, drawn, _, glass = draw_side(3, front)
        assert glass
        np.testing.assert_allclose(drawn.weight, 1 / 1.5**2, rtol=1e-6)


# ---- kinds of users -------------------------------------------------------------------------------------------------

SCENE = """<scene version="3.0.0">
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
  </sensor>
  <shape type="sphere"><bsdf type="TYPE" id="it"><rgb name="reflectance" value="0.8, 0.5, 0.3"/></bsdf></shape>
  <emitter type="constant" id="sky"/>
</scene>"""


@pytest.fixture
def kinds(monkeypatch):
    """Yield the table of kinds, which is restored after the test."""
    monkeypatch.setattr(bsdfs, "KINDS", dict(bsdfs.KINDS))
    return bsdfs.KINDS


def load(tmp_path, kind):
    file = tmp_path / f"{kind}.xml"
    file.write_text(SCENE.replace("TYPE", kind))
    return pj.load_scene(file)


class Copy(bsdfs.BSDF):
    """The package's diffuse bsdf, written by a user."""

    reflectance = Color(0.5)
    smooth = True
    evaluate, sample = Diffuse.evaluate, Diffuse.sample


def test_a_users_kind_compiles_to_the_very_program_of_the_packages(tmp_path, kinds):
    bsdfs.register("copy")(Copy)
    ours, theirs = load(tmp_path, "diffuse"), load(tmp_path, "copy")

    def program(scene):
        return jax.jit(lambda scene: pj.render(scene, spp=4)).lower(scene).as_text()

    assert program(theirs) == program(ours)
    np.testing.assert_array_equal(pj.render(theirs, spp=4), pj.render(ours, spp=4))


def test_a_users_kind_is_differentiated_and_told_by_info(tmp_path, kinds):
    bsdfs.register("copy")(Copy)
    scene = load(tmp_path, "copy")
    assert list(pj.parameters(scene)) == ["it.reflectance", "sky.radiance"]
    _, jacobian = pj.jacobian(scene, ["it.reflectance"], spp=4)
    _, expected = pj.jacobian(load(tmp_path, "diffuse"), ["it.reflectance"], spp=4)
    np.testing.assert_array_equal(jacobian["it.reflectance"], expected["it.reflectance"])
    assert bsdfs.name(scene.materials, 0) == "copy"


def test_what_a_users_kind_does_not_declare_is_refused_with_what_it_has(tmp_path, kinds):
    class Shiny(bsdfs.BSDF):
        shine = Number(1.0, bounds=(0, 2))
        sample = Diffuse.sample

    bsdfs.register("shiny")(Shiny)
    with pytest.raises(pj.InputError, match='"reflectance"> is not a parameter of <bsdf type="shiny">; it has: shine'):
        load(tmp_path, "shiny")


def test_a_name_is_taken_once_but_a_cell_may_run_again(kinds):
    def define():
        class Mine(bsdfs.BSDF):
            sample = Diffuse.sample

        return Mine

    bsdfs.register("mine")(define())
    again = bsdfs.register("mine")(define())
    assert kinds["mine"] is again
    with pytest.raises(pj.InputError, match="taken by Diffuse"):
        bsdfs.register("diffuse")(again)
    with pytest.raises(pj.InputError, match="derived from bsdfs.BSDF"):
        bsdfs.register("other")(dict)


def test_colours_below_their_bound_are_refused(tmp_path, kinds):
    class Pale(Diffuse):
        reflectance = Color(0.9, bounds=(0.4, 1))

    bsdfs.register("pale")(Pale)
    with pytest.raises(pj.InputError, match=r'pale.xml:6: "reflectance" .* must be at least 0.4, is 0.8, 0.5, 0.3'):
        load(tmp_path, "pale")


def test_each_kind_gets_as_many_numbers_as_it_takes(tmp_path, kinds):
    taken = {}

    class Lobed(Diffuse):
        lobes = True

        @staticmethod
        def sample(p, wi, u):
            taken["lobed"] = u.shape
            return Diffuse.sample(p, wi, u[:2])

    class Plain(Diffuse):
        @staticmethod
        def sample(p, wi, u):
            taken["plain"] = u.shape
            return Diffuse.sample(p, wi, u)

    materials = bsdfs.build([Lobed.instance("a"), Plain.instance("b")], np.float32, (), Parameters())
    one = jnp.int32(0)
    bsdfs.sample(materials, one, one, SURFACE, jnp.array([0.6, 0, 0.8]), jnp.array([0.1, 0.2, 0.3]))
    assert taken == {"lobed": (3,), "plain": (2,)}


PACKAGE = Path(pj.__file__).parent
ONE_MORE = """from pathjax.bsdfs.diffuse import Diffuse
from pathjax.kinds import Color


class Paper(Diffuse):
    whiteness = Color(1.0)
"""
USE = """
import sys
import pathjax as pj
scene = pj.load_scene(sys.argv[1])
assert "it.whiteness" in pj.parameters(scene), list(pj.parameters(scene))
image, jacobian = pj.jacobian(scene, ["it.reflectance"], spp=1)
assert image.shape == (8, 8, 3)
"""


def test_a_bsdf_is_added_by_its_file_and_one_row(tmp_path):
    """With no other edit to a copy of the package, the bsdf is loaded, listed, rendered and differentiated."""
    copy = tmp_path / "pathjax"
    subprocess.run(["cp", "-r", str(PACKAGE), str(copy)], check=True)
    (copy / "bsdfs/paper.py").write_text(ONE_MORE)
    room = copy / "bsdfs/__init__.py"
    row = '    "diffuse": Diffuse,\n'
    text = room.read_text()
    assert text.count(row) == 1
    # The row needs an import.
    text = text.replace(row, row + '    "paper": Paper,\n')
    first = "from pathjax.bsdfs.diffuse"
    text = text.replace(first, "from pathjax.bsdfs.paper import Paper\n" + first)
    room.write_text(text)
    (tmp_path / "scene.xml").write_text(SCENE.replace("TYPE", "paper"))
    run = [sys.executable, "-c", USE, str(tmp_path / "scene.xml")]
    done = subprocess.run(run, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
