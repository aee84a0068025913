"""Errors that a user can fix, each with the exit code of its class."""


class WarpgsError(Exception):
    """Base of every error shown to a user without a traceback.

    A message names the problem, the place, the reason and the fix.
    """

    exit_code = 5
    """Exit code of the program."""


class UsageError(WarpgsError):
    """A flag or an argument cannot be honoured as given."""

    exit_code = 2


class DataError(WarpgsError):
    """A scene, an image, a model file or a run folder is invalid."""

    exit_code = 3


class NotFiniteError(WarpgsError):
    """The loss or a parameter of a fit became non-finite."""

    view: int | None = None
    """Number of the training view with that loss; None for other values."""
    slot: int = 0
    """Number of that view among those of the step."""


class ResourceError(WarpgsError):
    """Memory, disk or a device does not suffice; the message names need and supply."""

    exit_code = 4


class FolderHeldError(ResourceError):
    """Another process holds a folder that it writes into."""


class OutOfMemoryError(ResourceError):
    """A step of a fit requested more memory than the device had."""

    def __init__(self, message: str, intact: bool):
        """Take a message, and whether the state of the fit is still that before the step."""
        super().__init__(message)
        self.intact = intact
