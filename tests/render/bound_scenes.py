"""Small scenes that are difficult for cut-offs and rounding: random scenes, and adversarial scenes for each cut-off."""

import torch

from warpgs.scene import Camera, Gaussians

KINDS = ("random", "haze", "needles", "far", "huge", "opaque", "close", "at cuts", "bright", "displaced")
"""Kinds of scenes; scene n has kind n modulo their count."""
WIDTH, HEIGHT = 24, 20


def bound_scene(number: int) -> tuple[str, Gaussians, Camera, torch.Tensor]:
    """Return kind, Gaussians, camera and background of a scene in float32; up to 200 Gaussians, 24 x 20 px."""
    kind, generator = KINDS[number % len(KINDS)], torch.Generator().manual_seed(number)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    count = int(200 ** float(rand(1))) if kind != "haze" else 200
    depths = 1 + 5 * rand(count)
    means = torch.cat([(rand(count, 2) - 0.5) * depths[:, None], depths[:, None]], 1)
    log_scales, opacities = torch.log(0.02 + 0.3 * rand(count, 3)), 0.02 + 0.97 * rand(count)
    sh = rand(count, 4, 3) - 0.5
    viewmat = torch.eye(4)
    if kind == "haze":  # layers that every pixel has hundreds of, each near the cut of a rule
        log_scales, opacities = torch.full((count, 3), 2.0), (0.9 + 3.2 * rand(1)) / 255 * (1 + 0.05 * rand(count))
    elif kind == "needles":
        log_scales = torch.log(torch.tensor([2.0, 1e-4, 1e-4]) * (0.1 + rand(count, 3)))
    elif kind == "far":
        means, log_scales = means * 1000, log_scales + 6
    elif kind == "huge":
        log_scales = log_scales + 8
    elif kind == "opaque":
        opacities = 1 - 1e-3 * rand(count) ** 3
    elif kind == "close":  # about the near planes of the rules
        near = 0.005 + 0.3 * rand(count, 1)
        means, log_scales = means / means[:, 2:] * near, log_scales - 3
    elif kind == "at cuts":  # within rounding of one, two and four 255ths at their centres
        steps = 2.0 ** torch.randint(3, (count,), generator=generator)
        log_scales, opacities = log_scales + 1, steps / 255 * (1 + 4e-7 * (rand(count) - 0.5))
    elif kind == "bright":
        sh = 30 * sh
    elif kind == "displaced":  # what float32 stores of a place 1000 u from the origin
        means, viewmat[:3, 3] = means + 1000, -1000.0
    gaussians = Gaussians(means, rand(count, 4) - 0.5, log_scales, torch.logit(opacities).clamp_max(16), sh)
    K = torch.tensor([[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1.0]])
    return kind, gaussians, Camera(viewmat, K, WIDTH, HEIGHT), rand(3)
