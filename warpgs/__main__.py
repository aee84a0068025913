"""`python -m warpgs` is `warpgs`."""

import contextlib
import os
import sys

# `python -m` looks for modules in the current folder first, `warpgs` does not: a scene folder may hold a numpy.py. Modules that
# Python itself imports before this line still come from there; `python -P -m warpgs` prevents that.
with contextlib.suppress(FileNotFoundError):  # the current folder was deleted, which `main` reports
    if sys.path and sys.path[0] in ("", os.getcwd()) and not sys.flags.safe_path:
        del sys.path[0]

from warpgs.app.cli import main

sys.exit(main())
