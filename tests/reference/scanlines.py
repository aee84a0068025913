"""The path costs of semi-global matching as they are defined, pixel by pixel."""

import numpy as np


def scanline_costs(costs: np.ndarray, down: np.ndarray, across: np.ndarray, small: int) -> np.ndarray:
    """Sum over the four directions, int, shape [H, W, D]; arguments as of the kernel's function."""
    height, width, planes = costs.shape
    total = np.zeros(costs.shape, int)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        path = np.zeros(costs.shape, int)
        for y in range(height)[:: 1 if dy >= 0 else -1]:
            for x in range(width)[:: 1 if dx >= 0 else -1]:
                path[y, x] = costs[y, x]
                py, px = y - dy, x - dx
                if 0 <= py < height and 0 <= px < width:
                    before = path[py, px]
                    limit = down[min(y, py), x] if dy else across[y, min(x, px)]
                    for d in range(planes):
                        options = [before[d], before.min() + limit]
                        options += [before[k] + small for k in (d - 1, d + 1) if 0 <= k < planes]
                        path[y, x, d] += min(options) - before.min()
        total += path
    return total
