"""A trainer like nerfstudio's splatfacto in plain torch, around the rasterizer: dataparser, densification, camera optimiser.

    python examples/12_splatfacto.py path/to/scene --out splatfacto.png --pose-noise 0.5

`warpgs.load_scene` is the dataparser. Gaussians are split and duplicated by absgrad (`Render.means2d.absgrad`), and culled by
opacity. Random backgrounds prevent fog, and `scale_loss` prevents needles. Each training camera has a learned pose correction.
Prints the number of Gaussians, the PSNR of a held-out view and the pose error of the training cameras, before and after; writes
the held-out image beside its render.
"""

import argparse
import tempfile
from pathlib import Path

import warpgs
from warpgs.train import ssim

import numpy as np
import torch
from PIL import Image

LRS = {"means": 2e-3, "quats": 1e-3, "log_scales": 1e-2, "logit_opacities": 5e-2, "sh": 1e-2, "twists": 1e-3}
GROW_ABSGRAD, SPLIT_SIZE, MIN_OPACITY = 2e-3, 0.03, 0.05
MAX_RATIO = 10.0
C0 = 0.28209479177387814  # 1 / (2 sqrt(pi)), the constant spherical harmonic


def initial_parameters(scene: warpgs.Scene, count: int, cameras: int) -> dict[str, torch.Tensor]:
    """Return Gaussians at up to ``count`` points of a scene, and a pose correction of 0 for each camera."""
    assert scene.points is not None, "the scene has no points to start from"
    chosen = np.random.default_rng(0).permutation(len(scene.points))[:count]
    points = torch.tensor(scene.points.points[chosen], dtype=torch.float32)
    distances = torch.cdist(points, points).topk(4, largest=False).values[:, 1:].mean(1).clamp_min(1e-4)
    sh = torch.zeros(len(points), 4, 3)
    sh[:, 0] = (torch.tensor(scene.points.colors[chosen], dtype=torch.float32) - 0.5) / C0
    return {
        "means": points,
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(points), 1),
        "log_scales": distances.log()[:, None].repeat(1, 3),
        "logit_opacities": torch.full((len(points),), -2.0),
        "sh": sh,
        "twists": torch.zeros(cameras, 6),
    }


def moved(viewmat: torch.Tensor, twist: torch.Tensor) -> torch.Tensor:
    """Return a view matrix turned by ``twist[:3]`` [rad] and shifted by ``twist[3:]`` [u], by the exponential map."""
    x, y, z, *shift = twist.unbind()
    zero = torch.zeros_like(x)
    rows = [torch.stack(row) for row in ([zero, -z, y, shift[0]], [z, zero, -x, shift[1]], [-y, x, zero, shift[2]], [zero] * 4)]
    moves: torch.Tensor = torch.linalg.matrix_exp(torch.stack(rows))
    return moves @ viewmat


def degrees_off(poses: torch.Tensor, true_poses: torch.Tensor) -> float:
    """Return the mean angle [degrees] between poses and true poses [V, 4, 4], after removal of their common rotation."""
    turns = poses[:, :3, :3].mT @ true_poses[:, :3, :3]  # in world axes: Gaussians absorb a common rotation
    u, _, v = torch.linalg.svd(turns.mean(0))
    return float(torch.rad2deg(2 * torch.arcsin((turns - u @ v).norm(dim=(1, 2)).div(8**0.5).clamp_max(1))).mean())


def scale_loss(log_scales: torch.Tensor) -> torch.Tensor:
    """Return the mean excess of the axis ratio, longest to shortest, over `MAX_RATIO`, shape [].

    The loss follows PhysGaussian (Xie et al. 2024).
    """
    ratios = (log_scales.amax(1) - log_scales.amin(1)).exp()
    return (ratios.clamp_min(MAX_RATIO) - MAX_RATIO).mean()


def densify(params: dict[str, torch.Tensor], optimizer: torch.optim.Adam, pull: torch.Tensor, size: float) -> None:
    """Split large and duplicate small Gaussians with a high absgrad ``pull`` [N], and remove transparent Gaussians.

    Old rows keep their Adam moments; new rows have moments of 0. ``size`` is the size of the scene [u].
    """
    g = {name: p.detach() for name, p in params.items() if name != "twists"}
    grows = pull > GROW_ABSGRAD
    large = grows & (g["log_scales"].exp().amax(1) > SPLIT_SIZE * size)
    parents = torch.cat([torch.nonzero(grows)[:, 0], torch.nonzero(large)[:, 0]])
    keep = torch.nonzero((g["logit_opacities"].sigmoid() > MIN_OPACITY) & ~large)[:, 0]
    new = {name: t[parents] for name, t in g.items()}
    halves = large[parents]
    offsets = torch.randn_like(new["means"]) * new["log_scales"].exp()
    w, *v = torch.nn.functional.normalize(new["quats"]).unbind(1)
    axis = torch.stack(v, 1)
    turned = offsets + 2 * torch.linalg.cross(axis, torch.linalg.cross(axis, offsets) + w[:, None] * offsets)
    new["means"] = new["means"] + halves[:, None] * turned
    new["log_scales"] = new["log_scales"] - halves[:, None] * float(np.log(1.6))
    for group in optimizer.param_groups:
        if group["name"] != "twists":
            old, name = params[group["name"]], group["name"]
            state = optimizer.state.pop(old)
            params[name] = torch.cat([g[name][keep], new[name]]).requires_grad_()
            for moment in ("exp_avg", "exp_avg_sq"):
                state[moment] = torch.cat([state[moment][keep], torch.zeros_like(new[name])])
            group["params"], optimizer.state[params[name]] = [params[name]], state


def main(arguments: list[str] | None = None) -> float:
    """Run the example; return the gain in PSNR on a held-out view [dB]."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, nargs="?", help="scene folder with points; default: a synthetic scene")
    parser.add_argument("--out", type=Path, default=Path("splatfacto.png"), help="PNG to write")
    parser.add_argument("--steps", type=int, default=400, help="optimisation steps")
    parser.add_argument("--count", type=int, default=1000, help="largest number of Gaussians at the start")
    parser.add_argument("--width", type=int, default=96, help="width of the synthetic images [px]")
    parser.add_argument("--pose-noise", type=float, default=0.0, help="initial rotation error of training cameras [degrees]")
    a = parser.parse_args(arguments)

    torch.manual_seed(0)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    with tempfile.TemporaryDirectory() as folder:
        if a.scene is None:
            a.scene = Path(folder) / "scene"
            warpgs.write_demo(a.scene, views=9, width=a.width, height=3 * a.width // 4)
        scene = warpgs.load_scene(a.scene)
    held_out, *train = scene.views[len(scene.views) // 2 :] + scene.views[: len(scene.views) // 2]
    images = [torch.from_numpy(v.image).to(device) for v in train]
    true_poses = torch.stack([torch.tensor(v.camera.viewmat, dtype=torch.float32) for v in train]).to(device)
    noise = torch.zeros(len(train), 6, device=device)
    noise[:, :3] = torch.deg2rad(torch.tensor(a.pose_noise)) * torch.nn.functional.normalize(torch.randn(len(train), 3)).to(
        device
    )
    poses = torch.stack([moved(pose, twist) for pose, twist in zip(true_poses, noise, strict=True)])

    params = {n: t.to(device).requires_grad_() for n, t in initial_parameters(scene, a.count, len(train)).items()}
    optimizer = torch.optim.Adam([{"params": [p], "lr": LRS[n], "name": n} for n, p in params.items()], eps=1e-15)
    size = float((params["means"].detach() - params["means"].detach().mean(0)).norm(dim=1).mean())
    count = len(params["means"])
    pull = seen = torch.zeros(count, device=device)

    def gaussians() -> warpgs.Gaussians:
        return warpgs.Gaussians(**{name: p for name, p in params.items() if name != "twists"})

    first = warpgs.evaluate(gaussians(), [held_out], warpgs.RasterizeOptions())[0].psnr
    for step in range(1, a.steps + 1):
        i = int(torch.randint(len(train), ()))
        camera = train[i].camera
        seen_from = warpgs.Camera(moved(poses[i], params["twists"][i]), camera.K, camera.width, camera.height)
        options = warpgs.RasterizeOptions(absgrad=True, background=torch.rand(3), sh_degree=min(step // 100, 1))
        render = warpgs.rasterize(gaussians(), seen_from, options)
        means2d = render.means2d  # read before the backward pass, which sets absgrad on it
        loss = 0.8 * (render.rgb - images[i]).abs().mean() + 0.2 * (1 - ssim(render.rgb, images[i]).mean())
        loss = loss + 0.1 * scale_loss(params["log_scales"]) + 1e-2 * params["twists"].square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        absgrad: torch.Tensor = means2d.absgrad  # type: ignore[attr-defined]
        half = torch.tensor([camera.width / 2, camera.height / 2], device=device)
        pull, seen = pull + (absgrad[0] * half).norm(dim=1), seen + render.visible[0]
        if step % 50 == 0 and step < 0.7 * a.steps:
            densify(params, optimizer, pull / seen.clamp_min(1), size)
            pull = seen = torch.zeros(len(params["means"]), device=device)

    last = warpgs.evaluate(gaussians(), [held_out], warpgs.RasterizeOptions())[0].psnr
    with torch.no_grad():
        result = warpgs.rasterize(gaussians(), held_out.camera).rgb.clamp(0, 1).cpu().numpy()
    Image.fromarray((np.concatenate([held_out.image, result], 1) * 255).round().astype(np.uint8)).save(a.out)
    found = torch.stack([moved(pose, twist) for pose, twist in zip(poses, params["twists"].detach(), strict=True)])
    off = [degrees_off(given, true_poses) for given in (poses, found)]
    print(
        f"{count} -> {len(params['means'])} Gaussians, {a.steps} steps: held-out PSNR {first:.2f} -> {last:.2f} dB, training "
        f"cameras {off[0]:.2f} -> {off[1]:.2f} degrees off; image and render in {a.out}"
    )
    return last - first


if __name__ == "__main__":
    main()
