"""The model: its table, its limits, filters and shrinking, and Gaussians that were trained elsewhere."""

import dataclasses
import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.gaussians import cloud, shapes_of
from tests.io import scenes
from tests.pipeline.train.fits import adam_step
from tests.scenes import photos, ring, seeds
from warpgs.app.cli import main
from warpgs.errors import DataError, UsageError
from warpgs.export.base import read_gaussians, suffixes, write_gaussians
from warpgs.export.meshes_and_cameras import NAMES, write_cameras
from warpgs.export.ply import read_ply
from warpgs.files import make_folder
from warpgs.geometry import harmonics, look_at, rotate
from warpgs.io.transforms import read_cameras, stated_origin
from warpgs.kernels.sh import basis
from warpgs.pipeline.films.film import FilmSettings
from warpgs.pipeline.model import edit
from warpgs.pipeline.model.clean import REASONS, chosen_reasons, in_colors, reasons_of
from warpgs.pipeline.model.limits import (
    LimitConfig,
    Limits,
    long_axes,
    scene_radius,
    shape_figures,
    shape_summary,
)
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.model.table import Column, DensityUpdate, Table, model_bytes, pack, truncated, unpack
from warpgs.pipeline.run.commands import _new_folder, open_file, prune, render
from warpgs.pipeline.run.export import Filters, convert, export
from warpgs.pipeline.run.folder import load_checkpoint, open_run
from warpgs.pipeline.train.schedule import OptimizerConfig
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians, PointCloud, base_colors
from warpgs.synthetic.demo import split_spec, write_demo
from warpgs.viewer.window import content_of_file

# The table of what training learns: everything that goes by row stays together, whatever happens to the rows.

AGE, SEEN = Column(-1, torch.int32), Column(0.5, inherited=False)


def table(count: int = 5, gaussians: Gaussians | None = None) -> Table:
    """A table after one step, so that all moments differ from 0, with a number of its own in each row of two columns."""
    made = Table.of_gaussians(cloud(count) if gaussians is None else gaussians, {"age": AGE, "seen": SEEN})
    generator = torch.Generator().manual_seed(1)
    adam_step(made, {n: torch.randn(t.shape, generator=generator) for n, t in made.params.items()})
    made.columns["age"] = torch.arange(10, 10 + len(made), dtype=torch.int32)
    made.columns["seen"] = torch.arange(0.0, len(made))
    return made


def snapshot(made: Table) -> dict[str, torch.Tensor]:
    return {n: t.clone() for n, t in made.state().items()}


def update(keep, added: dict, parents, **more) -> DensityUpdate:
    return DensityUpdate(torch.tensor(keep, dtype=torch.int64), added, torch.tensor(parents, dtype=torch.int64), **more)


def test_overwritten_rows_and_reset_opacities_start_again():
    """Indices refer to rows before the change. Parameters that are not named and columns stay; moments of the row become 0."""
    made = table()
    before = snapshot(made)
    means = torch.full((2, 3), 7.0)
    change = DensityUpdate(torch.tensor([0, 2, 3, 4]), overwritten=torch.tensor([1, 3]), values={"means": means})
    made.apply(change)
    assert len(made) == 4
    after, kept = made.state(), [0, 2, 3, 4]
    assert after["params.means"][2].tolist() == [7, 7, 7]
    for name, t in after.items():
        same = [0, 1, 3] if name == "params.means" or name.startswith("exp_avg") else [0, 1, 2, 3]
        assert torch.equal(t[same], before[name][kept][same]), name
        if name.startswith("exp_avg"):
            assert bool(before[name][3].any()) and not bool(t[2].any()), name
    # no opacity stays above the cap, lower ones stay, and moments of nothing else are zero
    g = cloud(2)
    g.logit_opacities[:] = torch.logit(torch.tensor([0.9, 0.004]))
    made = table(gaussians=g)
    before = snapshot(made)
    made.reset_opacities(0.01)
    opacities = made.params["logit_opacities"].detach().sigmoid()
    assert abs(float(opacities[0]) - 0.01) < 1e-6 and float(opacities[1]) < 0.0045
    for name, t in made.state().items():
        if name.endswith("logit_opacities"):
            assert name.startswith("params") or not bool(t.any())
        else:
            assert torch.equal(t, before[name])


def test_state_comes_back_bit_for_bit():
    """Into a table of another number of rows, and the next step is the same; a missing tensor is an error, not a default."""
    made, again = table(7), table(3)
    state = snapshot(made)
    again.load(state)
    assert len(again) == 7 and again.state().keys() == state.keys() and len(state) == 15 + 2
    for each in (made, again):
        adam_step(each, {n: torch.ones_like(t) for n, t in each.params.items()}, step=2)
    assert all(torch.equal(t, again.state()[n]) for n, t in made.state().items())
    assert all(t.requires_grad and t.is_leaf for t in again.params.values())
    del state["columns.age"]
    with pytest.raises(DataError, match=r"columns\.age"):
        again.load(state)
    empty = Table({}, {}, torch.device("cpu"), 3)
    adam_step(empty, {})
    empty.load(empty.state())
    assert len(empty) == 3 and empty.state() == {}


def test_kept_rows_keep_everything_and_new_rows_start_anew():
    """Survivors keep all bits; new rows have moments of 0, and columns of their parent, of the change, or the fill."""
    made = table()
    before = snapshot(made)
    adam_step(made, {n: torch.ones_like(t) for n, t in made.params.items()}, step=2, skip=1)
    assert all(torch.equal(t, before[n]) for n, t in made.state().items())
    order = torch.tensor([3, 0, 4, 2, 1])
    made.reorder(order)
    assert all(torch.equal(t, before[n][order]) for n, t in made.state().items())
    assert all(t.requires_grad and t.is_leaf for t in made.params.values())
    made = table()
    before, keep = snapshot(made), [0, 3, 4]
    added = {n: t[:2] + 1 for n, t in cloud(5).tensors().items()}
    made.apply(update(keep, added, [-1, -1]))
    assert len(made) == 5
    for name, t in made.state().items():
        assert torch.equal(t[:3], before[name][keep]), name
        group, _, short = name.partition(".")
        if group == "params":
            assert torch.equal(t[3:], added[short])
        elif group != "columns":
            assert bool(before[name].any()) and not bool(t[3:].any())
    assert all(t.requires_grad and t.is_leaf and t.is_contiguous() for t in made.params.values())
    made = table()
    added = {n: t[:3] for n, t in cloud(5).tensors().items()}
    made.apply(update([4, 0], added, [3, -1, 0]))
    assert made.columns["age"].tolist() == [14, 10, 13, -1, 10]
    assert made.columns["seen"].tolist() == [4, 0, 0.5, 0.5, 0.5]
    made.apply(update([0], added, [2, -1, -1], columns={"age": 99, "seen": 7}))
    assert made.columns["age"].tolist() == [14, 13, 99, 99] and made.columns["seen"].tolist() == [4, 7, 7, 7]
    assert made.columns["age"].dtype is torch.int32 and made.columns["seen"].dtype is torch.float32
    made = table(4)
    before = snapshot(made)
    added = {n: t.detach()[:2] for n, t in made.params.items()}
    for bad, parents in ((added, 1), ({n: t for n, t in added.items() if n != "sh"}, 2)):
        with pytest.raises(UsageError, match="give each row a parent"):
            made.apply(DensityUpdate(torch.arange(4), bad, torch.full((parents,), -1)))
    assert all(torch.equal(t, before[n]) for n, t in made.state().items()) and len(made) == 4


CPU = torch.device("cpu")
YES, NO = torch.tensor([True]), torch.tensor([False])
CAMERAS, VIEWS = (torch.zeros(1, 3), torch.zeros(1, 9)), photos(4)


def params(log_scales: torch.Tensor) -> dict[str, torch.Tensor]:
    return {"log_scales": log_scales.clone(), "logit_opacities": torch.linspace(-8, 8, len(log_scales))}


def test_figures_count_needles_and_what_is_beyond_and_the_radius_holds_cameras_and_points():
    scales = torch.log(torch.tensor([[62.0, 2.0, 2.0], [3.0, 3.0, 0.01], [9.0, 1.0, 1.0]]))
    logits = torch.logit(torch.tensor([0.1, 0.5, 0.4]))
    model = Gaussians(**(cloud(3).tensors() | {"log_scales": scales, "logit_opacities": logits}))
    f = shape_figures(model, LimitConfig(max_size=1.0, max_ratio=8.0, max_reach=0), 50.0, 2.0, ring(4))
    assert f["needles"] == pytest.approx(1 / 3) and f["needles_by_opacity"] == pytest.approx(0.1, rel=1e-5)
    assert f["thin"] == pytest.approx(2 / 3) and f["beyond"] == 2
    assert f["largest_over_radius"] == pytest.approx(62 / 50) and f["largest_over_extent"] == pytest.approx(31)
    assert shape_figures(model, LimitConfig(max_size=0, max_ratio=0, max_reach=0), 50.0, 2.0, ring(4))["beyond"] == 0
    assert "33.3%" in shape_summary(f) and "2 exceed the limits" in shape_summary(f)
    cameras = ring(4)
    center = np.mean([c.center for c in cameras], axis=0)
    ball = center + 5 * np.eye(3)[np.arange(30) % 3]
    ball[:2] += 1e4
    colors = np.zeros((30, 3), np.float32)
    assert scene_radius(cameras, PointCloud(ball, colors)) == pytest.approx(5)
    near = PointCloud(center + 1e-3 * np.eye(3), colors[:3])
    assert scene_radius(cameras, near) > max(np.linalg.norm(c.center - center) for c in cameras)


def test_a_fit_ends_within_its_limits():
    """Rates of scales that make needles in a few steps: none is left where limits are on, some are where they are off."""
    config = FitConfig(
        steps=40, init=InitConfig(source="points"), strategy="mcmc", optimizer=OptimizerConfig(scales_lr=0.5),
        density=DensityConfig(start=5, every=10), limits=LimitConfig(max_size=0.2, max_ratio=3.0),
    )  # fmt: skip
    free = dataclasses.replace(config, limits=LimitConfig(0.0, 0.0, 0.0))
    beyond = []
    for c in (config, free):
        fit = Trainer(VIEWS, seeds(), c, CPU)
        while fit.step < c.steps:
            fit.advance()
        beyond.append(
            shape_figures(fit.gaussians, config.limits, fit.radius, fit.context.extent, [v.camera for v in VIEWS])["beyond"]
        )
    assert beyond[0] == 0 < beyond[1]
    config = FitConfig(steps=2, init=InitConfig(source="points"))
    fit = Trainer(VIEWS, seeds(), config, CPU)
    fit.strategy.due = lambda step: step == config.steps

    def update(step):
        added = {n: t.detach()[:1].clone() for n, t in fit.table.params.items()}
        added["log_scales"] += torch.tensor([[20.0, 0.0, 0.0]])
        yield DensityUpdate(torch.arange(len(fit.table)), added, torch.tensor([0]))

    fit.strategy.update = update
    fit.advance()
    fit.advance()
    assert len(fit.gaussians) == len(seeds()) + 1
    assert shape_figures(fit.gaussians, config.limits, fit.radius, fit.context.extent, [v.camera for v in VIEWS])["beyond"] == 0


def test_axes_are_cut_and_needles_thickened():
    """In any order: the middle axis follows the longest, what is within the limits stays, and twice is as once."""
    found = params(torch.log(torch.tensor([[900.0, 1e-6, 1.0], [2.0, 1.0, 1e-9], [1e-3, 3.0, 0.05], [40.0, 40.0, 40.0]])))
    limits = Limits(30.0, 30.0)
    limits.hold(found, CAMERAS, YES)
    expected = torch.tensor([[30.0, 1e-6, 1.0], [2.0, 1.0, 1e-9], [1e-3, 3.0, 0.1], [30.0, 30.0, 30.0]])
    assert torch.allclose(found["log_scales"].exp(), expected, rtol=1e-5)
    once = found["log_scales"].clone()
    limits.hold(found, CAMERAS, YES)
    assert torch.equal(found["log_scales"], once)
    scales = torch.cat([torch.randn(200, 3), torch.tensor([[1.0, 1, 0], [0, 1, 1], [1, 0, 1], [2, 2, 2]])])
    ordered = scales.sort(1, descending=True).values
    longest, middle = long_axes(scales)
    assert torch.equal(longest, ordered[:, 0]) and torch.equal(middle, ordered[:, 1])
    Limits(ratio=2.0).hold({"log_scales": scales}, CAMERAS)
    longest, middle = long_axes(scales)
    assert float((longest - middle).max()) <= math.log(2) + 1e-6 and torch.equal(longest, ordered[:, 0])
    found = params(torch.tensor([[9.0, 0.0, 0.0], [math.nan, 0.0, 1.0]]))
    before = {n: t.clone() for n, t in found.items()}
    limits = Limits(1.0, 2.0)
    limits.hold(found, CAMERAS, NO)
    assert all(torch.equal(t.nan_to_num(7), before[n].nan_to_num(7)) for n, t in found.items())
    limits.hold(found, CAMERAS, YES)
    assert bool(found["log_scales"][1].isnan().any()) and float(found["log_scales"][0].max()) == 0
    # its longest axis is at most a third of the distance to the nearest of two cameras
    found = params(torch.log(torch.tensor([[9.0, 1.0, 1e-3], [0.5, 0.2, 0.1], [math.inf, 1.0, 1.0]])))
    found["means"] = torch.tensor([[0.0, 0, 6], [0, 0, 6], [0, 0, 6]])
    limits, centers = LimitConfig(max_ratio=0).at(1.0, 100.0), torch.tensor([[0.0, 0, 0], [0, 0, 20]])
    limits.hold(found, (centers, CAMERAS[1]), YES)
    sizes = found["log_scales"].exp()
    assert torch.allclose(sizes[:2], torch.tensor([[2.0, 1.0, 1e-3], [0.5, 0.2, 0.1]])) and sizes[2, 0].isinf()
    model = Gaussians(**(cloud(2).tensors() | {n: t[:2] for n, t in found.items()}))
    cameras = ring(4)
    over = shape_figures(model, LimitConfig(), 100.0, 1.0, cameras)["largest_over_distance"]
    nearest = min(np.linalg.norm(c.center - [0, 0, 6]) for c in cameras)
    assert over == pytest.approx(2 / nearest, rel=1e-5)
    config = LimitConfig()
    assert [config.at(p, 2.0).ratio for p in (0.0, 0.7, 0.71, 1.0)] == [math.inf, math.inf, 30, 30]
    assert config.at(0.0, 3.0).largest == 3.0
    assert LimitConfig(0.0, 0.0, 0.0).at(1.0, 2.0) == Limits()


TURN = edit.rotation_about(np.array([1.0, -2.0, 0.5]), 1.1)


@pytest.mark.parametrize("matrix", [TURN, TURN * [-1, 1, 1]], ids=["rotation", "reflection"])
@pytest.mark.parametrize("degree", [0, 1, 4])
def test_colours_and_shapes_turn_with_the_scene(degree, matrix):
    made = cloud(40, degree=degree)
    turned, turn = rotate(made, matrix), torch.from_numpy(matrix)
    d = torch.nn.functional.normalize(torch.randn(9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)), dim=1)
    k = made.sh.shape[1]
    assert np.allclose(harmonics(d.numpy()), basis(d), atol=1e-14)
    before = torch.einsum("dk,nkc->dnc", basis(d)[:, :k], made.sh.double())
    after = torch.einsum("dk,nkc->dnc", basis(d @ turn.T)[:, :k], turned.sh.double())
    assert torch.allclose(before, after, atol=1e-6)
    assert torch.allclose(shapes_of(turned), turn @ shapes_of(made) @ turn.T, rtol=1e-4, atol=1e-9)
    assert torch.allclose(turned.means.double(), made.means.double() @ turn.T, atol=1e-6)


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 1, 0), (1, 2, 3)])
def test_up_becomes_minus_y(up):
    rotation = edit.levelling(np.array(up, float))
    assert np.allclose(rotation @ (np.array(up) / np.linalg.norm(up)), [0, -1, 0], atol=1e-8)
    assert np.allclose(rotation @ rotation.T, np.eye(3)) and np.linalg.det(rotation) > 0


def test_boxes(tmp_path):
    made = cloud(200)
    plain = edit.inside(made, edit.box_of("-1,-1,3,1,1,5"))
    assert torch.equal(plain, (made.means - torch.tensor([0.0, 0, 4])).abs().amax(1) <= 1)
    path = tmp_path / "crop.json"
    turn = edit.rotation_about(np.array([0, 0, 1.0]), 0.5)
    path.write_text(json.dumps({"center": [0, 0, 4], "size": [2, 1, 4], "rotation": turn.tolist()}))
    local = (made.means.double() - torch.tensor([0.0, 0, 4])) @ torch.from_numpy(turn)
    assert torch.equal(edit.inside(made, edit.box_of(str(path))), (local.abs() <= torch.tensor([1.0, 0.5, 2])).all(1))
    path.write_text('{"center": [1, 0, 4], "size": [2, 4, 4]}')
    write_gaussians(tmp_path / "a.ply", made, units="file")
    lines = convert(tmp_path / "a.ply", tmp_path / "b.ply", Filters(crop=str(path), rotate="0,0,1,180"))
    assert f"{int((made.means[:, 0] < 0).sum())} Gaussians outside the box" in lines[0]
    assert float(read_gaussians(tmp_path / "b.ply").means[:, 0].max()) <= 0
    for text, match in (("[1, 2]", "box"), ('{"size": [1, 1, 1]}', "center"), (" " * 70000, "larger than 65,536")):
        path.write_text(text)
        with pytest.raises(DataError, match=match):
            edit.box_of(str(path))
    with pytest.raises(DataError, match="cannot be read as a box"):
        edit.box_of(str(tmp_path / "none.json"))
    path.write_text('{"center": [0,0,0], "size": [1,1,1], "rotation": [[2,0,0],[0,1,0],[0,0,1]]}')
    for text, match in (
        ("1,2,3", "takes 6 finite"), ("[" * 9000, "6 finite"), ("0,0,0,1,1,0", "longer than 0"), ("0,0,0,1,1,NaN", "finite"),
        (str(path), "must be a rotation matrix"),
    ):  # fmt: skip
        with pytest.raises(UsageError, match=match):
            edit.box_of(text)


def test_coefficients_above_the_degree_vanish_and_what_disturbs_is_counted_once():
    sh = 1 + torch.rand(5, 25, 3)
    cut = truncated(sh, torch.tensor([0, 1, 2, 3, 4]))
    for d, count in enumerate((1, 4, 9, 16, 25)):
        assert torch.equal(cut[d, :count], sh[d, :count]) and not bool(cut[d, count:].any())
    assert edit.stored_degrees(cut).tolist() == [0, 1, 2, 3, 4]
    assert torch.equal(unpack(pack(cut, edit.stored_degrees(cut)), edit.stored_degrees(cut)), cut)
    assert edit.stored_degrees(torch.zeros(2, 1, 3)).tolist() == [0, 0]
    degrees = torch.tensor([0, 0, 1, 1, 1, 2])
    sh = truncated(torch.randn(6, 16, 3), degrees)
    packed = pack(sh, degrees)  # fewer bytes
    assert packed.numel() == 3 * (2 * 1 + 3 * 4 + 9) and torch.equal(unpack(packed, degrees), sh[:, :9])
    assert model_bytes(degrees) == 4 * (6 * 11 + packed.numel())
    with pytest.raises(ValueError, match="ascend"):
        pack(sh, degrees.flip(0))
    made = dataclasses.replace(cloud(5, degree=3), sh=truncated(torch.ones(5, 16, 3), torch.ones(5)))
    assert edit.drop_unused_sh(made).sh.shape == edit.limit_degree(made, 1).sh.shape == (5, 4, 3)
    with pytest.raises(UsageError, match="degrees 0 to 4"):
        edit.limit_degree(made, 5)
    made = cloud(100)
    made.log_scales[:] = -5
    made.log_scales[0] = 4  # larger than the scene, and seen by nobody
    made.log_scales[1] = 4
    made.log_scales[2] = torch.tensor([0.5, -4.0, -5.0])  # a long needle
    made.log_scales[4] = torch.tensor([0.5, 0.5 - math.log(30) - 1e-6, -5.0])  # at the limit that a fit holds, as rounded
    made.log_scales[3] = torch.tensor([-4.0, -9.0, -9.0])  # a short one, which stays
    maxima = torch.ones(100)
    maxima[0] = 0
    found = {
        reason: where.nonzero()[:, 0].tolist() for reason, where in edit.first_reasons(edit.floaters(made, maxima)).items()
    }
    assert list(found.values()) == [[0], [1], [2]]
    assert list(edit.floaters(made)) == ["larger than the scene", "needles over 30 times as long as wide"]


def test_a_clean_up_names_each_outlier():
    """Faint, unseen, huge, thin, far and lonely ones, each by its reason; a sparse background and wide ones are no outliers."""
    made = cloud(2000)
    made.logit_opacities[:], made.log_scales[:] = 1, -4
    made.log_scales[0] = 4
    made.log_scales[1] = torch.tensor([2.5, -4.0, -5.0])
    made.logit_opacities[2] = -5
    made.means[3] = torch.tensor([0, 0, 1e3])
    made.means[4:6, 1] += 12  # a pair that is alone
    made.log_scales[5] = 1.5  # reaches its neighbours
    made.means[100:400] = 4 * made.means[100:400] + torch.tensor([0, 0, 16.0])  # the background
    maxima = torch.ones(2000)
    maxima[[2, 6]] = 0
    found = {name: where.nonzero()[:, 0].tolist() for name, where in reasons_of(made, maxima).items()}
    assert found == {"opacity": [2], "unseen": [2, 6], "size": [0], "needles": [1], "distance": [3], "density": [3, 4]}
    assert list(found) == list(REASONS) and "unseen" not in reasons_of(made, None)
    assert [*reasons_of(edit.select(made, torch.arange(0)), None)] == ["opacity"]
    shown = in_colors(made, {"size": torch.arange(2000) == 0, "opacity": torch.arange(2000) == 2})
    colors = base_colors(shown.sh)
    np.testing.assert_allclose(colors[[0, 2]], np.array([REASONS["size"][2], REASONS["opacity"][2]]) / 255, atol=1e-6)
    assert shown.log_scales[0].max() < -2 and shown.logit_opacities[2] > 0 and torch.equal(shown.sh[3:], made.sh[3:])
    assert chosen_reasons("all, unseen") == tuple(REASONS) and chosen_reasons("size, unseen") == ("size", "unseen")
    for wrong in ("", "unseen,", "far", "show,all"):
        with pytest.raises(UsageError, match="show, all, or some of opacity, unseen, size"):
            chosen_reasons(wrong)


def test_convert_says_what_it_did(tmp_path):
    made = cloud(100, degree=2)
    made.log_scales[7] = 4
    write_gaussians(tmp_path / "a.ply", made, units="file")
    lines = convert(tmp_path / "a.ply", tmp_path / "b.spz", Filters(sh_degree=1))
    assert any("removed Gaussians: 1 larger than the scene (--no-clean" in line for line in lines)
    assert any("above degree 1 are left out (--sh-degree)" in line for line in lines)
    assert any("SPZ has y up" in line for line in lines)
    assert "99 Gaussians in" in lines[-1] and read_gaussians(tmp_path / "b.spz").sh.shape == (99, 4, 3)
    lines = convert(tmp_path / "b.spz", tmp_path / "c.ply", Filters(crop="-1,-1,3,1,1,5", rotate="0,0,1,180"))
    assert "SPZ has y up" in lines[0]
    assert not any("removed" in line for line in lines) and any("rotated by 180.0 degrees" in line for line in lines)
    assert float(read_gaussians(tmp_path / "c.ply").means[:, :2].abs().max()) <= 1
    convert(tmp_path / "a.ply", tmp_path / "d.ply")
    assert (tmp_path / "d.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()
    assert any(".splat files cannot store them" in line for line in convert(tmp_path / "a.ply", tmp_path / "e.splat"))
    for wish, match in (("level", "cameras of a run"), ("0,0,0,9", "length 0"), ("1,2", "x,y,z,degrees")):
        with pytest.raises(UsageError, match=match):
            convert(tmp_path / "a.ply", tmp_path / "f.glb", Filters(rotate=wish))
    with pytest.raises(DataError, match="no Gaussian is left"):
        convert(tmp_path / "a.ply", tmp_path / "f.glb", Filters(crop="90,90,90,91,91,91"))
    assert not (tmp_path / "f.glb").exists()


@pytest.mark.parametrize(
    "suffix,flags,count",
    [
        ("spz", [], 99), ("ply", [], 100), ("spz", ["--no-clean"], 100), ("ply", ["--clean"], 99),
        ("glb", ["--crop", "-9,-9,-9,9,9,9"], 99),
    ],
)  # fmt: skip
def test_files_for_strangers_are_cleaned_unless_asked_otherwise(suffix, flags, count, tmp_path):
    made = cloud(100)
    made.log_scales[7] = 4
    write_gaussians(tmp_path / "a.ply", made, units="file")
    words = ["convert", str(tmp_path / "a.ply"), str(tmp_path / f"b.{suffix}")]
    assert main([*words, *flags]) == 0 and len(read_gaussians(tmp_path / f"b.{suffix}")) == count
    assert main([*words, "--clean", "--no-clean"]) == UsageError.exit_code


@pytest.mark.parametrize("power", [0.4, 1, 2])
@pytest.mark.parametrize("limit", [1e-3, 0.1, 30])
def test_largest_budget(limit, power):
    """At nearly the whole limit, never above it, after few tries from far off; at a step between both sides of it."""
    tried = {}
    budget = edit.largest_budget(tried, lambda b: (b / limit) ** power, 1.0, 1e9, 1.0)
    assert edit.AIM <= (budget / limit) ** power <= 1 and len(tried) <= 6
    bounded = {}
    budget = edit.largest_budget(bounded, lambda b: 40 * (1 - math.exp(-((b / limit) ** power) / 10)), 1e6, 1e9, 3.0)
    assert edit.AIM * 3 <= bounded[budget] <= 3
    tried = {}
    budget = edit.largest_budget(tried, lambda b: 1e-9 + 1e3 * (b > limit), 1.0, 1e9, 1.0)
    assert 0 < budget <= limit and len(tried) == edit.TRIES
    assert edit.largest_budget(tried, lambda b: 1e-9 + 1e3 * (b > limit), 1.0, 1e9, 1.0) >= budget, "it forgot what it tried"


def test_a_budget_is_0_or_was_tried():
    """Also where losses are negative, equal, undefined or do not grow with the budget; a search ends at the largest budget."""
    assert edit.largest_budget({}, lambda b: -1.0, 1.0, 50.0, 0.1) == 50
    for loss in (1.0, math.nan, math.inf):
        assert edit.largest_budget({}, lambda b, loss=loss: loss, 1.0, 50.0, 0.1) == 0
    for seed in range(20):
        draw, tried = np.random.default_rng(seed), {}
        budget = edit.largest_budget(tried, lambda b, d=draw: d.uniform(-0.1, 0.4), 1.0, 50.0, 0.1)
        assert tried.get(budget, 0.0) <= 0.1 and all(0 < b <= 50 for b in tried)


def test_the_cheapest_rows():
    scores, changes = torch.tensor([3.0, 1.0, 0.0, 2.0]), torch.tensor([0.1, 5.0, 1.0, 0.0])
    for budget, rows in ((0.5, []), (1.0, [2]), (5.9, [2]), (6.0, [1, 2, 3]), (1e9, [1, 2, 3])):
        assert edit.cheapest(scores, changes, budget).nonzero()[:, 0].tolist() == rows


@pytest.mark.parametrize("hidden", [0.5, 1, 2, 6, 1e9])
def test_few_views_do_not_decide_alone(hidden):
    """A model whose loss on all views is too large is refused, and a larger one taken; at worst the whole one."""
    whole, tries = cloud(400, degree=1), {True: [], False: []}
    cameras = [torch_camera(c) for c in ring(3, 40, 30)]

    def loss(made, on_all):
        tries[on_all].append(made)
        removed = 1 - len(made) / len(whole)
        return 0.01 * math.exp(5 * removed) * (hidden if on_all else 1)

    made, lost = edit.prune_model(whole, cameras, RasterizeOptions(), 0, loss, 0.1, 1.0)
    assert lost <= 0.1 and (lost == 0 if hidden == 1e9 else made is tries[True][-1] and lost == loss(made, True))
    assert (len(made) == len(whole)) == (hidden == 1e9)
    assert len(tries[True]) <= edit.REPEATS + 1 and len(tries[False]) <= edit.TRIES * edit.REPEATS


def test_degrees_stay_if_lower_ones_alone_lose_too_much_on_all_views():
    """Gaussians are removed all the same."""
    whole, cameras = cloud(400, degree=1), [torch_camera(c) for c in ring(3, 40, 30)]

    def loss(made, on_all):
        return 0.1 * (1 - len(made) / len(whole)) + (on_all and not bool((edit.stored_degrees(made.sh) == 1).all()))

    made, lost = edit.prune_model(whole, cameras, RasterizeOptions(), 0, loss, 0.05, 1.0)
    assert 0.2 < len(made) / len(whole) < 0.6 and lost <= 0.05


FLAGS = f"--split {split_spec(8)} --steps 80 --device cpu --preset 3dgs --sh-every 20 --init.random-count 600".split()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("prune")
    write_demo(folder / "scene", views=8, width=64, height=48)
    assert main(["fit", str(folder / "scene"), "--out", str(folder / "run"), *FLAGS]) == 0
    return folder / "run"


def moved(run, folder, offset):
    shutil.copytree(run, folder, ignore=shutil.ignore_patterns("report*", "*.ply"))
    record = json.loads((folder / "config.json").read_text())
    record["normalization"]["offset"] = (np.array(record["normalization"]["offset"]) + offset).tolist()
    (folder / "config.json").write_text(json.dumps(record))
    return folder


def loss(a, b):
    return -10 * math.log10(max(float((a - b).square().mean()), 1e-12))


@pytest.mark.parametrize("offset", [(1e4, 0, 0), (441_000.4, 5_500_000.7, 130), (-4e6, 5.5e6, 4.9e6)])
@pytest.mark.parametrize("cameras", NAMES)
def test_exports_at_map_coordinates(run, tmp_path, offset, cameras):
    """Files of every format render as at the origin, with cameras of every format, by the point that they state."""
    renders = {}
    for name, place in (("near", np.zeros(3)), ("far", np.array(offset))):
        there = moved(run, tmp_path / name, place)
        lines = export(there, there / cameras)
        stored = open_run(there, "cpu")
        camera = torch_camera(list(stored.cameras().values())[1])
        wanted = rasterize(stored.gaussians(), camera, stored.options()).rgb
        assert any("are relative to" in line for line in lines) == (name == "far")
        other = there / "other" / ("sparse" if cameras != "sparse" else "cameras.json")
        lines = convert(there / cameras, other)  # keeps the origin, which other programs need
        assert any(f"are relative to {', '.join(f'{v:.12g}' for v in stored.normalization.origin)}" in x for x in lines) == (
            name == "far"
        )
        assert np.allclose(stated_origin(other), stored.normalization.origin, rtol=0, atol=0)
        for suffix in suffixes():
            lines = export(there, there / f"a{suffix}", Filters(clean=False))
            assert any("are relative to" in line and "exported" not in line for line in lines) == (name == "far")
            convert(there / f"a{suffix}", there / f"b{suffix}", Filters(clean=False))
            for file in (f"a{suffix}", f"b{suffix}"):
                model, _ = open_file(there / file, there / cameras, stored.rule, "cpu")
                view = torch_camera(list(model.cameras().values())[1])
                back = rasterize(model.gaussians(), view, model.options()).rgb
                renders[name, file] = loss(back, wanted)
            absolute = read_gaussians(there / f"a{suffix}")
            known = read_gaussians(there / f"a{suffix}", stored.normalization, units="scene")
            middle = (absolute.means.double().mean(0).numpy() - stored.normalization.offset) * stored.normalization.scale
            assert np.allclose(known.means.double().mean(0).numpy(), middle, atol=1e-4) and known.means.dtype == torch.float32
            if suffix == ".ply":
                write_gaussians(there / "c.ply", absolute, units="file")  # Gaussians in file units, from Python
                again = read_gaussians(there / "c.ply", stored.normalization, units="scene")
                assert torch.allclose(again.means, known.means, atol=1e-5)
    for (name, file), psnr in renders.items():
        assert psnr >= min(50, renders["near", file] - 0.2), (name, file, psnr)


def test_files_with_small_units(run, tmp_path, capsys):
    folder = moved(run, tmp_path / "run", np.zeros(3))
    record = json.loads((folder / "config.json").read_text())
    record["normalization"]["scale"] *= 100
    (folder / "config.json").write_text(json.dumps(record))
    stored, cameras = open_run(folder, "cpu"), folder / "transforms.json"
    wanted = rasterize(stored.gaussians(), torch_camera(list(stored.cameras().values())[1]), stored.options()).rgb
    export(folder, cameras)
    for name, rule, near in (("a.ply", None, None), ("a.glb", None, None), ("a.ply", "exact", 1e-4), ("a.spz", "exact", 1e-4)):
        export(folder, folder / name, Filters(clean=False))
        model, _ = open_file(folder / name, cameras, rule, "cpu", near=near)
        back = rasterize(model.gaussians(), torch_camera(list(model.cameras().values())[1]), model.options()).rgb
        assert loss(back, wanted) >= (50 if name != "a.spz" else 30), (name, rule)
    words = ["render", str(folder / "a.spz"), "--cameras", str(cameras), "--path", "views", "--device", "cpu", "--out"]
    assert main([*words, str(tmp_path / "black")]) == 0
    said = capsys.readouterr().out
    assert (
        "% of the Gaussians in front of the cameras are nearer than the near plane, 0.2 units" in said and "--near 0.0" in said
    )
    assert "the path leaves" not in said
    assert main([*words, str(tmp_path / "near"), "--near", "1e-4"]) == 0
    assert "nearly nothing" not in capsys.readouterr().out
    assert main(["render", str(folder), "--near", "1"]) == UsageError.exit_code


def test_prune_keeps_its_promise(run, tmp_path, capsys):
    before = {p: p.read_bytes() for p in run.rglob("*") if p.is_file()}
    assert main(["prune", str(run), "--keep-psnr", "0.2", "--out", str(tmp_path / "a small one"), "--device", "cpu"]) == 0
    words = capsys.readouterr().out
    assert "Gaussians, mean SH degree" in words and "times smaller" in words and "held-out PSNR" in words
    assert f"`warpgs eval '{tmp_path}/a small one'` scores it" in words and f"`warpgs render '{tmp_path}/a small one'`" in words
    assert "trying smaller models: number 1" in words and "scoring the smaller model" in words
    assert len(re.findall("trying smaller models: number", words)) <= edit.TRIES + edit.REPEATS, "one search"
    assert before == {p: p.read_bytes() for p in run.rglob("*") if p.is_file()}
    record = json.loads((tmp_path / "a small one" / "config.json").read_text())["pruned"]
    whole, small = (open_run(f, CPU).gaussians() for f in (run, tmp_path / "a small one"))
    assert record["count"] == [len(whole), len(small)] and record["bytes"][1] < 0.6 * record["bytes"][0]
    assert record["train_psnr"][1] >= record["train_psnr"][0] - 0.2
    assert json.loads((run / "metrics.json").read_text())["train"]["psnr"] == pytest.approx(record["train_psnr"][0])

    degrees = edit.stored_degrees(small.sh)
    assert bool((degrees.diff() >= 0).all()), "not sorted by degree"
    tensors, _ = load_checkpoint(tmp_path / "a small one")
    stored = sum(t.numel() * t.element_size() for n, t in tensors.items() if n.startswith("params."))
    assert stored == record["bytes"][1]
    ply = read_ply(tmp_path / "a small one" / "point_cloud.ply")
    assert len(ply) == len(small) and torch.equal(ply.sh, small.sh)

    assert main(["eval", str(tmp_path / "a small one"), "--device", "cpu"]) == 0
    scores = json.loads((tmp_path / "a small one" / "eval.json").read_text())
    assert scores["train"]["psnr"] == pytest.approx(record["train_psnr"][1], abs=1e-9)
    assert scores["test"]["psnr"] == pytest.approx(record["test_psnr"][1], abs=1e-9)


def test_a_clean_up_is_shown_before(run, tmp_path, capsys):
    """Numbers by reason, the same when it is shown and done; a picture with the colours; the run keeps its bytes."""
    words = ["prune", str(run), "--device", "cpu", "--clean"]
    before = {p: p.read_bytes() for p in run.rglob("*") if p.is_file()}
    assert main([*words, "show"]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"([0-9,]+) seen by no training view \(unseen, magenta\)", shown) and "held-out PSNR" in shown
    off = np.abs(np.asarray(Image.open(run / "clean.png").convert("RGB")).astype(int) - REASONS["unseen"][2]).max(2)
    third = off.shape[1] // 3
    assert off[:, third : 2 * third].min() < 70 < min(off[:, :third].min(), off[:, 2 * third :].min()), (
        "in colour in the middle"
    )
    assert off[off.shape[0] // 2 :, third : 2 * third].min() > 70, "and above alone; below, the model from beside"
    assert "if smears remain, cut them off: save a crop box in `warpgs view " in shown
    assert main([*words, "unseen,opacity", "--out", str(tmp_path / "clean")]) == 0
    said = capsys.readouterr().out
    assert "training PSNR" in said and f"{run} keeps the model before" in said
    (run / "clean.png").unlink()
    assert before == {p: p.read_bytes() for p in run.rglob("*") if p.is_file()}
    record, count = json.loads((tmp_path / "clean" / "config.json").read_text())["pruned"], len(open_run(run, CPU).gaussians())
    assert set(record["removed"]) == {"opacity", "unseen"} and 0 < record["removed"]["unseen"] < count / 2
    assert len(open_run(tmp_path / "clean", CPU).gaussians()) == count - sum(record["removed"].values())
    assert main(["prune", str(tmp_path / "clean"), "--clean", "size,opacity,unseen", "--device", "cpu"]) == 0
    assert "none of" in capsys.readouterr().out and not (tmp_path / "clean-pruned").exists()
    for more, message in (
        (["show", "--out", str(tmp_path / "b")], "leave out --out"),
        (["all", "--keep-psnr", "1"], "one of the two"),
    ):
        assert main([*words, *more]) == 2 and message in capsys.readouterr().err


def test_bad_input_is_named(run, tmp_path, capsys, monkeypatch):
    (tmp_path / "there").mkdir()
    cases = [
        ([str(tmp_path / "none")], 3, "no such folder"),
        ([str(run), "--out", str(tmp_path / "there")], 2, "exists already"),
        ([str(run), "--out", str(run)], 2, "exists already"),
    ]
    for words, code, message in cases:
        assert main(["prune", *words, "--device", "cpu"]) == code
        assert message in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["there"]
    for keep in (0, 1e-9, 5000, math.nan, math.inf):
        with pytest.raises(UsageError, match="keep-psnr"):
            prune(run, keep, None, "cpu")
    monkeypatch.chdir(run)
    assert _new_folder(Path("."), None) == run.parent / f"{run.name}-pruned"
    prune(run, 1.0, tmp_path / "small", "cpu")
    scene = json.loads((run / "config.json").read_text())["scene"]["path"]
    assert main(["fit", scene, "--out", str(tmp_path / "small"), "--resume", *FLAGS]) == 2
    assert str(run) in capsys.readouterr().err


def test_only_the_mirror_keeps_its_harmonics():
    """Left matt, right as bright as the direction it is seen from: after lowering degrees, only the right has any."""
    generator = torch.Generator().manual_seed(0)
    count = 60
    g = cloud(count, degree=1)
    g.means[:] = torch.cat([2 * torch.rand(count, 2, generator=generator) - 1, torch.zeros(count, 1)], 1)
    g.means.mul_(torch.tensor([0.8, 0.5, 1]))
    g.log_scales[:] = math.log(0.08)
    g.logit_opacities[:] = 2.0
    right = g.means[:, 0] > 0.1
    g.sh[:, 1:] = 1e-4 * torch.randn(count, 3, 3, generator=generator)  # what noise leaves in a coefficient
    g.sh[right, 3] = 1.5
    cameras = [torch_camera(c) for c in ring(6, 80, 60)]
    photos = [rasterize(g, c).rgb for c in cameras]

    def loss(model, on_all) -> float:
        return max(float((rasterize(model, c).rgb - p).square().mean()) for c, p in zip(cameras, photos))

    made, lost = edit.prune_model(g, cameras, RasterizeOptions(), 0, loss, 1e-6, 1e-3)
    kept = {tuple(m): d for m, d in zip(made.means.tolist(), edit.stored_degrees(made.sh).tolist())}
    degrees = torch.tensor([kept.get(tuple(m), 0) for m in g.means.tolist()])
    assert lost <= 1e-6 and bool((degrees[~right] == 0).all()) and float(degrees[right].float().mean()) > 0.8


def make_cameras(count=3):
    K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    up, target = np.array([0.0, -1, 0]), np.array([0.0, 0, 4])
    return [Camera(look_at(np.array([0.5 * i - 0.5, 0.2 * i, 0.0]), target, up), K, 64, 48) for i in range(count)]


def torch_camera(camera):
    return Camera(*(torch.from_numpy(np.asarray(m)).float() for m in (camera.viewmat, camera.K)), camera.width, camera.height)


@pytest.mark.parametrize("name", NAMES)
def test_cameras_read_back(name, tmp_path):
    made = make_cameras()
    assert write_cameras(tmp_path / name, made) == []
    found, notes = read_cameras(tmp_path / name if name != "sparse" else tmp_path)
    text = "".join(p.read_text() for p in tmp_path.rglob("*") if p.is_file())
    assert len(found) == 3 and not notes and str(tmp_path) not in text
    for a, b in zip(made, found.values()):
        assert np.allclose(a.viewmat, b.viewmat) and np.allclose(a.K, b.K) and (a.width, a.height) == (b.width, b.height)
    with pytest.raises(UsageError, match=r"cameras\.json or transforms\.json"):
        write_cameras(tmp_path / "poses.json", made)
    made[0].K[0, 2] += 2
    make_folder(tmp_path / "b")
    notes = write_cameras(tmp_path / "b" / name, made)
    assert ("up to 2.0 px" in notes[0]) if name == "cameras.json" else not notes


def test_colmap_reads_our_cameras(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    write_cameras(tmp_path / "sparse", made := make_cameras())
    found = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert len(found.images) == 3 and len(found.cameras) == 1
    for image in found.images.values():
        pose = np.asarray(image.cam_from_world().matrix())
        assert np.allclose(pose, made[int(image.name[:4])].viewmat[:3])


def test_cameras_turn_with_their_gaussians(tmp_path):
    made, cameras = cloud(50, degree=2), make_cameras()
    write_gaussians(tmp_path / "a.ply", made, units="file")
    write_cameras(tmp_path / "cameras.json", cameras)
    turn = Filters(rotate="1,2,3,70")
    convert(tmp_path / "a.ply", tmp_path / "b.ply", turn)
    lines = convert(tmp_path / "cameras.json", tmp_path / "b" / "transforms.json", turn)
    assert "rotated by 70.0 degrees" in lines[0] and "3 cameras for images of 64 x 48 px in" in lines[-1]
    files = (("a.ply", "cameras.json"), ("b.ply", "b/transforms.json"))
    models = [open_file(tmp_path / x, tmp_path / y, "inria", "cpu")[0] for x, y in files]
    images = [rasterize(m.gaussians(), torch_camera(list(m.cameras().values())[1]), m.options()).rgb for m in models]
    images.append(rasterize(made, torch_camera(cameras[1]), RasterizeOptions(rule="inria")).rgb)
    assert float(torch.stack(images).diff(dim=0).abs().max()) < 1e-3 and float(images[0].max()) > 0.1
    with pytest.raises(UsageError, match="do not apply to cameras"):
        convert(tmp_path / "cameras.json", tmp_path / "c" / "cameras.json", Filters(clean=True))
    convert(tmp_path / "cameras.json", tmp_path / "l" / "cameras.json", Filters(rotate="level"))
    with pytest.raises(UsageError, match="not supported"):
        convert(tmp_path / "cameras.json", tmp_path / "c.txt")


def test_cameras_of_colmap_and_files_that_hold_none(tmp_path):
    scenes.write_colmap(tmp_path)
    with pytest.raises(UsageError, match="exists already"):
        write_cameras(tmp_path / "sparse", make_cameras())
    found, _ = read_cameras(tmp_path)
    assert len(found) == 5 and list(found) == sorted(found)
    lines = convert(tmp_path, tmp_path / "transforms.json")  # names of files may say who and where
    assert all("photo" in name for name in found) and "5 cameras" in lines[-1]
    assert "photo" not in (tmp_path / "transforms.json").read_text()
    for below in ("sparse", "sparse/0"):
        assert list(read_cameras(tmp_path / below)[0]) == list(found)
    row = '"position": [0, 0, %s], "width": 9, "height": 9, "fx": 9, "fy": 9}]'
    for text, match in (
        ("[]", "holds no camera"), ("{}", "no list 'frames'"), ("[" * 10000, "cannot be read as JSON"),
        ('[{"rotation": [[1,0,0],[0,1,0],[0,0,1]], ' + row % "1e999", "camera 0"),
        ('[{"rotation": [[2,0,0],[0,1,0],[0,0,1]], ' + row % "0", "camera 0"),
        ('{"frames": [{"transform_matrix": [[1]], "w": 9, "h": 9, "fl_x": 9}]}', "frame 0"),
    ):  # fmt: skip
        (tmp_path / "cameras.json").write_text(text)
        with pytest.raises(DataError, match=match):
            read_cameras(tmp_path / "cameras.json")


def test_commands_count_what_a_file_loses(tmp_path, capsys):
    """Renders and the viewer, as an export does."""
    path = tmp_path / "a.splat"
    write_gaussians(path, cloud(50), units="file")
    path.write_bytes(np.array([np.nan], "<f4").tobytes() + path.read_bytes()[4:])
    write_cameras(tmp_path / "cameras.json", make_cameras())
    model, notes = open_file(path, tmp_path / "cameras.json", "inria", "cpu")
    assert len(model.gaussians()) == 49 and any("1 of 50 Gaussians left out" in note for note in notes)
    assert len(content_of_file(path).model.gaussians()) == 49 and "1 of 50 Gaussians left out" in capsys.readouterr().out


def test_render_of_a_file_plain_and_antialiased(tmp_path):
    write_gaussians(tmp_path / "a.spz", cloud(50), units="file")
    write_cameras(tmp_path / "cameras.json", make_cameras())
    out, settings = tmp_path / "out", FilmSettings()
    lines = render(tmp_path / "a.spz", "views", out, settings, "cpu", file_of=(tmp_path / "cameras.json", None))
    assert any("cut-offs of inria" in line for line in lines) and any("the background is black" in line for line in lines)
    assert len(list(out.glob("*.png"))) == 3
    write_cameras(tmp_path / "transforms.json", [replace(c, K=1000 * c.K, width=20000, height=20000) for c in make_cameras()])
    with pytest.raises(DataError, match="20000 x 20000 px are over 100,000,000 pixels"):
        render(tmp_path / "a.spz", "views", out, settings, "cpu", file_of=(tmp_path / "transforms.json", None))
    assert main(["render", str(tmp_path / "none.ply"), "--cameras", str(tmp_path / "cameras.json")]) == DataError.exit_code
    assert main(["render", str(tmp_path), "--cameras", str(tmp_path / "cameras.json")]) == UsageError.exit_code
    with pytest.raises(UsageError, match="cameras are named"):
        convert(tmp_path / "cameras.json", tmp_path / "poses.json")
    with pytest.raises(UsageError, match="has no cameras"):
        render(tmp_path / "a.spz", "views", out, settings, "cpu", file_of=(None, None))
    with pytest.raises(UsageError, match="unknown rule 'other'"):
        render(tmp_path / "a.spz", "views", out, settings, "cpu", file_of=(tmp_path / "cameras.json", "other"))
    assert json.loads((tmp_path / "cameras.json").read_text())[0]["img_name"] == "0000"
    made = cloud(50)
    made.log_scales.sub_(2)  # below a pixel
    write_gaussians(tmp_path / "a.ply", made, units="file")
    write_cameras(tmp_path / "cameras.json", make_cameras())
    model, _ = open_file(tmp_path / "a.ply", tmp_path / "cameras.json", "exact", "cpu", antialiased=True)
    camera = torch_camera(next(iter(model.cameras().values())))
    image, plain = (rasterize(model.gaussians(), camera, options).rgb for options in (model.options(), RasterizeOptions()))
    assert torch.equal(image, rasterize(model.gaussians(), camera, RasterizeOptions(antialiased=True)).rgb)
    assert float(image.sum()) < 0.7 * float(plain.sum())
    file = f"render {tmp_path}/a.ply --cameras {tmp_path}/cameras.json --path views --device cpu".split()
    frames = []
    for flags in (["--antialiased"], []):
        assert main([*file, "--out", str(tmp_path / f"out{len(flags)}"), *flags]) == 0
        frames.append(sorted((tmp_path / f"out{len(flags)}").glob("*.png"))[0].read_bytes())
    assert frames[0] != frames[1]
    assert main(["render", str(tmp_path), "--antialiased"]) == UsageError.exit_code
