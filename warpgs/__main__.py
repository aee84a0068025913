"""`python -m warpgs` is `warpgs`."""

import sys

from warpgs.cli import main

sys.exit(main())
