"""The page for users of gsplat: its code runs, and it has a row for every argument."""

import re

from tools.run_docs import ROOT, collect

PAGE = ROOT / "docs" / "coming-from-gsplat.md"
ARGUMENTS = """means quats scales opacities colors viewmats Ks width height near_plane far_plane radius_clip eps2d sh_degree
packed tile_size backgrounds render_mode sparse_grad absgrad rasterize_mode channel_chunk distributed camera_model segmented
covars
with_ut with_eval3d return_normals global_z_order rays radial_coeffs tangential_coeffs thin_prism_coeffs ftheta_coeffs
lidar_coeffs external_distortion_coeffs rolling_shutter viewmats_rs ut_params extra_signals extra_signals_sh_degree
renderer_config""".split()
"""Arguments of gsplat 1.6.0's rasterization, in its order."""


def test_the_code_runs(capsys):
    """The block with warpgs prints the shapes that its comment states."""
    (block,) = [b for b in collect(PAGE.name, PAGE.read_text("utf-8")) if b.python and b.code]
    exec(compile(block.code, PAGE.name, "exec"), {})
    printed = re.findall(r"\[[\d, ]+\]", capsys.readouterr().out)
    assert printed == re.findall(r"\[[\d, ]+\]", block.code.splitlines()[-1].split("#")[1])


def test_every_argument_has_a_row():
    """No argument of gsplat is left out, and none is invented; the page stays short."""
    text = PAGE.read_text("utf-8")
    table = text.split("## Arguments")[1].split("## Results")[0]
    named = [name for row in table.splitlines()[4:] for name in re.findall(r"`(\w+)`", row.split("|")[1] if "|" in row else "")]
    assert set(named) == set(ARGUMENTS)
    assert len(text.split()) <= 800
