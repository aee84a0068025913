"""Loss terms of `examples/`, loaded from their files as the command line loads them."""

from pathlib import Path

from warpgs.pipeline.train.loss import LOSS_TERMS

EXAMPLES = Path(__file__).parent.parent / "examples"

DepthCorrelation = LOSS_TERMS.load(f"{EXAMPLES / 'loss_terms/depth_prior.py'}:DepthCorrelation")
NormalSmoothness = LOSS_TERMS.load(f"{EXAMPLES / 'loss_terms/depth_normals.py'}:NormalSmoothness")
