"""Export of Gaussians to files of other programs, in the coordinates of the input files."""

from typing import TYPE_CHECKING

from warpgs.faces import lazy

__all__ = [
    "Arrays",
    "Format",
    "read_gaussians",
    "register_format",
    "write_gaussians",
]

if TYPE_CHECKING:
    from warpgs.export.base import Arrays, Format, read_gaussians, register as register_format, write_gaussians
else:
    __getattr__, __dir__ = lazy(__name__)
