"""Two checkouts in turn: scenes at the same time on cores of their own, pairs kept as they end."""

import json
import threading
import time
from pathlib import Path

import pytest

from bench.fits import turns


@pytest.fixture
def fake(monkeypatch, tmp_path):
    """Record commands in place of running them; returns their cores, checkouts and scenes, and how many ran at once."""
    ran, lock, now = [], threading.Lock(), []

    def run(words, checkout, env, out):
        with lock:
            now.append(words)
            ran.append((words[2], checkout.name, Path(words[words.index("fit") + 1]).name, len(now), env))
        time.sleep(0.05)
        with lock:
            now.remove(words)
        return dict.fromkeys(("wall", "setup", "training", "total", "steps", "gaussians"), 2) | {"psnr": 20.0}

    monkeypatch.setattr(turns, "timed", run)
    monkeypatch.setattr(turns, "compile_kernels", lambda checkout, env: ran.append(("", checkout.name, "kernels", 1, env)))
    return ran


def test_scenes_run_at_the_same_time_on_cores_of_their_own(fake, tmp_path, capsys):
    """Both checkouts of a scene take turns on the same cores, no cores have two fits at once, and the order alternates."""
    out = tmp_path / "turns.json"
    flags = ["--rounds", "2", "--cores", "0,1", "2,3", "--out", str(out)]
    assert turns.main([str(tmp_path / "a"), str(tmp_path / "b"), "x@llff:3", "y@llff:9", "z@llff:3", *flags]) == 0
    compiled, fits = [r for r in fake if r[2] == "kernels"], [r for r in fake if r[2] != "kernels"]
    assert sorted(r[1] for r in compiled) == ["a", "b"] and len(fits) == 12
    assert max(r[3] for r in fits) == 2 and {r[0] for r in fits} == {"0,1", "2,3"}
    for scene in "xyz":
        own = [r for r in fits if r[2] == scene]
        assert [r[1] for r in own] == ["a", "b", "b", "a"], own
        assert own[0][0] == own[1][0] and own[2][0] == own[3][0]
    assert {r[4]["OMP_NUM_THREADS"] for r in fits} == {"2"}
    assert len({r[4]["WARP_CACHE_PATH"] for r in fake}) == 2
    rows = json.loads(out.read_text("utf-8"))["rows"]
    assert len(rows) == 12 and {r["scene"] for r in rows} == {"x llff:3", "y llff:9", "z llff:3"}
    assert "mean of 3 scenes" in capsys.readouterr().out
