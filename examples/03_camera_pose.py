"""Find the pose of a camera from its image: gradients flow through the rasterizer into the view matrix.

    python examples/03_camera_pose.py --out pose.png

A cloud of Gaussians is rendered from a known pose. The camera is moved, and its pose is then optimised. Prints the pose error
before and after; writes the image and the renders from the first and the final pose side by side.
"""

import argparse
from pathlib import Path

import warpgs

import torch
from PIL import Image

SIZE = 96


def cloud(count: int, generator: torch.Generator) -> warpgs.Gaussians:
    """Return coloured Gaussians in a deep box in front of the camera: their parallax separates rotation from translation."""
    return warpgs.Gaussians(
        means=torch.tensor([4.0, 4.0, 5.0]) * torch.rand(count, 3, generator=generator) + torch.tensor([-2.0, -2.0, 1.5]),
        quats=torch.randn(count, 4, generator=generator),
        log_scales=torch.full((count, 3), -1.5) + 0.3 * torch.randn(count, 3, generator=generator),
        logit_opacities=torch.full((count,), 1.5),
        sh=torch.randn(count, 1, 3, generator=generator),
    )


def moved(viewmat: torch.Tensor, twist: torch.Tensor) -> torch.Tensor:
    """Return a view matrix turned by ``twist[:3]`` [rad] and shifted by ``twist[3:]`` [u], by the exponential map."""
    x, y, z, *shift = twist.unbind()
    zero = torch.zeros_like(x)
    rows = [torch.stack(row) for row in ([zero, -z, y, shift[0]], [z, zero, -x, shift[1]], [-y, x, zero, shift[2]], [zero] * 4)]
    moves: torch.Tensor = torch.linalg.matrix_exp(torch.stack(rows))
    return moves @ viewmat


def pose_error(a: torch.Tensor, b: torch.Tensor) -> tuple[float, float]:
    """Return the angle [degrees] between two view matrices, and the distance [u] between their camera centres."""
    cosine = 0.5 * ((a[:3, :3] @ b[:3, :3].T).trace() - 1)
    centers = [-m[:3, :3].T @ m[:3, 3] for m in (a, b)]
    return float(torch.rad2deg(torch.arccos(cosine.clamp(-1, 1)))), float((centers[0] - centers[1]).norm())


def main(arguments: list[str] | None = None) -> float:
    """Run the example; return the final error of the camera centre as a fraction of the initial error."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("pose.png"), help="PNG to write")
    parser.add_argument("--steps", type=int, default=200, help="optimisation steps")
    a = parser.parse_args(arguments)

    gaussians = cloud(300, torch.Generator().manual_seed(0))
    K = torch.tensor([[1.0 * SIZE, 0, SIZE / 2], [0, 1.0 * SIZE, SIZE / 2], [0, 0, 1]])
    true_pose = torch.eye(4)
    target = warpgs.rasterize(gaussians, warpgs.Camera(true_pose, K, SIZE, SIZE)).rgb
    wrong_pose = moved(true_pose, torch.tensor([0.03, -0.04, 0.05, 0.06, -0.05, 0.08]))

    twist = torch.zeros(6, requires_grad=True)
    optimizer = torch.optim.Adam([twist], lr=1e-2)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.02 ** (1 / a.steps))
    renders = []
    for step in range(a.steps + 1):
        pose = moved(wrong_pose, twist)
        rgb = warpgs.rasterize(gaussians, warpgs.Camera(pose, K, SIZE, SIZE)).rgb
        if step in (0, a.steps):
            renders.append(rgb.detach())
        optimizer.zero_grad()
        (rgb - target).square().mean().backward()
        optimizer.step()
        schedule.step()

    (angle, distance), (last_angle, last_distance) = (pose_error(p.detach(), true_pose) for p in (wrong_pose, pose))
    row = torch.cat([target, *renders], 1).clamp(0, 1)
    Image.fromarray((row * 255).round().byte().numpy()).save(a.out)
    print(
        f"{a.steps} steps: {angle:.2f} -> {last_angle:.3f} degrees and {distance:.3f} -> {last_distance:.4f} u off; "
        f"target, start and end in {a.out}"
    )
    return last_distance / distance


if __name__ == "__main__":
    main()
