"""Processes that fit one scene together: their ranks, their exchange of data, and their end when one is lost.

They are started by torchrun, or with the variables that it sets: RANK, WORLD_SIZE, LOCAL_RANK, MASTER_ADDR and MASTER_PORT.
Data are exchanged by NCCL between GPUs and by gloo between CPUs. Neither reports a lost process in time (a kernel of NCCL waits
forever), so each process watches the others through a store that all are connected to.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from datetime import timedelta
from typing import TYPE_CHECKING

from warpgs.errors import ResourceError, UsageError
from warpgs.runtime.listening import listening_at, loopback_interface, loopback_of, loopback_socket, say_what_is_open
from warpgs.runtime.rank_watch import LOST_SECONDS, RankWatch
from warpgs.runtime.stop_signals import ignored_signals
from warpgs.runtime.terminal import say

if TYPE_CHECKING:
    import torch
    import torch.distributed as dist

JOIN_SECONDS = 300.0
"""Time in which all processes must join [s]."""
EXCHANGE_TIME = timedelta(days=1)
"""Time that an exchange may take: the first rank may write a checkpoint meanwhile, and a lost rank is detected separately."""


class Ranks:
    """The processes of a fit; this class itself stands for a single process."""

    rank = 0
    """Number of this process."""
    count = 1
    """Number of processes."""
    backend = "none"
    """Library that exchanges data: nccl, gloo, or none."""

    @property
    def first(self) -> bool:
        """True for the process that prints and writes."""
        return self.rank == 0

    def to_each(self, sent: torch.Tensor) -> torch.Tensor:
        """Send ``sent[r]`` to each process r; return what this process receives, by rank; both have the shape [R, ...].

        Raises:
            ResourceError: A process is gone.
        """
        return sent

    def gather(self, own: torch.Tensor, found: torch.Tensor) -> None:
        """Concatenate the tensors ``own`` [S] of all processes into ``found`` [R * S].

        Raises:
            ResourceError: A process is gone.
        """
        found.copy_(own)

    def texts(self, own: str) -> list[str]:
        """Return the text ``own`` of each process, in the order of ranks; every process must call this exactly once."""
        return [own]

    def part(self) -> None:
        """End all exchange, once all processes have done the same steps."""

    def leave(self) -> None:
        """End normally; all ranks but the first wait for the first to end."""


ALONE = Ranks()
"""One process alone."""
_joined: Group | None = None


class Group(Ranks):
    """Several processes."""

    def __init__(self, rank: int, count: int, backend: str, watch: RankWatch):
        """Keep what `join` has set up."""
        self.rank, self.count, self.backend, self.watch = rank, count, backend, watch

    def to_each(self, sent):
        """Send ``sent[r]`` to each process r; return what this process receives, shape [R, ...]."""
        import torch
        import torch.distributed as dist

        received = torch.empty_like(sent)
        with self._watched():
            dist.all_to_all_single(received, sent)
        return received

    def gather(self, own, found):
        """Concatenate the tensors ``own`` [S] of all processes into ``found`` [R * S]."""
        import torch.distributed as dist

        with self._watched():
            # the second name is that of torch before 2.13
            (getattr(dist, "all_gather_single", None) or dist.all_gather_into_tensor)(found, own)

    @contextlib.contextmanager
    def _watched(self) -> Iterator[None]:
        """Let the watch end this process, with an error that names the lost rank, if an exchange fails."""
        try:
            yield
        except RuntimeError as e:
            self.watch.settle(LOST_SECONDS)
            raise ResourceError(
                f"rank {self.rank} of {self.count} cannot exchange data with the others ({str(e).splitlines()[0][:200]}); "
                "--resume continues from the last checkpoint"
            ) from e

    def texts(self, own):
        """Return the text ``own`` of each process, in the order of ranks."""
        with self._watched():
            return self.watch.texts(own)

    def part(self):
        """End all exchange."""
        import torch.distributed as dist

        if dist.is_initialized():
            dist.destroy_process_group()

    def leave(self):
        """End normally."""
        self.watch.leave()


def _number(name: str, least: int, most: int, default: str | None = None) -> int:
    text = os.environ.get(name, default)
    if text is None or not text.isdecimal() or not least <= int(text) <= most:
        raise UsageError(
            f"the environment variable {name} must be a whole number from {least} to {most}, not {text!r}; start the fit "
            "with `torchrun --nproc_per_node N -m warpgs fit ...`, or unset RANK and WORLD_SIZE"
        )
    return int(text)


def place() -> tuple[int, int]:
    """Return the rank of this process and the number of processes, 0 and 1 for a single one.

    Raises:
        UsageError: The variables are not valid numbers.
    """
    if "RANK" not in os.environ or "WORLD_SIZE" not in os.environ:
        return 0, 1
    count = _number("WORLD_SIZE", 1, 2**16)
    return _number("RANK", 0, count - 1), count


def join(device: str) -> Ranks:
    """Wait for the other processes that were started with this one; return `ALONE` if there are none.

    Args:
        device: auto, cpu or cuda; with CUDA each process takes the GPU of its number on this machine.

    Raises:
        ResourceError: There are fewer GPUs than processes, or the others do not join or cannot be reached.
        UsageError: The variables of the environment are not those of torchrun.
    """
    global _joined
    rank, count = place()
    if count == 1:
        return ALONE
    import torch
    import torch.distributed as dist

    local = _number("LOCAL_RANK", 0, count - 1, str(rank))
    address, port = os.environ.get("MASTER_ADDR", "127.0.0.1"), _number("MASTER_PORT", 1, 65535)
    agent = os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"  # torchrun itself holds the store then
    cuda = device != "cpu" and (device.startswith("cuda") or torch.cuda.is_available())
    home = _stay_home(address)
    try:
        store = _store(address, port, count, home, hosts=rank == 0 and not agent)
        watch = RankWatch(rank, count, store, _store(address, port, count, home, hosts=False))
    except RuntimeError as e:
        raise ResourceError(
            f"rank {rank} of {count} cannot reach the others at {address}:{port} ({str(e).splitlines()[0][:200]})"
        ) from e
    backend = "nccl" if cuda else "gloo"
    _joined = Group(rank, count, backend, watch)
    if cuda:
        _take_gpu(rank, local)
    watch.meet(JOIN_SECONDS)
    try:
        dist.init_process_group(
            backend, store=dist.PrefixStore("group", store), rank=rank, world_size=count, timeout=EXCHANGE_TIME
        )
    except RuntimeError as e:
        raise ResourceError(f"{backend} cannot connect the {count} ranks ({str(e).splitlines()[0][:200]})") from e
    if rank == 0:
        torchrun = [("torchrun", *at) for at in listening_at(os.getppid()) if agent and at[1] == port]
        say_what_is_open([*(("rank 0", *at) for at in listening_at()), *torchrun])
    return _joined


def _store(address: str, port: int, count: int, home: str | None, *, hosts: bool) -> dist.Store:
    """Connect to the store of all ranks; this process holds it if ``hosts``. ``home`` is the result of `_stay_home`."""
    import torch.distributed as dist

    own = {}
    if hosts and home and sys.platform != "win32":  # torch reuses it; its own would listen on every interface
        own["master_listen_fd"] = loopback_socket(port, "set another MASTER_PORT for all ranks", home).detach()
    wait = timedelta(seconds=JOIN_SECONDS)
    store = dist.TCPStore(home or address, port, count, is_master=hosts, timeout=wait, wait_for_workers=False, **own)
    run = [os.environ.get(f"TORCHELASTIC_{name}", "0") for name in ("RUN_ID", "RESTART_COUNT")]
    return dist.PrefixStore("/".join(["warpgs", *run]), store)


def _take_gpu(rank: int, local: int) -> None:
    """Take the GPU of a local rank; ResourceError without one."""
    import torch

    if torch.cuda.device_count() <= local:
        raise ResourceError(
            f"rank {rank} needs GPU {local} of this machine, but torch finds {torch.cuda.device_count()} GPUs, and NCCL needs "
            "one for each process. Start fewer processes, or give --device cpu"
        )
    torch.cuda.set_device(local)


def _stay_home(address: str) -> str | None:
    """Have gloo and NCCL listen at the loopback interface if all ranks are on this machine; return its address, else None.

    Interfaces that the user has set are not changed.

    Args:
        address: Value of MASTER_ADDR.
    """
    home = loopback_of(address)
    if home and sys.platform != "win32":  # gloo finds no interface by its name there
        for library in ("GLOO", "NCCL"):
            os.environ.setdefault(f"{library}_SOCKET_IFNAME", loopback_interface(home))
    return home


def last_words(line: str, code: int) -> int:
    """Print why this process ends, and return its exit code.

    In a group of processes, only the first to fail prints, and this call ends the process instead of returning.
    """
    if _joined is None:
        if place_or_first()[0] == 0:
            say(line, error=True)
        return code
    with ignored_signals():  # torchrun ends the others once one has ended
        _joined.watch.fail(line)
    sys.stdout.flush()
    os._exit(code)  # a broken group may wait for ever


def place_or_first() -> tuple[int, int]:
    """Return the result of `place`, or 0 and 1 if the variables are unusable."""
    try:
        return place()
    except UsageError:
        return 0, 1
