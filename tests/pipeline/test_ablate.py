"""`warpgs ablate`: a row for each part that is switched off or on, and a table with check marks."""

import dataclasses

import pytest

from tests.pipeline.test_table_files import cells
from warpgs.app.cli import main
from warpgs.errors import UsageError
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.paper.strategy import UNIFORM, PaperConfig
from warpgs.pipeline.run.fit import fit_request
from warpgs.pipeline.study.study import ABLATION_ROWS, SWITCHES, ablation_variants
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.sampling import MethodConfig
from warpgs.synthetic.demo import split_spec, write_demo

FULL = FitConfig(
    steps=8,
    init=InitConfig(source="random", random_count=200),
    preset="whole",
    strategy="paper",
    method=MethodConfig(hier=True),
)


def test_ablation_rows_switch_off_one_part_each():
    """Full, uniform sampling, one score more at a time, each other part off, no sampling, and the paper's settings; marks."""
    variants, marks = ablation_variants(FULL)
    scores = ["uniform", "residual only", "residual + semantics"]  # which is full without geometry
    parts = [name for name in SWITCHES if name != "s_geometry"]
    assert list(variants) == ["full", *scores, *(f"no {name}" for name in parts), "paper-literal"]
    assert variants["full"] == FULL
    paper = variants.pop("paper-literal")
    assert paper == dataclasses.replace(PRESETS["paper-literal"], steps=FULL.steps) and FULL.steps != 30_000
    weights = [variants[row].strategy_config.weights() for row in scores]
    assert weights == [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), pytest.approx((2 / 3, 1 / 3, 0.0))]
    for (row, variant), name in zip(list(variants.items())[4:], parts, strict=True):
        if name == "events":
            assert dataclasses.replace(FULL, strategy="clone_split", strategy_config=None) == variant
        else:
            switches = {"hier": variant.method.hier, **dataclasses.asdict(variant.strategy_config)}
            assert [s for s, value in switches.items() if value is False] == [name] and row == f"no {name}"
            assert dataclasses.replace(variant, method=FULL.method, strategy_config=FULL.strategy_config) == FULL
        assert [s for s, mark in zip(SWITCHES, marks[row]) if not mark] == [name]
    assert all(marks["full"]) and list(SWITCHES)[:7] == ["hier", "s_render", "s_semantic", "s_geometry", "ra", "agp", "pm"]
    with pytest.raises(UsageError, match="preset '3dgs' has no sampling events"):
        ablation_variants(FitConfig())


def test_ablation_switches_on_what_a_preset_leaves_out():
    """A preset without scores gets a row with each and one with all, and no row twice: uniform is the preset itself."""
    base = dataclasses.replace(FULL, strategy="sampling", strategy_config=None)
    variants, _ = ablation_variants(base)
    rows = "full", "residual only", "residual + semantics + geometry", "with s_semantic", "with s_geometry"
    assert {*rows, "no hier"} <= set(variants)
    assert not {"uniform", "no s_render", "with s_render", "with hier"} & set(variants)
    assert variants["full"] == base and dataclasses.replace(base, strategy="paper", strategy_config=UNIFORM) not in variants
    weights = [variants[row].strategy_config.weights() for row in rows[1:]]
    assert weights == [(1, 0, 0), pytest.approx((0.4, 0.2, 0.4)), (0, 1, 0), (0, 0, 1)]
    assert "paper-literal" not in ablation_variants(PRESETS["paper-literal"])[0]


def test_command_ablates(tmp_path, capsys, monkeypatch):
    """`warpgs ablate` from flags to a table with check marks; two of its rows, for time."""
    scene = tmp_path / "still"
    write_demo(scene, views=8, width=48, height=36)
    monkeypatch.setitem(PRESETS._made, "whole", FULL)
    monkeypatch.setattr("warpgs.pipeline.study.study.ABLATION_ROWS", {n: ABLATION_ROWS[n] for n in ("full", "no pm")})
    monkeypatch.setenv("WARPGS_CACHE", str(tmp_path / "cache"))
    asked = []

    def noted(request, **others):
        asked.append((request.config.seed, request.config.strategy_config))
        return fit_request(request)

    monkeypatch.setattr("warpgs.pipeline.farm.work.fit_request", noted)
    flags = ["--preset", "whole", "--seeds", "1", "--steps", "2", "--device", "cpu", "--out", str(tmp_path / "out")]
    assert main(["ablate", str(scene), "--split", split_spec(8), *flags]) == 0
    assert "[2/2] still, no pm, seed 0" in capsys.readouterr().out
    figures, gaps = cells((tmp_path / "out" / "table.md").read_text())
    assert figures[0][1:9] == ["Hier", "S_rend", "S_sem", "S_geo", "RA", "AGP", "PM", "Events"]
    assert [r[1:9] for r in figures[2:]] == [["✓"] * 8, ["✓"] * 6 + ["✗", "✓"]]
    assert gaps[2] == ["no pm", "not exercised", "not exercised", "not exercised", "1"]  # two steps end before any event
    assert asked == [(0, PaperConfig()), (0, PaperConfig(pm=False))]
    assert main(["ablate", str(scene), "--out", str(tmp_path / "y"), "--preset", "3dgs"]) == 2
    assert "ablate a preset with them" in capsys.readouterr().err
