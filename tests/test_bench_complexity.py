"""The bench of bytes against PSNR runs from scenes to tables and curve on tiny sizes."""

import csv
import xml.etree.ElementTree as ET

import pytest

from bench.experiments import complexity
from warpgs.synthetic.demo import split_spec, write_demo


def test_study_tables_and_curve(tmp_path, monkeypatch, capsys):
    """Both fits of a tiny scene, a row each, paired; each point is a pruned model no larger than the one before."""
    write_demo(tmp_path / "scene", views=8, width=64, height=48)
    monkeypatch.setattr(complexity, "KEEP", (0.1, 1.0))
    words = [str(tmp_path / "scene"), "--out", str(tmp_path / "out"), "--split", split_spec(8), "--preset", "quick"]
    assert complexity.main([*words, "--steps", "30", "--seeds", "1", "--device", "cpu"]) == 0
    with open(tmp_path / "out" / "complexity.csv", encoding="utf-8") as file:
        fixed, adaptive = csv.DictReader(file)
    assert (fixed["variant"], adaptive["variant"]) == ("fixed", "adaptive") and int(adaptive["bytes"]) < int(fixed["bytes"])
    table = (tmp_path / "out" / "complexity.md").read_text()
    ratio = int(fixed["bytes"]) / int(adaptive["bytes"])
    assert (
        f"| {ratio:.2f} | {float(adaptive['psnr']) - float(fixed['psnr']):.2f} |" in table and table in capsys.readouterr().out
    )
    with open(tmp_path / "out" / "curve.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [float(r["keep_db"]) for r in rows] == [0, 0.1, 1.0] * 2
    for own, run in ((rows[:3], fixed), (rows[3:], adaptive)):
        sizes = [int(r["bytes"]) for r in own]
        assert sizes == sorted(sizes, reverse=True) and sizes[2] < sizes[0]
        assert float(own[2]["train_psnr"]) >= float(own[0]["train_psnr"]) - 1.0
        assert float(own[0]["psnr"]) == pytest.approx(float(run["psnr"]))
    drawing = ET.parse(tmp_path / "out" / "curve.svg").getroot()
    circles = [e for e in drawing.iter() if e.tag.endswith("circle")]
    assert len(circles) == 6 and all(0 < float(c.get("cx")) < 520 and 0 < float(c.get("cy")) < 300 for c in circles)


def test_what_fails_is_one_line(tmp_path, capsys):
    """A folder that is no run: the exit code of its kind, and what is wrong."""
    assert complexity.main([str(tmp_path / "none"), "--from-runs", "--out", str(tmp_path / "out"), "--device", "cpu"]) == 3
    assert "bench.experiments.complexity:" in capsys.readouterr().err
