"""Targets know what a file rounded, clipped or left out, and files that cannot be targets are refused."""

import numpy as np
import OpenEXR
import pytest
from PIL import Image

import pathjax as pj
from pathjax.images import srgb_to_linear, write_exr, write_png


def grey_png(path, codes, mode):
    Image.fromarray(np.asarray(codes, {"L": np.uint8, "I;16": np.uint16}[mode])).save(path)
    return path


def test_png_rounding_is_a_noise_of_the_stated_size(tmp_path):
    """For 30,000 values over all codes, the mean square of error / (step / sqrt(12)) is 1, known to 0.005."""
    image = srgb_to_linear(np.random.default_rng(0).uniform(0.02, 0.98, (100, 100, 3)))
    write_png(tmp_path / "a.png", image)
    target = pj.read_target(tmp_path / "a.png")
    error = (target.image - image) / target.step
    assert np.mean(error**2) * 12 == pytest.approx(1, abs=0.02)
    assert abs(error).max() < 0.52  # the two halves of a step differ a little in linear light
    assert abs(error.mean()) < 4 / np.sqrt(12 * error.size)


@pytest.mark.parametrize("mode, levels", [("L", 255), ("I;16", 65535)])
def test_full_scale_is_clipped_and_zero_is_not(tmp_path, mode, levels):
    codes = np.array([[0, 1, levels // 2, levels - 1, levels]])
    target = pj.read_target(grey_png(tmp_path / "a.png", codes, mode))
    usable = target.measured & (target.image < target.ceiling)
    assert usable.shape == (1, 5, 3)
    assert usable[0, :, 0].tolist() == [True, True, True, True, False]
    wanted = srgb_to_linear(1.5 / levels) - srgb_to_linear(0.5 / levels)
    assert target.step[0, 1] == pytest.approx(wanted, rel=1e-3)
    # Code 0 may stand for half a step; any other code may be as far from its value.
    assert target.step[0, 0] == pytest.approx(wanted, rel=1e-3)


def test_pixels_that_are_not_opaque_are_not_measured(tmp_path):
    rgba = np.full((2, 2, 4), 128, np.uint8)
    rgba[..., 3] = [[255, 254], [0, 255]]
    Image.fromarray(rgba).save(tmp_path / "a.png")
    target = pj.read_target(tmp_path / "a.png")
    assert np.broadcast_to(target.measured, (2, 2, 3))[..., 0].tolist() == [[True, False], [False, True]]


def write_with(path, compression, dtype, values):
    pixels = {name: np.ascontiguousarray(values[..., i], dtype) for i, name in enumerate("RGB")}
    with OpenEXR.File({"compression": compression, "type": OpenEXR.scanlineimage}, pixels) as file:
        file.write(str(path))
    return path


def test_halves_are_rounded_and_end_at_their_largest(tmp_path):
    values = np.random.default_rng(1).uniform(1.0, 2.0, (50, 50, 3))
    values[0, 0] = [np.inf, 65504, 65472]
    target = pj.read_target(write_with(tmp_path / "a.exr", OpenEXR.ZIP_COMPRESSION, np.float16, values))
    assert (target.image < target.ceiling)[0, 0].tolist() == [False, False, True]
    assert target.step[0, 0, 2] == 32
    error = (target.image[1:] - values[1:]) / target.step[1:]
    # 7,350 errors, uniform over a step: known to 0.01.
    assert np.mean(error**2) * 12 == pytest.approx(1, abs=0.05)


def test_a_file_of_floats_is_exact(tmp_path):
    image = np.random.default_rng(2).random((3, 4, 3), np.float32)
    write_exr(tmp_path / "a.exr", {name: image[..., i] for i, name in enumerate("RGB")}, {})
    target = pj.read_target(tmp_path / "a.exr")
    np.testing.assert_array_equal(target.image, image)
    assert target.step == 0 and target.ceiling == np.inf and target.measured is True


def test_a_misfit_is_what_no_rounding_or_clipping_explains():
    image = np.array([[[1.0, 1.0, 1.0], [5.0, 5.0, 5.0], [1.0, 1.0, 1.0]]])
    measured = np.array([[[True], [True], [False]]])
    target = pj.Target(image, np.full(image.shape, 0.2), 5.0, measured)
    render = np.array([[[1.05, 1.3, 0.7], [4.7, 5.0, 9.0], [0.0, 1.0, 9.0]]])
    np.testing.assert_allclose(target.misfit(render)[0, 0], [0, 0.2, -0.2], atol=1e-12)
    np.testing.assert_allclose(target.misfit(render)[0, 1], [-0.2, 0, 0], atol=1e-12)
    np.testing.assert_array_equal(target.misfit(render)[0, 2], 0)
    np.testing.assert_allclose(target.misfit(render, 0.15)[0, :2], [[0, 0.05, -0.05], [-0.05, 0, 0]], atol=1e-12)


def palette(path):
    Image.fromarray(np.random.default_rng(3).integers(0, 255, (8, 8, 3), np.uint8)).quantize(4).save(path)


def lossy(path):
    write_with(path, OpenEXR.DWAA_COMPRESSION, np.float16, np.ones((8, 8, 3)))


@pytest.mark.parametrize(
    "name, write, words",
    [
        ("a.png", palette, "palette"),
        ("a.exr", lossy, "DWAA compression changes pixels"),
        ("a.jpg", lambda path: Image.new("RGB", (8, 8)).save(path), "use OpenEXR or PNG for targets"),
        ("a.png", lambda path: None, "no such file"),
    ],
)
def test_files_that_are_no_targets_are_refused(tmp_path, name, write, words):
    write(tmp_path / name)
    with pytest.raises(pj.InputError, match=words):
        pj.read_target(tmp_path / name)
