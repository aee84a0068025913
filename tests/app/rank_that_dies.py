"""`warpgs fit` in one of several processes, of which one kills itself: python rank_that_dies.py RANK STEP FLAGS..."""

import os
import signal
import sys

from warpgs.app.fit import request_of
from warpgs.pipeline.run.fit import fit
from warpgs.ranks import join, last_words


def main() -> int:
    rank, step = map(int, sys.argv[1:3])
    request = request_of(sys.argv[3:], "")
    ranks = join(request.device)

    def on_step(report) -> None:
        if ranks.rank == rank and report.step == step:
            os.kill(os.getpid(), signal.SIGKILL)

    try:
        fit(request.scene, request.config, out=request.out, device=request.device, on_step=on_step, ranks=ranks)
    except Exception as e:
        return last_words(f"warpgs: {e}", 5)
    return 0


if __name__ == "__main__":
    sys.exit(main())
