"""Wrong commands and files are refused with one message, before anything is written."""

import os

import pytest

FURNACE = "scenes/furnace.xml"
SMALL = ("-D", "res=8")


def test_missing_scene(refused, tmp_path):
    refused("render", "nowhere.xml", "-o", tmp_path / "a.exr", says=["nowhere.xml"])
    refused("info", "nowhere.xml", says=["nowhere.xml"])


def test_errors_in_a_scene_name_file_and_line(refused, write_scene, tmp_path):
    path = write_scene('<shape type="sphere"><bsdf type="hair"/></shape>')
    line = 1 + path.read_text().split("hair")[0].count("\n")
    refused("render", path, "-o", tmp_path / "a.exr", says=[f"{path}:{line}: ", "hair", "diffuse"])


@pytest.mark.parametrize("text", ["", "not xml", "<scene", "<scene></scene>", "\0\1\2"])
def test_what_is_no_scene(refused, tmp_path, text):
    (tmp_path / "bad.xml").write_text(text)
    refused("info", tmp_path / "bad.xml", says=["bad.xml"])


def test_a_folder_is_no_scene(refused, tmp_path):
    refused("info", tmp_path, says=[str(tmp_path)])


def test_missing_output_folder(refused, tmp_path):
    refused("render", FURNACE, "-o", tmp_path / "no" / "a.exr", says=["no folder", str(tmp_path / "no")])


def test_output_that_is_a_folder_or_of_another_kind(refused, tmp_path):
    (tmp_path / "b.exr").mkdir()
    refused("render", FURNACE, "-o", tmp_path / "b.exr", says=["folder"])
    refused("render", FURNACE, "-o", tmp_path / "a.jpg", says=[".exr or .png"])
    refused("render", FURNACE, "-o", tmp_path / "a", says=[".exr or .png"])


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_output_folder_without_the_right_to_write(refused, tmp_path):
    (tmp_path / "locked").mkdir(mode=0o500)
    refused("render", FURNACE, *SMALL, "-o", tmp_path / "locked" / "a.exr", "--spp", "1", says=["cannot be written"])


@pytest.mark.parametrize("spp", ["0", "-1", "1.5", "many", "", str(2**31)])
def test_spp_that_is_no_positive_integer(refused, tmp_path, spp):
    refused("render", FURNACE, "-o", tmp_path / "a.exr", f"--spp={spp}", says=["--spp"])


@pytest.mark.parametrize("seed", ["-1", "0.5", str(2**31)])
def test_seed_that_is_no_31_bit_integer(refused, tmp_path, seed):
    refused("render", FURNACE, "-o", tmp_path / "a.exr", f"--seed={seed}", says=["--seed"])


@pytest.mark.parametrize("option", ["--error", "--time"])
@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "much", ""])
def test_limits_that_are_no_positive_number(refused, tmp_path, option, value):
    refused("render", FURNACE, "-o", tmp_path / "a.exr", f"{option}={value}", says=[option])


def test_output_variables_that_cannot_be(refused, tmp_path):
    exr, png = ("-o", tmp_path / "a.exr"), ("-o", tmp_path / "a.png")
    refused("render", FURNACE, *exr, "--aov", "depht", says=["depht", "error, depth, normal, albedo"])
    refused("render", FURNACE, *exr, "--aov", "bounces", "-D", "max_depth=-1", says=["no limit", "1 to 64", "--tail"])
    refused("info", FURNACE, "--tail", "2", says=["error = 2", "between 0 and 1"])
    refused("render", FURNACE, *exr, "--aov", "", says=["error, depth, normal, albedo"])
    refused("render", FURNACE, *exr, "--aov", "depth,error,depth", says=["depth", "twice"])
    refused("render", FURNACE, *png, "--aov", "depth", says=["a.png", ".exr"])


def test_checkpoints_that_cannot_be(refused, run, tmp_path):
    arguments = ("render", FURNACE, *SMALL, "-o", tmp_path / "a.exr", "--spp", 1, "--checkpoint")
    refused(*arguments, tmp_path / "none" / "run.npz", says=["no folder"])
    assert run(*arguments, tmp_path / "run.npz")[0] == 0
    refused(*arguments, tmp_path / "run.npz", "--seed", 4, says=["run.npz was made with seed 0, this is seed 4"])


def test_unknown_parameter_offers_names(refused, tmp_path):
    output = ("-o", tmp_path / "a.exr")
    refused("render", FURNACE, *output, "--set", "wal.reflectance=1", says=["wal.reflectance", "wall.reflectance"])
    refused("render", FURNACE, *output, "--set", "zzz=1", says=["zzz", "wall.reflectance", "glow.radiance"])


@pytest.mark.parametrize(
    "setting, says",
    [
        ("wall.reflectance=1,2", "wall.reflectance"),
        ("wall.reflectance=blue", "blue"),
        ("wall.reflectance=1.5", "bounds"),
        ("wall.reflectance=nan", "bounds"),
        ("glow.radiance=-1", "bounds"),
        ("glow.radiance=inf", "radiance"),
        ("wall.reflectance=", "number"),
        ("wall.reflectance", "name=value"),
        ("=1", "name=value"),
    ],
)
def test_values_that_a_parameter_does_not_take(refused, tmp_path, setting, says):
    refused("render", FURNACE, *SMALL, "-o", tmp_path / "a.exr", "--spp", "1", "--set", setting, says=[says])


@pytest.mark.parametrize(
    "define, says",
    [
        ("resolution=8", "resolution"),
        ("res=many", "furnace.xml:32: "),
        ("res=0", "furnace.xml:32: "),
        ("res=-3", "furnace.xml:32: "),
        ("res=99999", "furnace.xml:32: "),
        ("max_depth=-2", "max_depth"),
        ("res", "name=value"),
    ],
)
def test_defines_that_a_file_does_not_take(refused, tmp_path, define, says):
    refused("render", FURNACE, "-o", tmp_path / "a.exr", "-D", define, says=[says])


def test_no_command_and_unknown_commands(refused):
    refused()
    refused("paint", FURNACE)
    refused("render", FURNACE, says=["-o"])
    refused("render", FURNACE, "-o", "a.exr", "--strategy", "luck", says=["luck"])


def test_help_is_no_error(run):
    status, out, _ = run("render", "--help")
    assert status == 0
    assert "--spp" in out and "--set" in out
