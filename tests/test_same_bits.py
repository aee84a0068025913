"""The same bits on another processor: libraries take the code that they have for it, and a fit must not show it."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bench import result_file, same_bits
from warpgs import geometry
from warpgs.io.poses import rigid

ROOT = Path(__file__).parent.parent


def rows(out: Path, *flags: str, **environment: str) -> dict:
    """The row of a run on a tiny scene, in a process of its own."""
    command = [sys.executable, "-m", "bench.same_bits", "--out", str(out), "--size", "64", "48", "--steps", "12", *flags]
    subprocess.run(command, cwd=ROOT, env=os.environ | environment, check=True, capture_output=True)
    return result_file.read(out)["rows"][-1]


@pytest.mark.skipif(platform.machine() != "x86_64", reason="chooses between code for processors of this kind")
def test_libraries_for_other_processors_and_other_thread_counts_give_the_same_fit(tmp_path):
    """All stages of both fits, without AVX-512 on 16 threads, and with the code that MKL has for other makers on one."""
    own = rows(tmp_path / "own.json")
    older = rows(tmp_path / "older.json", "--avx2", "--threads", "16")
    other = rows(
        tmp_path / "other.json", "--threads", "1", MKL_CBWR="COMPATIBLE", OPENBLAS_CORETYPE="Zen", OPENCV_IPP="disabled"
    )
    assert len(own["stages"]) > 70 and own["stages"]["3dgs: first PLY"] != own["stages"]["3dgs: last PLY"]
    for row in (older, other):
        assert [n for n in same_bits.differing(row, own) if not n.startswith(same_bits.LIBRARIES)] == []


def row(label: str, stages: dict, device: str = "cpu", **more) -> dict:
    """A row of a result."""
    machine = {"device": device, "name": "P", "threads": 2}
    return {"label": label, "machine": machine, "versions": {"torch": "2"}, "arguments": {}, "stages": stages} | more


def test_the_table_names_the_first_stage_that_differs():
    """Functions of libraries apart from stages, which are compared with the first run on that kind of device."""
    stages = {"torch.exp": "1"} | {stage: "2" for _, stage in same_bits.SHOWN}
    changed = stages | {"torch.exp": "0", "3dgs: last PLY": "0", "quick: last PLY": "0"}
    rows = [row("x", stages), row("x", changed, "cuda"), row("y", changed)]
    lines = same_bits.table(rows).splitlines()[2:]
    assert [line.split(" | ")[-2:] for line in lines[:2]] == [["none", "none |"]] * 2
    assert lines[2].endswith("| torch.exp | 3dgs: last PLY |")


def test_a_row_takes_the_place_of_the_same_run_before():
    """One of another label, kind of device or size of the scene is added."""
    rows = [row("x", {"a": "0"}), row("y", {"a": "0"})]
    assert same_bits.placed(rows, row("x", {"a": "1"})) == [row("x", {"a": "1"}), rows[1]]
    for other in (row("z", {}), row("x", {}, "cuda"), row("x", {}, arguments={"views": 2})):
        assert same_bits.placed(rows, other) == [*rows, other]


def test_small_matrices_agree_with_lapack():
    """Inverse, nearest rotation and products, which are written out so that no BLAS has a say, to float64's rounding."""
    random = np.random.default_rng(0)
    for _ in range(20):
        m = random.normal(size=(3, 3))
        assert np.allclose(geometry.inverse(m) @ m, np.eye(3), atol=1e-12 * np.linalg.cond(m))
        points = random.normal(size=(7, 3))
        assert np.allclose(geometry.matmul(points, m), points @ m, rtol=0, atol=1e-14)
        assert np.allclose(geometry.matmul(points, m[0]), points @ m[0], rtol=0, atol=1e-14)
        q, _ = np.linalg.qr(m)
        bent = np.eye(4)
        bent[:3, :3] = q * np.sign(np.linalg.det(q)) + 1e-4 * random.normal(size=(3, 3))
        u, _, vt = np.linalg.svd(bent[:3, :3])
        assert np.allclose(rigid(bent, "here")[:3, :3], u @ vt, rtol=0, atol=1e-14)
