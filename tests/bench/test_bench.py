"""`pathjax bench`: the figures are those of the images, and come as a table and as JSON."""

import json
from pathlib import Path

import pytest

from pathjax.bench.bench import _line, _row
from pathjax.cli import main

CORNELL = str(Path(__file__).resolve().parents[2] / "scenes" / "cornell_box.xml")
QUICK = ["bench", CORNELL, "-D", "res=8", "--spp", "2,32", "--reference-spp", "512", "--repeat", "2"]


def test_bench_reports_speed_against_error(tmp_path, capsys):
    assert main([*QUICK, "-o", str(tmp_path / "report"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert json.loads((tmp_path / "report" / "bench.json").read_text()) == report
    (scene,) = report["scenes"]
    few, many = scene["pathjax"]
    # 16 times the samples: the error falls by about 16; a factor of 3 is beyond chance.
    assert 3 * many["rel_mse"] < few["rel_mse"]
    for row in (few, many):
        assert row["efficiency"] == pytest.approx(1 / (row["rel_mse"] * row["run_seconds"]))
        assert row["mpaths_per_second"] == pytest.approx(64 * row["spp"] / row["run_seconds"] / 1e6)
    assert "| pathjax | 32 |" in (tmp_path / "report" / "bench.md").read_text()


def test_bench_refuses_a_folder_without_parent(tmp_path, capsys):
    assert main([*QUICK, "-o", str(tmp_path / "none" / "report")]) == 2
    assert "there is no folder" in capsys.readouterr().err


def test_a_scene_without_noise_has_no_efficiency():
    row = _row(4, 4, [1.0], [0.0], 64)
    assert row["efficiency"] is None
    assert "| 0.00e+00 |  |" in _line("pathjax", row, "")
