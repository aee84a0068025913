"""Any number of channels as one product: blending weights [P, N] times channels [N, D], and what is left of the background."""

from tests.reference.blend import blend_reference


def blend_channels_reference(means, covs, opacities, colors, depths, background, width, height, rule):
    """One camera: image [H, W, D], alpha [H, W], depth [H, W]; inputs [N, ...], colors [N, D], background [D]."""
    black, none = colors.new_zeros(len(means), 3), background.new_zeros(3)
    _, alpha, depth, weights = blend_reference(means, covs, opacities, black, depths, none, width, height, rule)
    product = weights.flatten(1).T @ colors
    return product.view(height, width, -1) + (1 - weights.sum(0))[..., None] * background, alpha, depth
