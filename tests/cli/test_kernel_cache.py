"""Compiled kernels on disk: the command line keeps them, and works where it cannot."""

import subprocess
import sys

import pytest
import trimesh

from pathjax.images import read_exr

# A scene that XLA compiles fast, with edges in view so that its images have noise.
SCENE = """<scene version="3.0.0"><sensor type="perspective"><transform name="to_world">
    <lookat origin="0,1,4" target="0,0,0" up="0,1,0"/></transform><film type="hdrfilm"><rfilter type="box"/>
    <integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>
    <emitter type="constant"/>{}</scene>"""
PIPES = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
# A byte that UTF-8 never contains, as Python represents it in arguments and file names.
BYTE = "\udcff"


# The same command line; then prints how many programs were requested from JAX's cache, how many it held, and how often
# the image's kernel was traced.
COUNTED = """
import sys
from pathjax import cli
import jax

events, traced = [], []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event.rpartition("/")[2]))
jax.monitoring.register_event_duration_secs_listener(lambda event, _, **what: traced.append(what.get("fun_name")))
status = cli.main(sys.argv[1:])
print(events.count("compile_requests_use_cache"), events.count("cache_hits"), traced.count("_means_of_replicates"))
sys.exit(status)
"""


@pytest.fixture
def counted(root, environment, tmp_path):
    """(*options, scene, **environment) -> a process that renders the scene, or a plate, to a file, and that file."""
    numbers = iter(range(100))
    plate = tmp_path / "plate.xml"
    plate.write_text(SCENE.format('<shape type="rectangle"/>'))

    def start(*more, scene=None, **variables):
        output = tmp_path / f"{next(numbers)}.exr"
        arguments = ("render", scene or plate, "-o", output, "--spp", 4, *more)
        command = [sys.executable, "-c", COUNTED, *map(str, arguments)]
        plain = {name: value for name, value in environment.items() if not name.startswith(("JAX_", "PATHJAX_"))}
        variables = {name: str(value) for name, value in variables.items()}
        return subprocess.Popen(command, cwd=root, env=plain | variables, **PIPES), output

    return start


def end(started):
    """Return how many programs were requested from JAX's cache and found, kernel traces, and bytes of the red channel.

    Nothing may be printed on stderr.
    """
    process, output = started
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert err.strip() == ""
    return *map(int, out.split()), read_exr(output)[0]["R"].tobytes()


def entries(folder):
    return sorted(path.name for path in folder.rglob("*") if path.suffix == ".program" or path.name.endswith("-cache"))


linux = pytest.mark.skipif(sys.platform != "linux", reason="kernels are kept on Linux only")


@linux
def test_scenes_of_one_structure_find_the_kernel_of_another(counted, tmp_path):
    """The scenes differ in their triangle and bsdf counts."""
    thing = '<shape type="ply"><string name="filename" value="{}.ply"/><bsdf type="diffuse"/></shape>'
    told = []
    for place, count in enumerate((3, 4)):
        trimesh.creation.icosphere(subdivisions=count).export(tmp_path / f"{count}.ply")
        file = tmp_path / f"{place}.xml"
        file.write_text(SCENE.format(thing.format(count) * count))
        wanted, found, traced, _ = end(counted(scene=file, XDG_CACHE_HOME=tmp_path / "cache"))
        told.append((wanted > found, traced))
    assert told == [(True, 1), (False, 0)]


@linux
def test_the_second_run_compiles_nothing_and_gives_the_same_image(counted, tmp_path):
    cache, depth = tmp_path / "cache", ("--aov", "depth")
    both = [counted(*depth, XDG_CACHE_HOME=cache) for _ in range(2)]  # at once, on an empty cache
    first, other = map(end, both)
    kept = entries(cache)
    assert sum(name.endswith(".program") for name in kept) == 1
    assert any(name.startswith("jit__render_aovs") for name in kept)
    assert not any(name.startswith("jit__means_of_replicates") for name in kept), "it is kept twice"
    assert all(path.relative_to(cache).parts[0] == "pathjax" for path in cache.rglob("*") if path.is_file())
    wanted, found, traced, image = end(counted(*depth, XDG_CACHE_HOME=cache))
    assert wanted == found > 0
    assert traced == 0 < first[2]
    assert entries(cache) == kept
    without = end(counted(PATHJAX_CACHE=0, XDG_CACHE_HOME=tmp_path / "none"))
    assert image == first[3] == other[3] == without[3]
    assert without[1] == 0 < without[2] and not (tmp_path / "none").exists()
    # An unreadable program is compiled again.
    (program,) = cache.rglob("*.program")
    program.write_bytes(b"nothing of XLA's")
    again, last = (end(counted(XDG_CACHE_HOME=cache)) for _ in range(2))
    assert again[2] > 0 == last[2]
    assert image == again[3] == last[3]


@linux
def test_a_cache_of_the_users_choice_is_used_instead(counted, tmp_path):
    variables = {
        "JAX_COMPILATION_CACHE_DIR": tmp_path / "mine",
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": 0,
        "XDG_CACHE_HOME": tmp_path / "cache",
    }
    end(counted(**variables))
    assert entries(tmp_path / "mine")
    assert not (tmp_path / "cache").exists()


@linux
@pytest.mark.parametrize("name", ["file", pytest.param(BYTE, marks=pytest.mark.slow)])
def test_a_cache_that_cannot_be_written_stops_no_render(counted, tmp_path, name):
    (tmp_path / "file").write_text("")
    assert end(counted(XDG_CACHE_HOME=tmp_path / name))[1] == 0


@linux
def test_a_full_cache_disk_stops_no_render_and_keeps_no_halves(counted, tmp_path):
    import resource

    cache, limits = tmp_path / "cache", resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 15, limits[1]))  # inherited by the child, whose kernel is larger
    try:
        started = counted("--aov", "depth", XDG_CACHE_HOME=cache)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    _, found, traced, image = end(started)
    assert found == 0 < traced
    assert any(path.stat().st_size == 1 << 15 for path in cache.rglob("*-cache"))
    assert not [path for path in cache.rglob("*") if path.suffix in (".program", ".part")]
    end(counted("--aov", "depth", XDG_CACHE_HOME=cache))
    wanted, found, traced, again = end(counted("--aov", "depth", XDG_CACHE_HOME=cache))
    assert wanted == found > 0 == traced
    assert again == image
