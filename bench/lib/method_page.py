"""The generated part of docs/method.md: where fine Gaussians are placed, and what an oracle would gain."""

from __future__ import annotations

import math

from bench.lib import result_file
from bench.lib.tables import markdown

RESULT = "importance_h100"
ARMS = {
    "uniform/default:method.sampler.max_fraction=2,method.ra=false": "none",
    "uniform+log/default:method.sampler.max_fraction=2": "at pixels with consistent depth, sampled uniformly",
    "warped/default:method.sampler.max_fraction=2": "the same number, sampled by the gain in the training photographs",
    "oracle gain/default:method.sampler.max_fraction=2": (
        "the same number, sampled by the gain in the third photograph itself (an oracle)"
    ),
}
"""Arms of the study in words. In that of the first, the score was taken for constant, so that it placed nothing."""
SCENES = ("fern", "horns")


def placement() -> str:
    """Return the table of scores of the photograph left out, the mean of three, by where fine Gaussians are placed."""
    rows, body = result_file.read(result_file.FOLDER / f"{RESULT}.json")["rows"], []
    for preset, words in ARMS.items():
        body.append([words])
        for scene in SCENES:
            own = [r for r in rows if r["row"] == f"{scene}:3" and r["preset"] == preset]
            psnr, ssim = (math.fsum(r[k] for r in own) / len(own) for k in ("psnr", "ssim"))
            body[-1].append(f"{psnr:.2f} / {ssim:.3f}")
    head = ["fine Gaussians", *(f"`{scene}`" for scene in SCENES)]
    return markdown(head, body, head[:1]) + f"\nSource: `{RESULT}.json`; means of three photographs left out, one seed.\n"
