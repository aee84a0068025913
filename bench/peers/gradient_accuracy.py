"""Gradients in float32, ours and those of other rasterizers, against float64, by parameter, on scenes that do not change.

The reference is our float64 pass with the cut-offs of the measured program, so that errors come from arithmetic and not from
the model. This pass is first compared with torch's derivative of a plain program in float64. Each peer is compared with our
kernels under the peer's cut-offs. The gradient is that of a sum of the image with random weights of both signs. --fast-math
measures our kernels alone, compiled with CUDA's fast math. A Gaussian whose alpha is rounded across a cut-off in some pixel has
one of the largest errors, in every program.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from bench.lib import frozen, rasterizers, result_file
from bench.lib.arguments import parse
from bench.lib.gradient_errors import TENSORS, errors_of
from bench.lib.inputs import first_camera, garden_inputs
from bench.lib.rasterizers import ATOMIC, FAST_MATH, GSPLAT_PACKED, OURS, RULE_OF, Drawing
from warpgs.constants import RULES, Rule
from warpgs.pipeline.run.request import choose_device
from warpgs.scene import Camera, Gaussians

WHAT = "errors of float32 gradients against float64, by rasterizer, scene and parameter"
FROZEN = ("trained", "needles", "far")
"""Scenes of `bench.lib.frozen`."""
DENSE = "torch dense"
SMALL = 300
"""Number of Gaussians of the scene on which the reference is compared with torch."""


def batch(camera: Camera, like: torch.Tensor) -> Camera:
    """Return a camera as a batch of one, on the device and in the scalar type of a tensor."""
    viewmat, K = (torch.as_tensor(np.asarray(t) if not isinstance(t, torch.Tensor) else t) for t in (camera.viewmat, camera.K))
    return Camera(viewmat.to(like).reshape(-1, 4, 4)[:1], K.to(like).reshape(-1, 3, 3)[:1], camera.width, camera.height)


def scenes(garden: Path | None, device: torch.device, width: int, height: int, count: int):
    """Yield name, description, Gaussians and camera of each scene, float32 on the device."""
    if garden is not None:
        g, cameras = garden_inputs(garden, sh_degree=3, width=width, height=height, device=device)
        yield "garden", f"photographed points, {len(g):,} Gaussians", g, first_camera(cameras)
    for make in frozen.scenes(device, width, height, count, None, 0):
        scene = make()
        if scene.name in FROZEN:
            yield scene.name, scene.what, scene.gaussians, batch(scene.camera, scene.gaussians.means)


def weights_of(camera: Camera, device: torch.device) -> torch.Tensor:
    """Return the gradient of the image [H, W, 3], float32."""
    return torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(5)).to(device)


def in_double(g: Gaussians) -> Gaussians:
    """Return the same Gaussians in float64."""
    return Gaussians(**{n: t.detach().double() for n, t in g.tensors().items()})


def judged(g: Gaussians, camera: Camera, rule: Rule, weights: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the gradients in float64 by name."""
    double = in_double(g)
    return rasterizers.ours(double, batch(camera, double.means), rule=rule).named_gradients(weights.double())


def programs(g: Gaussians, camera: Camera, present: dict, device: torch.device, fast_math: bool = False):
    """Yield each rule with its programs: our two ways to sum, and the peer with these cut-offs; or ours with fast math."""
    if fast_math:
        yield RULES["gsplat-1.6"], {FAST_MATH: rasterizers.ours(g, camera, rule="gsplat-1.6")}
        return
    groups: dict[str, tuple[Rule, dict[str, Drawing]]] = {}
    peers = {who: prepare for who, prepare in present.items() if who != GSPLAT_PACKED}
    if device.type == "cpu":
        peers, rules = {DENSE: rasterizers.dense}, {DENSE: RULES["exact"]}
    else:
        rules = RULE_OF
    for who, prepare in peers.items():
        rule = rules[who]
        made = groups.setdefault(rule.name, (rule, {OURS: rasterizers.ours(g, camera, rule=rule)}))[1]
        made[who] = prepare(g, camera)
    if not groups:
        groups["exact"] = (RULES["exact"], {OURS: rasterizers.ours(g, camera, rule="exact")})
    first_rule, made = next(iter(groups.values()))
    made[ATOMIC] = rasterizers.ours(g, camera, rule=first_rule, deterministic=False)
    yield from groups.values()


def of_the_judge(device: torch.device) -> dict[str, float]:
    """Return the largest relative L2 distance, over parameters, of the reference from torch's derivative of a plain program."""
    scene = frozen.generated(SMALL, 1)
    g = Gaussians(**{n: t.to(device, torch.float32) for n, t in scene.tensors().items()})
    camera = batch(frozen.inputs.camera(96, 72, torch.device("cpu")), g.means)
    weights, found = weights_of(camera, device), {}
    for rule in (RULES["exact"], RULES["gsplat-1.6"], rasterizers.FASTER_GS_RULE):
        double = in_double(g)
        plain = rasterizers.dense(double, batch(camera, double.means), rule).named_gradients(weights.double())
        wanted = judged(g, camera, rule, weights)
        found[rule.name] = max(float((plain[n] - wanted[n]).norm() / wanted[n].norm()) for n in TENSORS)
    return found


def measure(name: str, g: Gaussians, camera: Camera, present: dict, device: torch.device, fast_math: bool) -> list[dict]:
    """Return a row for each program and parameter."""
    weights, rows = weights_of(camera, device), []
    for rule, made in programs(g, camera, present, device, fast_math):
        wanted = judged(g, camera, rule, weights)
        for who, drawing in made.items():
            found = drawing.named_gradients(weights)
            for tensor in TENSORS:
                row = {"scene": name, "rule": rule.name, "program": who, "tensor": tensor}
                rows.append(row | errors_of(found[tensor], wanted[tensor]))
    return rows


def main() -> None:
    """Measure, print a line for each program, write."""
    a = parse(__doc__, garden=Path, size=[504, 378], count=20_000, device="auto", fast_math=False, out=Path)
    device, _ = choose_device(a.device)
    if a.fast_math:
        rasterizers.compile_with_fast_math()
    present, absent = rasterizers.present(device) if device.type == "cuda" and not a.fast_math else ({}, {})
    for who, reason in absent.items():
        print(f"without {who}: {reason}")
    judge = of_the_judge(device)
    print("judge from torch's derivative, relative L2:", ", ".join(f"{k} {v:.1e}" for k, v in judge.items()))
    rows, facts = [], {}
    for name, words, g, camera in scenes(a.garden, device, *a.size, a.count):
        facts[name] = words
        rows += measure(name, g, camera, present, device, a.fast_math)
        for rule, who in dict.fromkeys((r["rule"], r["program"]) for r in rows if r["scene"] == name):
            own = [r for r in rows if (r["scene"], r["rule"], r["program"]) == (name, rule, who)]
            worst = {k: max(own, key=lambda r: abs(r[k])) for k in ("median", "p99", "largest", "one_minus_cosine", "bias")}
            figures = "  ".join(f"{k} {r[k]:.1e} ({r['tensor']})" for k, r in worst.items())
            print(f"{name:<8} {rule:<10} {who:<14} {figures}  lost {sum(r['lost'] for r in own)}", flush=True)
    result_file.keep(a.out, WHAT, device, rows, scenes=facts, judge=judge, absent=absent, width=a.size[0], height=a.size[1])


if __name__ == "__main__":
    main()
