"""`python -m warpgs` is `warpgs`."""

import sys

from warpgs.app.cli import main

sys.exit(main())
