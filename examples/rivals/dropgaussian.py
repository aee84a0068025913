"""DropGaussian (Park et al., CVPR 2025, arXiv 2504.00773) as a preset: 3DGS with dropout of Gaussians.

    warpgs fit path/to/scene --out run --preset examples/rivals/dropgaussian.py:dropgaussian --split llff:3

In a step, each Gaussian is hidden with probability p, and the opacities of the others are divided by 1 - p. The probability
grows linearly from 0 to 0.2 at the last step, the paper's rule: `--dropout 0.2` with up to three training views. Constants are
those of the authors' `train.py`; that the paper has the same ones is not confirmed. Their loss is L1 + 0.2 (1 - SSIM), ours
0.8 L1 + 0.2 (1 - SSIM).
Missing here: nothing of the method; the paper starts from COLMAP's dense points of the training views.
"""

dropgaussian = {
    "base": "3dgs",
    "about": "DropGaussian (Park et al. 2025), 10000 steps",
    "steps": 10_000,
    "dropout": 0.2,
    "optimizer.scales-lr": 0.005,
    "density.gradient": 5e-4,
    "density.stop-fraction": 1.0,
    "density.prune-size": 0,
    "density.reset-every": 3000,
    "density.reset-opacity": 0.01,
}
