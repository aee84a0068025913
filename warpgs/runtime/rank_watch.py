"""Mutual watch of the processes of a fit: if one rank is lost, all ranks stop and one prints the error."""

from __future__ import annotations

import os
import platform
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

from warpgs.errors import ResourceError
from warpgs.runtime.terminal import say

if TYPE_CHECKING:
    from torch.distributed import Store

BEAT_SECONDS = 1.0
"""Time between two signs of life [s]."""
LOST_SECONDS = 20.0
"""Time without a sign of life after which a process on another machine counts as lost [s]. The end of a process on this machine
is detected directly."""


def machine() -> str:
    """Return a name of the machine and of its process table; process numbers are valid only within one table."""
    try:
        return f"{Path('/proc/sys/kernel/random/boot_id').read_text().strip()} {os.stat('/proc/self/ns/pid').st_ino}"
    except OSError:  # a system other than Linux
        return platform.node()


def is_gone(process: int) -> bool:
    """Return whether a process of this machine has ended."""
    import psutil

    try:
        return psutil.Process(process).status() in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
    except psutil.NoSuchProcess:
        return True
    except (psutil.Error, OSError):  # the process exists, but belongs to another user
        return False


class RankWatch:
    """Signs of life in a store, and a thread that reads the signs of the other processes.

    Calls through one connection wait for each other, so the thread has its own connection.
    """

    def __init__(self, rank: int, count: int, store: Store, own: Store):
        """Give the first sign of life, and begin to watch.

        Args:
            rank: Number of this process.
            count: Number of processes.
            store: Store of the main thread.
            own: Another connection to the store, for the thread.
        """
        self.rank, self.count, self.store = rank, count, store
        self.here = machine()
        self.leaving = threading.Event()
        """Set once this process ends normally."""
        self._own = own
        self._seen: dict[int, tuple[str, float]] = {}
        self._beat(0)
        threading.Thread(target=self._watch, name="ranks", daemon=True).start()

    def _beat(self, number: int) -> None:
        self._own.set(f"beat/{self.rank}", f"{number}|{os.getpid()}|{self.here}")

    def meet(self, seconds: float) -> None:
        """Wait until all processes have given a sign of life.

        Raises:
            ResourceError: A process has given none after ``seconds`` [s].
        """
        until = time.monotonic() + seconds
        while missing := [r for r in range(self.count) if not self.store.check([f"beat/{r}"])]:
            if time.monotonic() > until:
                raise ResourceError(
                    f"only {self.count - len(missing)} of {self.count} ranks connected within {seconds:.0f} s; rank "
                    f"{missing[0]} is missing. Start all ranks with the same MASTER_ADDR and MASTER_PORT"
                )
            time.sleep(0.05)

    def texts(self, own: str) -> list[str]:
        """Return each process's text ``own``, once all have called this; if a rank is lost, the thread ends this process."""
        names = [f"text/{r}" for r in range(self.count)]
        self.store.set(names[self.rank], own)
        while not self.store.check(names):
            time.sleep(0.05)
        return [self.store.get(name).decode() for name in names]

    def _watch(self) -> None:
        """Give signs of life and look for those of the others, until this process ends."""
        number = 0
        while not self.leaving.wait(BEAT_SECONDS):
            number += 1
            try:
                self._beat(number)
                if self._own.check(["spoke"]):  # another rank has reported the error
                    self._keep_store()
                    os._exit(ResourceError.exit_code)
                lost = next((r for r in range(self.count) if r != self.rank and self.is_lost(r)), None)
            except RuntimeError:  # the store is gone, and with it the process that held it
                lost = 0
            if lost is not None and not self.leaving.is_set():
                self.fail(
                    f"warpgs: rank {lost} of {self.count} was lost, so this fit stops; --resume continues from the last "
                    "checkpoint, with any number of ranks"
                )
                os._exit(ResourceError.exit_code)

    def is_lost(self, rank: int) -> bool:
        """Return whether a process has ended without a message, or has given no sign of life for too long."""
        if not self._own.check([f"beat/{rank}"]):
            return False  # it has not started yet
        found, now = self._own.get(f"beat/{rank}").decode(), time.monotonic()
        last, since = self._seen.get(rank, ("", now))
        if found != last:
            self._seen[rank] = (found, now)
            since = now
        _, process, there = found.split("|", 2)
        gone = is_gone(int(process)) if there == self.here else now - since > LOST_SECONDS
        return gone and not self._own.check([f"left/{rank}"])

    def fail(self, line: str) -> None:
        """Print why all ranks end, unless another rank has, or this rank already ends normally and is not the first."""
        if self.leaving.is_set() and self.rank != 0:
            return
        self.leaving.set()
        try:
            first, gone = self.store.add("spoke", 1) == 1, False
        except RuntimeError:  # the store is gone: no other process can be asked
            first = gone = self._is_lowest_here()
        if first:
            say(line, error=True)
        if gone and self.rank != 0:
            time.sleep(3 * BEAT_SECONDS)  # the others on this machine do not report it while they see this process
        self._keep_store()

    def _keep_store(self) -> None:
        """On rank 0, give the other ranks time to read that the fit ends, since the store may end with this process."""
        if self.rank == 0:
            time.sleep(3 * BEAT_SECONDS)

    def _is_lowest_here(self) -> bool:
        """Return whether no rank below this one still runs on this machine."""
        below = (self._seen[r][0].split("|", 2) for r in range(self.rank) if r in self._seen)
        return all(there != self.here or is_gone(int(process)) for _, process, there in below)

    def settle(self, seconds: float) -> None:
        """Wait a little more than ``seconds`` for the thread, which ends this process once it knows the lost rank."""
        time.sleep(seconds + 2 * BEAT_SECONDS)

    def leave(self) -> None:
        """Tell the other ranks that this process ends normally; all ranks but the first wait for the first to end."""
        try:
            self.store.set(f"left/{self.rank}", "")
            if self.rank != 0:
                while not self.store.check(["left/0"]):
                    time.sleep(0.1)
            self.leaving.set()
            self.store.set(f"heard/{self.rank}", "")
            until = time.monotonic() + 3 * BEAT_SECONDS  # the store may end with the first process
            while self.rank == 0 and time.monotonic() < until and not self._all_heard():
                time.sleep(0.05)
        except RuntimeError:  # the store has ended with the process that held it
            self.leaving.set()

    def _all_heard(self) -> bool:
        return bool(self.store.check([f"heard/{r}" for r in range(self.count)]))
