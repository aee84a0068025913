"""The engine of a farm: runs jobs and reports their events."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from warpgs.pipeline.farm.job import FarmJob


@dataclass(frozen=True)
class Event:
    """A change of the state of a job."""

    name: str
    """Name of the job."""
    state: str
    """running; or, as the last event of the job: done, failed, held (another process works on it) or crashed (its process
    ended)."""
    message: str = ""
    """Reason of a crash."""
    step: int = 0
    """Steps done; 0 if unknown."""


class Engine(Protocol):
    """A place where jobs run."""

    name: str
    """Name shown to the user."""
    slots: int
    """Largest number of jobs that run at a time."""

    def start(self, job: FarmJob) -> None:
        """Start a job; called while fewer than `slots` jobs run."""

    def wait(self, seconds: float) -> list[Event]:
        """Return new events, after at most ``seconds`` [s]."""

    def close(self) -> None:
        """Stop all jobs. A fit saves its state if it can, and the next farm continues it."""
