"""Errors that a user can fix, each with the exit code of its class."""


class WarpgsError(Exception):
    """Base of every error shown to a user without a traceback.

    A message names the problem, the place, the reason and the fix.
    """

    exit_code = 5
    """Exit code of `warpgs` after this error."""


class UsageError(WarpgsError):
    """A flag or an argument that cannot be used as given."""

    exit_code = 2


class DataError(WarpgsError):
    """An invalid scene, image, model file or run folder."""

    exit_code = 3


class NotFiniteError(WarpgsError):
    """A non-finite loss or parameter of a fit."""

    view: int | None = None
    """Number of the training view with a non-finite loss; None if another value is not finite."""
    slot: int = 0
    """Index of the view ``view`` among the views of the step."""


class ResourceError(WarpgsError):
    """Too little memory or disk space, a missing device or package, or a folder that cannot be written."""

    exit_code = 4


class FolderHeldError(ResourceError):
    """A folder that another process is writing into."""


class OutOfMemoryError(ResourceError):
    """A step of a fit that needed more memory than the device had."""

    def __init__(self, message: str, intact: bool):
        """Take a message, and whether the fit's state is ``intact``: unchanged by the step."""
        super().__init__(message)
        self.intact = intact
