"""Objects with true alpha in the bench: other backgrounds, rows of fits of both formats, failures, and the table."""

import math

import numpy as np
import pytest
import torch

from bench import objects, result_file
from tests import gaussians as sets
from warpgs import RasterizeOptions, rasterize
from warpgs.scene import View


def test_a_ply_is_right_before_every_background_where_the_truth_is_rendered_by_itself():
    """What the Gaussians themselves look like over a colour is no error before any background; another opacity is one."""
    ours, camera, gray = sets.cloud(40), sets.camera(dtype=torch.float32), (0.5, 0.25, 0.75)
    r = rasterize(ours, camera, RasterizeOptions(background=torch.tensor(gray)))
    view = View("a", camera, r.rgb.clamp(0, 1).numpy(), alpha=r.alpha.numpy())
    assert 0.02 < view.alpha.mean() < 0.98
    right = objects.ply_scores(ours, [view], gray)
    assert set(right) == {"ply_black", "ply_white", "ply_pattern"} and min(right.values()) > 45
    denser = View("a", camera, view.image, alpha=np.sqrt(view.alpha))
    wrong = objects.ply_scores(ours, [denser], gray)
    assert max(wrong.values()) < 35


def test_a_row_a_failure_and_what_is_done_when_the_command_is_given_again(tmp_path, monkeypatch, capsys):
    """Every fit is a row that is kept; a failure is one, too, and is tried again."""
    kept, calls = objects.measure, []

    def here(work, tasks, jobs, seconds, first):  # in this process: workers start for seconds
        for task in tasks:
            calls.append(task.format)
            yield task, kept(task) if calls == ["transforms", "colmap"] else {"error": "DataError: damaged"}

    monkeypatch.setattr(objects, "finished", here)
    out, preset = tmp_path / "objects.json", "quick:steps=3,init.source=random"
    words = ["--objects", "1", "--first", "7", "--presets", preset, "--views", "9", "--size", "32", "--device", "cpu"]
    for again in (1, 2):
        assert objects.main([*words, "--out", str(out)]) == 1
        assert calls == ["transforms", "colmap", "transforms"][: again + 1]
    row = next(r for r in result_file.read(out)["rows"] if "error" not in r)
    assert all(math.isfinite(row[k]) for k in objects.SCORES)
    assert (row["steps"], row["object"], row["format"]) == (3, 7, "colmap")
    assert 0 <= row["alpha_empty"] < row["alpha_object"] <= 1
    assert row["ply_white"] == pytest.approx(row["psnr_white"], abs=0.05)
    told = capsys.readouterr().out
    assert "transforms quick" in told and "failed: DataError: damaged" in told
    assert told.splitlines()[-1].startswith(f"| colmap | {preset} | 1 |")
