"""Times at which a strategy changes the set of Gaussians."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class EventTimes:
    """Events at equal intervals, in steps done."""

    after: int
    """Step after which events begin."""
    every: int
    """Steps between two events; events are at multiples of this number."""
    until: int
    """Step after which there are no more events."""

    @staticmethod
    def of_fit(start: int, every: int, stop_fraction: float, steps: int) -> EventTimes:
        """Return the times for a fit of that many steps; in a short fit events start after a quarter of its length."""
        return EventTimes(min(start, steps // 4), every, int(stop_fraction * steps))

    def due(self, step: int) -> bool:
        """Return whether there is an event after a step."""
        return self.after < step <= self.until and step % self.every == 0
