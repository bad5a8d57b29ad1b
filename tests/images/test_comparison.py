"""Comparing images: closed forms, the false-alarm rate of z-scores, exit statuses, and errors."""

import json
import math
import sys

import numpy as np
import pytest
from PIL import Image
from scipy import stats

from pathjax import cli
from pathjax.images import comparison, metrics, read_rgb, write_exr, write_png

GREY = np.full((16, 24, 3), 0.3, np.float32)


@pytest.fixture
def exr(tmp_path):
    """(name, image, errors or None) -> path of an EXR file."""

    def write(name, image, errors=None):
        channels = {c: image[..., k] for k, c in enumerate("RGB")}
        if errors is not None:
            errors = np.broadcast_to(np.asarray(errors, np.float32), image.shape)
            channels |= {f"error.{c}": errors[..., k] for k, c in enumerate("RGB")}
        write_exr(tmp_path / name, channels, {})
        return str(tmp_path / name)

    return write


@pytest.fixture
def run(capfd):
    """(arguments) -> exit status, stdout, stderr of `pathjax compare`."""

    def run(*arguments):
        capfd.readouterr()
        try:
            status = cli.main(["compare", *map(str, arguments)])
        except SystemExit as error:  # argparse
            status = error.code
        return status, *capfd.readouterr()

    return run


def noisy(seed, error=0.02):
    return (GREY + np.random.default_rng(seed).normal(0, error, GREY.shape)).astype(np.float32)


# ---- measures -------------------------------------------------------------------------------------------------------


def test_measures_of_a_known_difference():
    reference = np.full((2, 2, 3), 0.3)
    assert metrics.mse(reference + 0.1, reference) == pytest.approx(0.01)
    assert metrics.rel_mse(reference + 0.1, reference) == pytest.approx(0.01 / 0.1)
    assert metrics.psnr(reference + 0.1, reference, 1) == pytest.approx(20)
    assert metrics.psnr(reference + 0.1, reference, 10) == pytest.approx(40)
    assert metrics.psnr(reference, reference, 1) == math.inf
    assert metrics.psnr(reference, 0 * reference, 0) == -math.inf


def test_level_is_the_mean_of_what_is_lit_but_for_its_brightest_quarter():
    lit = [[0.1, 0.2, 0.3], [0.4, 0.4, 0.4], [0.5, 0.6, 1.0], [1e9, 0, 0]]
    dark = [[0.0, 0.0, 0.0]] * 96
    for image in (lit, lit + dark, [*lit, [np.nan, 1, 1], [np.inf, 1, 1]]):
        assert metrics.level(image) == pytest.approx((0.2 + 0.4 + 0.7) / 3)
    assert metrics.level(lit[:1]) == pytest.approx(0.2)


@pytest.mark.parametrize("value", [0, -1, np.nan, np.inf, 1e-32])
def test_level_of_nothing_is_not_known(value):
    image = np.full((2, 3, 3), value, np.float32)
    assert math.isnan(metrics.level(image)) and math.isnan(metrics.relative_error(image, image))


@pytest.mark.parametrize("unit", [1e-25, 1e-10, 0.1, 1, 1e10, 1e25])
def test_relative_error_knows_no_unit(unit):
    """The image is 10 % too bright everywhere, and half of the reference is black."""
    reference = np.zeros((4, 4, 3))
    reference[2:] = unit
    expected = 0.1 / math.sqrt(2 * 1.01)
    assert metrics.relative_error(1.1 * reference, reference) == pytest.approx(expected)
    assert metrics.relative_error(reference.astype(np.float32), reference) == pytest.approx(0, abs=1e-7)


@pytest.mark.parametrize("hdr", [True, False])
def test_flip_is_0_for_equal_images_and_grows_with_the_difference(hdr):
    pytest.importorskip("flip_evaluator")
    means = [metrics.flip(GREY * scale, GREY, hdr).mean() for scale in (1, 1.05, 1.5)]
    assert means[0] == 0
    assert 0 < means[1] < means[2] < 1
    assert metrics.flip(GREY, GREY, hdr).shape == GREY.shape[:2]


def test_flip_meets_black_references_and_negative_values():
    pytest.importorskip("flip_evaluator")
    for dark in (0 * GREY, 1e-9 * GREY, -GREY):
        assert metrics.flip(dark, dark, True).max() == 0
        assert metrics.flip(GREY, dark, True).min() > 0.5


@pytest.mark.parametrize("power", [-80, -66, -30])
def test_flip_of_high_dynamic_range_knows_no_unit(power):
    """FLIP's own program takes values below 2e-7 for black."""
    pytest.importorskip("flip_evaluator")
    rng = np.random.default_rng(0)
    reference = rng.lognormal(size=GREY.shape).astype(np.float32)
    image = (reference * rng.normal(1, 0.1, GREY.shape)).astype(np.float32)
    expected = metrics.flip(image, reference, True)
    assert expected.mean() > 0.01
    scaled = metrics.flip(np.ldexp(image, power), np.ldexp(reference, power), True)
    np.testing.assert_allclose(scaled, expected, rtol=1e-4)


def test_z_scores_of_known_numbers():
    image, reference = np.array([1.0, 1, 1, 1, 0, 1]), np.array([0.5, 1, 2, 1 + 1e-7, 0, 1 + 1e-3])
    z = metrics.z_scores(image, reference, np.array([0.3, 0, 0, 0, 0, 0.001]), np.array([0.4, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(z, [1, 0, -np.inf, 0, 0, -1])


@pytest.mark.parametrize("count", [1, 300, 10**7])
def test_sidak_p_meets_the_definition(count):
    for farthest in (0, 0.1, 2, 4, 7):
        z = np.zeros(count)
        z[-1] = -farthest
        expected = 1 - (1 - 2 * stats.norm.sf(farthest)) ** count
        assert metrics.sidak_p(z) == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_sidak_p_is_exact_in_the_far_tail():
    assert metrics.sidak_p([0.0, 20.0]) == pytest.approx(2 * 2 * stats.norm.sf(20), rel=1e-12)
    assert metrics.sidak_p([37.0]) == pytest.approx(2 * stats.norm.sf(37), rel=1e-9)
    assert metrics.sidak_p([1e6]) == metrics.sidak_p([np.inf, 0]) == 0
    assert metrics.sidak_p(np.zeros(5)) == 1


def test_equal_scenes_are_told_apart_as_often_as_alpha_says():
    rng, alpha, trials = np.random.default_rng(0), 0.1, 1000
    errors = rng.uniform(0.01, 0.1, (2, 200))
    p = np.array(
        [metrics.sidak_p(metrics.z_scores(*(1 + errors * rng.normal(size=(2, 200))), *errors)) for _ in range(trials)]
    )
    assert stats.kstest(p, "uniform").pvalue > 1e-3
    assert stats.binomtest(int((p < alpha).sum()), trials, alpha).pvalue > 1e-3


# ---- files ----------------------------------------------------------------------------------------------------------


def test_comparison_of_noisy_files(exr):
    c = comparison.compare(exr("a.exr", noisy(1), 0.02), exr("b.exr", noisy(2, 0.01), 0.01), errors=True)
    facts = comparison.facts(c)
    assert facts["mean_z2"] == pytest.approx(1, abs=5 * math.sqrt(2 / GREY.size))
    assert facts["max_z"] == np.abs(c.z).max()
    assert 1e-3 < facts["p"] <= 1
    assert facts["exact"] is None
    assert facts["rel_mse"] == metrics.rel_mse(c.image, c.reference)
    assert facts["psnr_peak"] == c.reference.max()


def test_a_small_shift_in_one_pixel_is_found(exr):
    image = noisy(1)
    image[3, 4, 1] += 0.5
    a, b = exr("a.exr", image, 0.02), exr("b.exr", noisy(2), 0.02)
    facts = comparison.facts(comparison.compare(a, b, errors=True))
    assert facts["p"] < 1e-10
    assert 10 < facts["max_z"] < 25


def test_a_file_without_errors_is_taken_as_exact(exr, run):
    a, b = exr("a.exr", noisy(1), 0.02), exr("b.exr", GREY)
    for image, reference in ((a, b), (b, a)):
        c = comparison.compare(image, reference, errors=True)
        assert c.exact == b
        assert np.mean(c.z**2) == pytest.approx(1, abs=5 * math.sqrt(2 / GREY.size))
    assert f"{b} holds no standard errors and was taken as exact" in run(a, b, "--errors")[1]


def test_pixels_that_are_not_finite_are_counted_and_left_out(exr, run):
    image, reference, errors = GREY + np.float32(0.1), GREY.copy(), np.full(GREY.shape, 0.1, np.float32)
    image[0, 0, 1], reference[1, 1, 0], errors[2, 2, 2] = np.nan, np.inf, np.nan
    a, b = exr("a.exr", image, errors), exr("b.exr", reference, 0)
    c = comparison.compare(a, b, errors=True)
    assert (~c.compared).sum() == comparison.facts(c)["not_finite_pixels"] == 3
    assert c.rel_mse == pytest.approx(0.1, rel=1e-5)
    assert comparison.facts(c)["mean_z2"] == pytest.approx(1, rel=1e-5)
    assert comparison.facts(comparison.compare(a, b))["not_finite_pixels"] == 2
    status, out, _ = run(a, b, "--errors")
    assert status == 0 and "3 pixels are not finite" in out


def test_display_referred_files_are_compared_as_linear_light(tmp_path, run):
    write_png(tmp_path / "a.png", GREY)
    Image.fromarray(np.full((16, 24, 3), 128, np.uint8)).save(tmp_path / "b.jpg", quality=100)
    c = comparison.compare(str(tmp_path / "a.png"), str(tmp_path / "b.jpg"))
    assert not c.hdr and c.peak == 1
    assert c.mse == pytest.approx(np.mean((read_rgb(tmp_path / "a.png") - 0.2158605) ** 2), rel=1e-4)


def test_the_picture_shows_both_images_and_the_sign_of_the_difference(exr, tmp_path, run):
    image = np.full((64, 256, 3), 0.5, np.float32)
    reference = image.copy()
    reference[:, :128] -= 0.25
    reference[:, 128:] += 0.25
    reference[0, 0] = np.nan
    a, b = exr("a.exr", image, 0.01), exr("b.exr", reference)
    status, out, _ = run(a, b, "--errors", "-o", tmp_path / "d.png")
    assert status == 1
    assert "differences of 0.25 in full colour" in out
    shown = read_rgb(tmp_path / "d.png")
    assert shown.shape == (64, 4 * 256 + 3 * 4, 3)
    image, reference, difference, z = (shown[:, k * 260 : k * 260 + 256] for k in range(4))
    np.testing.assert_allclose(image, 0.5, atol=0.005)
    np.testing.assert_allclose(reference[9, [9, 200], 0], [0.25, 0.75], atol=0.005)
    for colors in (difference, z):
        assert not colors[0, 0].any()
        assert colors[9, 9, 0] > 0.9 > 0.2 > colors[9, 9, 2]
        assert colors[9, 200, 2] > 0.9 > 0.2 > colors[9, 200, 0]


# ---- exit statuses and messages -------------------------------------------------------------------------------------


def test_json_is_one_object_without_nan_or_infinity(exr, run):
    def refuse(token):
        raise AssertionError(token)

    a = exr("a.exr", GREY, 0)
    status, out, _ = run(a, a, "--errors", "--json")
    facts = json.loads(out, parse_constant=refuse)
    assert status == 0 and out.count("\n") == 1
    assert (facts["mse"], facts["rel_mse"], facts["psnr"], facts["p"], facts["differ"]) == (0, 0, None, 1, [])
    assert facts["flip"] in (0, None)
    b = exr("b.exr", GREY + 1, 0)
    status, out, _ = run(a, b, "--errors", "--json")
    facts = json.loads(out, parse_constant=refuse)
    assert status == 1
    assert (facts["max_z"], facts["mean_z2"], facts["p"]) == (None, None, 0)
    assert len(facts["differ"]) == 1


def test_without_limits_the_status_is_0(exr, run):
    assert run(exr("a.exr", GREY), exr("b.exr", GREY + 1))[0] == 0


def test_limits_decide_the_status(exr, run):
    a, b = exr("a.exr", GREY + np.float32(0.1)), exr("b.exr", GREY)  # relMSE 0.1
    assert run(a, b, "--max-relmse", 0.11)[0] == 0
    status, out, _ = run(a, b, "--max-relmse", 0.09)
    assert status == 1
    assert "relMSE 0.1 is above 0.09" in out
    pytest.importorskip("flip_evaluator")
    flip = comparison.compare(a, b).flip
    assert run(a, b, "--max-flip", flip * 1.1)[0] == 0
    assert run(a, b, "--max-flip", flip * 0.9)[0] == 1
    assert run(a, a, "--max-flip", 0, "--max-relmse", 0)[0] == 0


@pytest.mark.parametrize("unit", [1e-20, 1, 1e20])
def test_a_limit_of_the_relative_error_knows_no_unit(exr, run, unit):
    a, b = exr("a.exr", unit * (GREY + np.float32(0.03))), exr("b.exr", unit * GREY)  # 0.1 / sqrt(1.01)
    assert run(a, b, "--max-error", 0.1)[0] == 0
    status, out, _ = run(a, b, "--max-error", 0.099)
    assert status == 1
    assert "the error 0.0995 is not below 0.099" in out
    assert json.loads(run(a, b, "--json")[1])["relative_error"] == pytest.approx(0.0995, rel=1e-3)


def test_no_error_is_claimed_relative_to_black(exr, run):
    black = exr("b.exr", 0 * GREY)
    assert run(black, black, "--max-error", 1)[0] == 1
    assert json.loads(run(black, black, "--json")[1])["relative_error"] is None


def test_alpha_decides_the_status(exr, run):
    a, b = exr("a.exr", noisy(1), 0.02), exr("b.exr", noisy(2), 0.02)
    p = comparison.compare(a, b, errors=True).p
    assert run(a, b, "--errors")[0] == 0
    assert run(a, b, "--errors", "--alpha", p / 1.1)[0] == 0
    assert run(a, b, "--errors", "--alpha", p * 1.1)[0] == 1


def test_without_its_package_flip_is_left_out(exr, run, monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    a = exr("a.exr", GREY)
    status, out, _ = run(a, a)
    assert status == 0 and "pathjax[flip]" in out
    assert json.loads(run(a, a, "--json")[1])["flip"] is None
    status, out, err = run(a, a, "--max-flip", 0.1)
    assert (status, out) == (2, "") and "pip install 'pathjax[flip]'" in err


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["a.exr", "none.exr"], ["none.exr", "no such file"]),
        (["a.exr", "wide.exr"], ["a.exr is 24 x 16", "wide.exr is 32 x 16"]),
        (["a.exr", "wide.exr", "--errors"], ["a.exr is 24 x 16", "wide.exr is 32 x 16"]),
        (["a.exr", "lost.exr"], ["lost.exr", "no pixel is finite"]),
        (["a.exr", "a.txt"], [".txt", "not supported"]),
        (["a.exr", "depth.exr"], ["depth.exr", "it has: Z"]),
        (["a.exr", "a.exr", "--errors"], ["a.exr holds B, G, R", "error.R, error.G, error.B", "--aov error"]),
        (["a.png", "a.png", "--errors"], ["a.png holds no named channels", "EXR"]),
        (["a.exr", "half.exr", "--errors"], ["half.exr", "all three"]),
        (["a.exr", "a.exr", "-o", "d.exr"], ["d.exr", ".png"]),
        (["a.exr", "a.exr", "-o", "none/d.png"], ["no folder", "none"]),
        (["a.exr"], ["B.{exr,png,jpg}"]),
        (["a.exr", "a.exr", "--max-relmse", "-1"], ["--max-relmse", "-1"]),
        (["a.exr", "a.exr", "--max-error", "-1"], ["--max-error", "-1"]),
        (["a.exr", "a.exr", "--max-flip", "few"], ["--max-flip", "few"]),
        (["a.exr", "a.exr", "--max-flip", "nan"], ["--max-flip", "nan"]),
        (["a.exr", "a.exr", "--alpha", "2"], ["--alpha", "2"]),
    ],
)
def test_what_cannot_be_compared(exr, run, tmp_path, monkeypatch, arguments, says):
    monkeypatch.chdir(tmp_path)
    exr("a.exr", GREY)
    exr("wide.exr", np.zeros((16, 32, 3)), 1)
    exr("lost.exr", np.full_like(GREY, np.nan))
    write_png("a.png", GREY)
    write_exr("depth.exr", {"Z": GREY[..., 0]}, {})
    write_exr("half.exr", {**{c: GREY[..., 0] for c in "RGB"}, "error.R": GREY[..., 0]}, {})
    (tmp_path / "a.txt").write_text("")
    before = sorted(tmp_path.iterdir())
    status, out, err = run(*arguments)
    assert (status, out) == (2, "")
    assert "Traceback" not in err
    for part in says:
        assert part in err
    assert sorted(tmp_path.iterdir()) == before


def test_help_tells_the_exit_status(run):
    status, out, _ = run("--help")
    assert status == 0
    assert "Exit status" in out and "--errors" in out
