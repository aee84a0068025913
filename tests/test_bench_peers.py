"""Other rasterizers behind one call, with stand-ins for what needs CUDA, and their tables."""

import dataclasses
import inspect
import sys
from types import SimpleNamespace

import numpy as np
import torch

from bench.lib import gsplat_calls, inputs, judge, peers, rasterizers
from bench.lib.rasterizers import Drawing
from warpgs import RasterizeOptions, rasterize
from warpgs.compat import gsplat as compat
from warpgs.constants import RULES, Rule
from warpgs.export.base import half_turn
from warpgs.kernels.ssim import ssim
from warpgs.scene import Camera, Gaussians

CPU = torch.device("cpu")


def dense(g: Gaussians, camera: Camera, rule: Rule = RULES["exact"]) -> Drawing:
    leaves = {n: t.detach().clone().requires_grad_() for n, t in g.tensors().items()}
    return Drawing(lambda: peers.dense_rasterize(Gaussians(**leaves), camera, rule), leaves)


def test_ours_and_plain_torch_give_the_same_gradients():
    """In float64, by our names and shapes, under every rule that plain torch knows; the same SSIM."""
    a, b = (inputs.image(40, 30, CPU, seed=seed) for seed in (0, 1))
    assert (ssim(a, b) - peers.torch_ssim(a, b)).abs().max() < 1e-4
    g = Gaussians(**{n: t.detach().double() for n, t in inputs.gaussians(40, CPU).tensors().items()})
    g = dataclasses.replace(g, logit_opacities=g.logit_opacities + 4, log_scales=g.log_scales + 1)  # many pixels stop
    camera = inputs.camera(20, 16, CPU)
    camera = Camera(camera.viewmat.double(), camera.K.double(), 20, 16)
    weights = torch.randn(16, 20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    for rule in (RULES["exact"], RULES["gsplat-1.6"], rasterizers.FASTER_GS_RULE):
        ours, plain = rasterizers.ours(g, camera, rule=rule), dense(g, camera, rule)
        a, b = (drawing.named_gradients(weights) for drawing in (ours, plain))
        assert list(a) == list(g.tensors()) and ours.image().shape == (16, 20, 3)
        assert (ours.image() - plain.image()).abs().max() < 1e-7
        assert all(a[n].shape == t.shape and (a[n] - b[n]).norm() < 1e-7 * b[n].norm() for n, t in g.tensors().items())
    # channels first, coefficients in two tensors, opacities in a column: images and gradients are ours
    g, camera = inputs.gaussians(30, CPU), inputs.camera(20, 16, CPU)
    t = {name: v.detach() for name, v in g.tensors().items()}
    leaves = t | {"logit_opacities": t["logit_opacities"][:, None], "sh0": t["sh"][:, :1], "sh_rest": t["sh"][:, 1:]}
    leaves = {name: v.clone().requires_grad_() for name, v in leaves.items() if name != "sh"}

    def draw():
        whole = leaves | {"sh": torch.cat([leaves["sh0"], leaves["sh_rest"]], 1)}
        whole["logit_opacities"] = whole["logit_opacities"][:, 0]
        return rasterize(Gaussians(**{n: whole[n] for n in t}), camera).rgb[0].permute(2, 0, 1)

    other, ours = Drawing(draw, leaves, channels_first=True), rasterizers.ours(g, camera)
    weights = torch.rand(16, 20, 3, generator=torch.Generator().manual_seed(2))
    assert torch.equal(other.image(), ours.image())
    a, b = other.named_gradients(weights), ours.named_gradients(weights)
    assert set(a) == set(b) and all(torch.equal(a[n], b[n]) for n in b)


def test_what_cannot_be_imported_is_left_out_with_its_reason(monkeypatch):
    """Nothing of a foreign program stops the others."""
    monkeypatch.setitem(sys.modules, "gsplat", None)
    monkeypatch.setitem(rasterizers.PEERS, "plain", dense)
    found, reasons = rasterizers.present(CPU)
    assert list(found) == ["plain"] and set(reasons) == set(rasterizers.PEERS) - {"plain"}
    assert "gsplat" in reasons[rasterizers.GSPLAT]


def test_gsplat_gets_what_it_asks_for(monkeypatch):
    """Activated scales and opacities, coefficients or plain channels; images and gradients come back by our names."""
    told = []

    def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree, packed, **more):
        told.append((sh_degree, packed, more))
        plain = sh_degree is None
        sh = means.new_zeros(len(means), 1, 3) if plain else colors
        g = Gaussians(means, quats, scales.log(), opacities.logit(), sh)
        how = RasterizeOptions(rule="gsplat-1.6", colors=colors if plain else None)
        return rasterize(g, Camera(viewmats, Ks, width, height), how).rgb, None, {}

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    g, camera = inputs.gaussians(30, CPU, degree=1), inputs.camera(20, 16, CPU)
    for colors, options in ((None, {}), (torch.rand(30, 5), {"camera_model": "ortho"})):
        weights = torch.rand(16, 20, 3 if colors is None else 5, generator=torch.Generator().manual_seed(2))
        a = rasterizers.ours(g, camera, colors, rule="gsplat-1.6").named_gradients(weights)
        b = rasterizers.gsplat(g, camera, colors, **options).named_gradients(weights)
        assert set(a) == set(b) and all((a[n] - b[n]).norm() < 1e-5 * a[n].norm() for n in a)
    assert told == [(1, False, {}), (None, False, {"camera_model": "ortho"})]


def test_the_judge_of_other_programs_finds_what_differs():
    generator = np.random.default_rng(0)
    ours = {n: generator.normal(size=(40, k)) for n, k in (("means", 3), ("quats", 4), ("log_scales", 3))}
    ours |= {"logit_opacities": generator.normal(size=40), "sh": generator.normal(size=(40, 4, 3))}
    steps = dict.fromkeys(judge.NAMES, 1e-5)

    def verdict(turned="", **changes) -> str:
        return judge.compared(ours, ours | changes, steps, turned)["verdict"]

    w, x, y, z = ours["quats"].T
    assert verdict() == "same"
    mixed = judge.compared(ours, {n: a[::-1] for n, a in ours.items()}, steps)
    assert (mixed["verdict"], mixed["order"]) == ("same", "other")
    assert verdict(quats=-2 * ours["quats"]) == verdict(quats=np.stack([-x, w, z, -y], 1)) == "same"
    for name in steps:
        stored = {"opacities": "logit_opacities", "sh0": "sh"}.get(name, name)
        for change in (1e-3,) if name == "means" else (1e-3, np.nan):  # a position that is none stops the program
            values = ours[stored].copy()
            values[(7, *{"sh0": (0, 1), "sh": (2, 1)}.get(name, (1,) * (values.ndim - 1)))] += change
            assert verdict(**{stored: values}) == f"other values: {name}", (name, change)
    about_x = half_turn(ours, "x")
    assert (verdict(**about_x), verdict("x", **about_x), verdict("x")) == ("turned about x", "same", "turned about x")
    assert verdict(means=ours["means"][:39]) == "39 instead of 40 Gaussians"
    turned, mirrored = ours["means"][:, [1, 2, 0]] + 5, ours["means"] * (1, 1, -1)
    assert judge.rigid(ours["means"], turned) < 1e-9 < 0.1 < judge.rigid(ours["means"], mirrored)


def test_calls_of_gsplat_are_compared():
    """A program beside itself differs in nothing; what another one changes, lacks, packs or refuses is in the row."""
    rasterization, size = compat.rasterization, (60, 40, 24)
    both = {gsplat_calls.OURS: rasterization, gsplat_calls.GSPLAT: rasterization}
    known = {n for f in (gsplat_calls.inputs, rasterization) for n in inspect.signature(f).parameters}
    assert all(call.keys() <= known for call in gsplat_calls.CALLS.values())
    for name in ("absgrad, packed", "batch 1 x 2, packed", "like AnySplat", "D, dense"):
        row = gsplat_calls.row_of(gsplat_calls.CALLS[name], both, *size, 2)
        assert row["meta"]["differ"] == {} and row["meta"]["absent"] == [] and set(row["ms"]) == set(both), name
        assert all(value in (None, [0.0, 0.0]) for value in row["gradients"].values()) and row["alpha_levels"] == [0.0, 0.0]
    assert row["gradients"]["colors"] is None and "image_levels" not in row

    def other(colors, packed, **arguments):
        image, alphas, meta = rasterization(colors=1.5 * colors, packed=True, **arguments)
        meta = dict(meta) | {"more": 1}
        meta["tile_size"] += 1
        return image + 1 / 255, alphas, meta

    row = gsplat_calls.row_of({"absgrad": True}, both | {gsplat_calls.GSPLAT: other}, *size, 2)
    assert row["image_levels"][0] > 1 and 0.3 < row["gradients"]["colors"][0] < 0.4 and row["meta"]["absent"] == ["more"]
    assert row["meta"]["differ"]["tile_size"] == "16 and 17" and 0.1 < row["meta"]["means2d.absgrad"][0] < 0.4
    assert row["meta"]["differ"]["means2d"] == [0.0, 0.0], "rows are compared by Gaussian"
    assert "sparse_grad" in gsplat_calls.row_of({"sparse_grad": True}, both, *size, 2)["refused"][gsplat_calls.OURS]
