"""Export of Gaussians to files of other programs, in the coordinates of the input files."""

from typing import TYPE_CHECKING

from warpgs.faces import lazy

if TYPE_CHECKING:
    from warpgs.export.base import (
        Arrays as Arrays,
        Format as Format,
        read_gaussians as read_gaussians,
        register_format as register_format,
        write_gaussians as write_gaussians,
    )
else:
    __getattr__, __dir__ = lazy(__name__)
