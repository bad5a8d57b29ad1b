"""Fixtures shared by the tests of rendering: scenes from text, replicated renders, and the z-test between images."""

from __future__ import annotations

import atexit
import functools
import gc
import os
import shutil
import signal
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

# The workers of a run and the processes that they start share a compilation cache in a folder that is deleted after the
# run. Set before JAX is imported, which reads these variables then.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _shared = tempfile.mkdtemp(prefix="pathjax-tests-")
    atexit.register(shutil.rmtree, _shared, ignore_errors=True)
    os.environ |= {"JAX_COMPILATION_CACHE_DIR": _shared, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}

# The workers share the processors: BLAS threads of one worker would wait for those of the others.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pathjax  # before anything starts JAX's backend  # isort: skip
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from pathjax.bench import peers
from pathjax.compile import on_all_devices
from pathjax.derivatives import jacobian, tangents
from pathjax.integrators import pixel
from pathjax.integrators.options import DEFAULTS
from pathjax.io.mitsuba import loader as mitsuba_xml
from pathjax.rendering.render import pixel_means
from pathjax.scene import build
from pathjax.scene.parameters import nameless
from pathjax.sensors import film

os.environ["PATHJAX_CACHE"] = "0"  # tests leave the user's cache of kernels alone

# Traced programs are many objects that live on: collecting garbage as often as Python does by default takes a quarter
# of the time of tracing.
gc.set_threshold(50_000, 20, 50)

ROOT = Path(__file__).resolve().parents[1]

# Chance that a correct comparison of two images fails. Seeds are fixed, so a test fails either always or never.
FALSE_ALARM = 1e-4
# Relative float32 rounding error in the mean of a pixel; smaller differences are no disagreement.
ROUNDING = 1e-5


@pytest.fixture(scope="session", autouse=True)
def interrupts_are_heard():
    """Handle SIGINT and SIGTERM, which some tests send: shells may start background processes with both ignored."""
    for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL)):
        if signal.getsignal(number) == signal.SIG_IGN:
            signal.signal(number, handler)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT, signal.SIGTERM))


@pytest.fixture
def compiled_anew():
    """Compile without the compilation cache, for tests that time compilation."""
    compilation_cache.reset_cache()  # JAX decides only once whether to use the cache
    jax.config.update("jax_enable_compilation_cache", False)
    yield
    jax.config.update("jax_enable_compilation_cache", True)
    compilation_cache.reset_cache()


class Compilations:
    """Counter of the programs that JAX's backend compiles."""

    def __init__(self):
        self.count, self.on = 0, True
        jax.monitoring.register_event_duration_secs_listener(self.hear)

    def hear(self, event, seconds, **_):
        self.count += self.on and event == "/jax/core/compile/backend_compile_duration"


@pytest.fixture
def compilations():
    counter = Compilations()
    jax.jit(lambda x: x + 1)(0)  # a new function, which no other test has compiled
    assert counter.count == 1  # the listener works
    yield counter
    counter.on = False


@pytest.fixture(scope="session")
def root():
    """The checkout."""
    return ROOT


def scene_text(
    body,
    *,
    res=16,
    depth=8,
    rr_depth=5,
    origin="0, 0, 4",
    target="0, 0, 0",
    up="0, 1, 0",
    fov=40,
    near=0.01,
    far=1e4,
    hide="false",
    film='<rfilter type="box"/>',
    integrator="path",
):
    """A scene file: pinhole camera, square image, and the given shapes and emitters."""
    return f"""<scene version="3.0.0">
<integrator type="{integrator}"><integer name="max_depth" value="{depth}"/><integer name="rr_depth" value="{rr_depth}"/>
  <boolean name="hide_emitters" value="{hide}"/></integrator>
<sensor type="perspective"><float name="fov" value="{fov}"/><float name="near_clip" value="{near}"/>
  <float name="far_clip" value="{far}"/>
  <transform name="to_world"><lookat origin="{origin}" target="{target}" up="{up}"/></transform>
  <sampler type="independent"/>
  <film type="hdrfilm"><integer name="width" value="{res}"/><integer name="height" value="{res}"/>{film}</film></sensor>
{body}
</scene>
"""


@pytest.fixture(scope="session")
def write_scene(tmp_path_factory):
    """(body, **camera) -> path of a scene file next to the meshes of the tests."""
    folder = tmp_path_factory.mktemp("scenes")
    (folder / "meshes").symlink_to(ROOT / "tests" / "scenes" / "meshes")
    numbers = iter(range(10**6))

    def write(body, **camera):
        path = folder / f"scene{next(numbers)}.xml"
        path.write_text(scene_text(body, **camera))
        return path

    return write


@pytest.fixture(scope="session")
def make_scene(write_scene):
    """(body, dtype, **camera) -> Scene."""

    def make(body, dtype=jnp.float32, **camera):
        return build(mitsuba_xml.load(write_scene(body, **camera)), dtype)

    return make


@pytest.fixture(scope="session")
def shipped():
    """(name, **parameters) -> Scene of `scenes/` or `tests/scenes/`."""

    def load(name, dtype=jnp.float32, **parameters):
        folders = ROOT / "scenes", ROOT / "tests" / "scenes"
        path = next(folder / f"{name}.xml" for folder in folders if (folder / f"{name}.xml").exists())
        return build(mitsuba_xml.load(path, **parameters), dtype)

    return load


@pytest.fixture(scope="session")
def x64():
    """A context in which JAX supports float64."""
    if hasattr(jax, "enable_x64"):
        return lambda: jax.enable_x64(True)
    from jax.experimental import enable_x64

    return enable_x64


class Kernel(NamedTuple):
    """A shipped scene at 16 pixels wide, compiled once for all tests that examine its kernel or its image.

    The program is the one that `render` compiles.
    """

    scene: pathjax.Scene
    compiled: jax.stages.Compiled

    def image(self, spp, seed=1):
        """(H, W, 3)."""
        return np.asarray(self.compiled(*arguments_of_render(self.scene, spp, seed)))


def arguments_of_render(scene, spp, seed):
    """Return the arguments that `render` passes to `pixel_means`."""
    pixels = film.pixels(scene.film)
    return on_all_devices(nameless(scene)), pixels, *pixel.numbers(pixels, 0, spp, seed), None


@pytest.fixture(scope="session")
def kernel_of(shipped):
    """(name, dtype) -> Kernel; compile and call float64 kernels under `x64`."""

    @functools.cache
    def compile(name, dtype=jnp.float32):
        scene = shipped(name, dtype, res=16)
        how = {"options": DEFAULTS, "shape": film.image_shape(scene.film)}
        return Kernel(scene, pixel_means.lower(*arguments_of_render(scene, 1, 1), **how).compile())

    return compile


class JacobianKernel(NamedTuple):
    """A shipped scene at 16 pixels wide, and its compiled kernel of image and derivatives."""

    scene: pathjax.Scene
    compiled: jax.stages.Compiled

    def __call__(self, spp, seed=1, first_sample=0, step=0.02):
        """Return pixel means (N, 3), derivatives in colours (N, T, 3) and in IORs (N, G, 3), and biases (N, G, 3)."""
        pixels = jnp.arange(film.pixel_count(self.scene.film), dtype=jnp.int32)
        numbers = pixel.numbers(pixels, first_sample, spp, seed)
        glass = self.compiled.in_avals[0][-1].shape
        return jax.tree.map(
            np.asarray, self.compiled(replace(self.scene, about=None), pixels, *numbers, jnp.full(glass, step))
        )


@pytest.fixture(scope="session")
def jacobian_kernel_of(shipped):
    """(name, which) -> JacobianKernel of all the scene's "colours", of its "glass" IORs, or of "both"."""

    @functools.cache
    def compile(name, which):
        scene = shipped(name, res=16)
        parameters = scene.about.parameters.values()
        glass = sorted({p.index[0] for p in parameters if p.moves_paths}) if which != "colours" else ()
        colors = [p for p in parameters if not p.moves_paths] if which != "glass" else ()
        wanted = jacobian.Wanted(tangents.places(colors), tuple(glass))
        pixels = jnp.arange(film.pixel_count(scene.film), dtype=jnp.int32)
        numbers = pixel.numbers(pixels, 0, 1, 1)
        steps = jnp.full(len(glass), 0.02)
        lowered = jacobian._jacobians.lower(
            replace(scene, about=None), pixels, *numbers, steps, wanted=wanted, options=DEFAULTS
        )
        return JacobianKernel(scene, lowered.compile())

    return compile


@pytest.fixture(scope="session")
def native_kernels():
    """(lowered or compiled program) -> number of compiled loops that its entry computation calls; it has none itself.

    Lowered programs are compiled without LLVM's optimisation, which is slow and comes after the passes that matter.
    """

    def count(program):
        if isinstance(program, jax.stages.Lowered):
            program = program.compile(compiler_options={"xla_backend_optimization_level": 0})
        text = program.as_text()
        entry = text[text.index("\nENTRY ") :]
        assert " while(" not in entry
        return entry.count("xla_cpu_small_call")

    return count


# ---- statistics -----------------------------------------------------------------------------------------------------


class Estimate(NamedTuple):
    """Mean of `count` independent images, and the estimated variance of that mean."""

    mean: np.ndarray  # (H, W, 3)
    variance: np.ndarray  # (H, W, 3)
    count: int


def estimate_of(images):
    """Estimate from independent images (K, H, W, 3)."""
    images = np.asarray(images, float)
    return Estimate(images.mean(0), images.var(0, ddof=1) / len(images), len(images))


@pytest.fixture(scope="session")
def estimate_type():
    return Estimate


@pytest.fixture(scope="session")
def estimate():
    """(scene, spp, count, **keywords of `render`) -> Estimate over `count` seeds.

    Samples of one image share a sequence and are not independent of each other; images of different seeds are.
    """

    def render(scene, spp=16, count=16, first_seed=1, scale=1, **how):
        seeds = range(first_seed, first_seed + count)
        return estimate_of([np.asarray(pathjax.render(scene, spp, seed, **how)) * scale for seed in seeds])

    return render


@pytest.fixture(scope="session")
def mitsuba():
    """(scene file, spp, count, variant, **scene parameters) -> Estimate of Mitsuba's image over `count` seeds."""
    pytest.importorskip("mitsuba")

    def render(path, spp, count, variant="llvm_ad_rgb", **parameters):
        run = {"sampler": "independent", "spp": spp, "seeds": list(range(count))}
        request = {"scene": str(path), "parameters": parameters, "variant": variant, "runs": [run]}
        try:
            _, arrays = peers.call("mitsuba3", request)
        except peers.PeerMissing as error:
            pytest.skip(str(error))
        return estimate_of(arrays["images_0"])

    return render


@pytest.fixture(scope="session")
def derivatives():
    """(scene, names, spp, count, **keywords of `jacobian`) -> Estimates over `count` seeds: of the image, and of each
    derivative by name. A colour's derivative is the one in the same channel; those in the other channels must be 0.
    """

    def diagonal(derivative):
        if derivative.ndim == 3:
            return derivative
        assert not derivative[..., ~np.eye(3, dtype=bool)].any()
        return np.diagonal(derivative, axis1=-2, axis2=-1)

    def estimates(scene, names, spp=16, count=16, first_seed=1, **how):
        images, slopes = [], {name: [] for name in names}
        for seed in range(first_seed, first_seed + count):
            image, J = pathjax.jacobian(scene, names, spp, seed, **how)
            images.append(np.asarray(image))
            for name in names:
                slopes[name].append(diagonal(np.asarray(J[name])))
        return estimate_of(images), {name: estimate_of(values) for name, values in slopes.items()}

    return estimates


@pytest.fixture(scope="session")
def agree():
    """Assert that two Estimates, or an Estimate and an exact image, differ by chance only.

    Two Welch tests share the false-alarm rate: one of the worst of all pixels and channels (Sidak), which finds local
    errors, and one of the image mean in each channel, which finds a small bias everywhere. The second assumes that
    pixels are independent. Where all pixels estimate the same value, `pixelwise=False` leaves out the first:
    well-stratified samples can give a pixel the same coarse fraction of hits for every seed.
    """
    from scipy import ndimage, stats

    def p_value(difference, variances, counts, floor):
        variance = sum(variances) + floor**2 + np.finfo(float).tiny
        # Welch-Satterthwaite; an exact side has no variance and no effect.
        spread = sum(v**2 / (count - 1) for v, count in zip(variances, counts, strict=True) if count > 1)
        freedom = np.where(spread > 0, variance**2 / np.where(spread > 0, spread, 1), np.inf)
        freedom = np.clip(freedom, min(count - 1 for count in counts if count > 1), 1e6)
        p = 2 * stats.t.sf(np.abs(difference) / np.sqrt(variance), freedom)
        return -np.expm1(p.size * np.log1p(-np.minimum(p.min(), 1 - 1e-16))), np.unravel_index(p.argmin(), p.shape)

    def check(a, b, *, whole=True, pixelwise=True, rounding=ROUNDING, false_alarm=FALSE_ALARM):
        if not isinstance(b, Estimate):
            b = Estimate(np.broadcast_to(np.asarray(b, float), a.mean.shape), np.zeros_like(a.mean), 1)
        assert np.isfinite(a.mean).all() and np.isfinite(b.mean).all()
        counts, rate = (a.count, b.count), false_alarm / (whole + pixelwise)
        if pixelwise:
            floor = rounding * (np.abs(a.mean) + np.abs(b.mean)) / 2
            # The few seeds of a pixel may all miss a rare event; the variance of its neighbours shows that it varies.
            variances = [np.maximum(e.variance, ndimage.uniform_filter(e.variance, (3, 3, 1))) for e in (a, b)]
            p, place = p_value(a.mean - b.mean, variances, counts, floor)
            worst = f"at (y, x, channel) {tuple(map(int, place))}: {a.mean[place]:.6g} against {b.mean[place]:.6g}"
            assert p > rate, f"pixels disagree, p = {p:.1e}, worst {worst}"
        if whole:
            means, pixels = (a.mean.mean((0, 1)), b.mean.mean((0, 1))), a.mean[..., 0].size
            variances = tuple(e.variance.sum((0, 1)) / pixels**2 for e in (a, b))
            # The variance of the mean of many pixels is known far better than that of one pixel.
            many = tuple(1 + (count - 1) * pixels for count in counts)
            p, _ = p_value(means[0] - means[1], variances, many, rounding * np.abs(means).mean(0))
            assert p > rate, f"image means disagree, p = {p:.1e}: {means[0]} against {means[1]}"

    return check
