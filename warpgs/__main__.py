"""`python -m warpgs` is `warpgs`."""

import os
import sys

# `python -m` looks for modules in the current folder first, `warpgs` does not: a scene folder may hold a numpy.py. What Python
# itself imports before this line cannot be helped here; `python -P -m warpgs` helps it.
if sys.path and sys.path[0] in ("", os.getcwd()) and not sys.flags.safe_path:
    del sys.path[0]

from warpgs.app.cli import main

sys.exit(main())
