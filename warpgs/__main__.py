"""`python -m warpgs` is `warpgs`."""

import os
import sys

# `python -m` puts the current folder first on the import path, the command `warpgs` does not: a file there named like a module
# must not be imported in its place, and plug-ins are found where their user put them on purpose (PYTHONPATH, or FILE.py:Class)
if not sys.flags.safe_path and sys.path and sys.path[0] in ("", os.getcwd()):
    del sys.path[0]

from warpgs.app.cli import main

sys.exit(main())
