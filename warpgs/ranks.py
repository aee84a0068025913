"""Processes that speak with each other: ports to listen on, and the ranks of a fit on several GPUs."""

from __future__ import annotations

import contextlib
import hmac
import ipaddress
import os
import platform
import re
import secrets
import socket
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from warpgs.errors import ResourceError, UsageError, explained
from warpgs.process import ignored_signals, say

if TYPE_CHECKING:
    import torch
    import torch.distributed as dist


# Guards of all servers: sockets that only this machine reaches, and checks of requests for a served page.
#
# Any web page can send requests to every port of the machine that shows the page, and so can every program of every
# user of the machine. So a server of warpgs binds the loopback address, answers below a random path that is new at
# every start, and checks ``Host`` and ``Origin`` first.

HOST = "127.0.0.1"
"""Address that servers listen at: only this machine reaches it."""
NAMES = (HOST, "localhost")
"""Host names that a browser may request, at any port: the port of an SSH tunnel may differ from the server's."""
TOKEN_BYTES = 24
"""Random bytes of a token: 32 letters."""
_PLAIN = re.compile(r"[A-Za-z0-9._/-]*")


def loopback_socket(port: int, fix: str, host: str = HOST) -> socket.socket:
    """Return a socket that is bound to the loopback address and does not listen yet."""
    opened = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    # on Windows SO_REUSEADDR would let another program bind the same port beside us
    name = "SO_EXCLUSIVEADDRUSE" if sys.platform == "win32" else "SO_REUSEADDR"
    try:
        opened.setsockopt(socket.SOL_SOCKET, getattr(socket, name), 1)
        opened.bind((host, port))
    except (OSError, OverflowError) as e:
        opened.close()
        reason = e.strerror if isinstance(e, OSError) and e.strerror else str(e)
        raise UsageError(f"port {port} cannot be used ({reason}); {fix}") from e
    return opened


def loopback_of(name: str) -> str | None:
    """Return the loopback address of a host name or address, 127.0.0.1 rather than ::1; None for other hosts."""
    try:
        found = [str(info[4][0]) for info in socket.getaddrinfo(name, None, type=socket.SOCK_STREAM)]
    except (OSError, UnicodeError):  # the name cannot be resolved; connecting raises the error
        return None
    return min(found, key=lambda a: (":" in a, a)) if found and all(map(is_loopback, found)) else None


def loopback_interface(host: str = HOST) -> str:
    """Return the name of the network interface that has a loopback address, such as lo."""
    import psutil

    names = [str(name) for name, addresses in psutil.net_if_addrs().items() if any(a.address == host for a in addresses)]
    if not names:
        raise ResourceError(f"no network interface has the address {host}; bring up the loopback interface (ip link set lo up)")
    return names[0]


def listening_at(process: int | None = None) -> list[tuple[str, int]]:
    """Return the addresses and ports at which a process listens, sorted; none where the system denies access."""
    import psutil

    try:
        found = psutil.Process(process).net_connections("inet")
    except psutil.Error:  # it has ended, or belongs to another user
        return []
    return sorted({(c.laddr.ip, c.laddr.port) for c in found if c.status == psutil.CONN_LISTEN})


def listeners() -> list[tuple[str, str, int]]:
    """Return program name, address and port of every listening socket of this process and its children."""
    import psutil

    found = [("this process", *at) for at in listening_at()]
    for child in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):  # it has ended
            found += [(child.name(), *at) for at in listening_at(child.pid)]
    return found


def say_what_is_open(found: Sequence[tuple[str, str, int]]) -> None:
    """Print in one line which of the found sockets other machines can reach, if any."""
    if reached := [f"{who} at {ip}, port {port}" for who, ip, port in found if not is_loopback(ip)]:
        say(f"open to other machines, without encryption: {'; '.join(reached)}; use a network that you trust")


def is_loopback(address: str) -> bool:
    """Return whether only this machine can reach a socket's address."""
    found = ipaddress.ip_address(address.partition("%")[0])
    return (getattr(found, "ipv4_mapped", None) or found).is_loopback


class WebGuard:
    """Rules for requests to a web server of this machine: its secret path, its names, and the headers of its answers."""

    def __init__(self) -> None:
        """Choose a random token, which is valid until the process ends."""
        self.token = secrets.token_urlsafe(TOKEN_BYTES)

    def address(self, port: int) -> str:
        """Return the address to open in a browser."""
        return f"http://{HOST}:{port}/{self.token}/"

    def admitted_path(self, target: str, hosts: Sequence[str], origins: Sequence[str], upgrade: bool) -> str | None:
        """Return the requested path below the token, or None if the request must be rejected."""
        if len(hosts) != 1 or not _is_own(hosts[0]):
            return None
        if any(origin != f"http://{hosts[0]}" for origin in origins) or (upgrade and len(origins) != 1):
            return None
        first, _, rest = target.removeprefix("/").partition("/")
        if not target.startswith("/") or not hmac.compare_digest(first.encode("utf-8", "surrogateescape"), self.token.encode()):
            return None
        return f"/{rest}" if _PLAIN.fullmatch(rest) and ".." not in rest and not (upgrade and rest) else None

    @staticmethod
    def headers(host: str, nonce: str) -> dict[str, str]:
        """Return the headers of every answer."""
        # in Safari, 'self' covers http only; a foreign host must not get into the header
        sockets = f" ws://{host}" if _is_own(host) else ""
        policy = (
            f"default-src 'none'; script-src 'nonce-{nonce}' 'unsafe-eval'; "  # eval: the worker that sorts Gaussians
            "worker-src blob:; style-src 'unsafe-inline'; img-src 'self' data: blob:; font-src data:; "
            f"connect-src 'self'{sockets} data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        return {
            "Content-Security-Policy": policy, "X-Frame-Options": "DENY", "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff", "Cache-Control": "no-store", "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
        }  # fmt: skip


def _is_own(host: str) -> bool:
    """Return whether a value of ``Host`` is one of `NAMES`, with or without a port."""
    name, colon, port = host.partition(":")
    return name in NAMES and (not colon or (port.isascii() and port.isdecimal() and len(port) <= 5))


BEAT_SECONDS = 1.0
"""Time between two signs of life [s]."""
LOST_SECONDS = 20.0
"""Time without a sign of life after which a process on another machine counts as lost [s]. The end of a process on this machine
is detected directly."""


def machine() -> str:
    """Return a name of the machine and of its process table; process numbers are valid only within one table."""
    with contextlib.suppress(OSError):  # a system other than Linux
        return f"{Path('/proc/sys/kernel/random/boot_id').read_text().strip()} {os.stat('/proc/self/ns/pid').st_ino}"
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

    def __init__(self, rank: int, count: int, store: dist.Store, own: dist.Store):
        """Give the first sign of life, and begin to watch."""
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
        """Wait until all processes have given a sign of life."""
        until = time.monotonic() + seconds
        while missing := [r for r in range(self.count) if not self.store.check([f"beat/{r}"])]:
            if time.monotonic() > until:
                raise ResourceError(f"rank {missing[0]} did not connect; start all with one MASTER_ADDR and MASTER_PORT")
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
                self.fail(f"warpgs: rank {lost} of {self.count} was lost: the fit stops; --resume it, with any number of ranks")
                os._exit(ResourceError.exit_code)

    def is_lost(self, rank: int) -> bool:
        """Return whether a process has ended without a message, or has given no sign of life for too long."""
        if not self._own.check([f"beat/{rank}"]):
            return False  # it has not started yet
        found, now = self._own.get(f"beat/{rank}").decode(), time.monotonic()
        if rank not in self._seen or self._seen[rank][0] != found:
            self._seen[rank] = (found, now)
        _, process, there = found.split("|", 2)
        gone = is_gone(int(process)) if there == self.here else now - self._seen[rank][1] > LOST_SECONDS
        return gone and not self._own.check([f"left/{rank}"])

    def fail(self, line: str) -> None:
        """Print why all ranks end, unless another rank has, or this rank already ends normally and is not the first."""
        if self.leaving.is_set() and self.rank != 0:
            return
        self.leaving.set()
        try:
            first, gone = self.store.add("spoke", 1) == 1, False
        except RuntimeError:  # the store is gone: no other process can be asked; the lowest rank left on this machine speaks
            below = (self._seen[r][0].split("|", 2) for r in range(self.rank) if r in self._seen)
            first = gone = all(there != self.here or is_gone(int(process)) for _, process, there in below)
        if first:
            say(line, error=True)
        if gone and self.rank != 0:
            time.sleep(3 * BEAT_SECONDS)  # the others on this machine do not report it while they see this process
        self._keep_store()

    def _keep_store(self) -> None:
        """On rank 0, give the other ranks time to read that the fit ends, since the store may end with this process."""
        if self.rank == 0:
            time.sleep(3 * BEAT_SECONDS)

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
            heard = [f"heard/{r}" for r in range(self.count)]
            while self.rank == 0 and time.monotonic() < until and not self.store.check(heard):
                time.sleep(0.05)
        except RuntimeError:  # the store has ended with the process that held it
            self.leaving.set()


# Processes that fit one scene together: their ranks, their exchange of data, and their end when one is lost.
#
# They are started by torchrun, or with the variables that it sets: RANK, WORLD_SIZE, LOCAL_RANK, MASTER_ADDR and
# MASTER_PORT. Data are exchanged by NCCL between GPUs and by gloo between CPUs. Neither reports a lost process in time
# (a kernel of NCCL waits forever), so each process watches the others through a store that all are connected to.

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
        """Send ``sent[r]`` to each process r; return what this process receives, by rank; both have the shape [R, ...]."""
        return sent

    def gather(self, own: torch.Tensor, found: torch.Tensor) -> None:
        """Concatenate the tensors ``own`` [S] of all processes into ``found`` [R * S]."""
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
            time.sleep(LOST_SECONDS + 2 * BEAT_SECONDS)  # the thread ends this process once it knows the lost rank
            why = f"cannot exchange data with the others ({str(e).splitlines()[0][:200]})"
            raise ResourceError(f"rank {self.rank} of {self.count} {why}; --resume continues from the last checkpoint") from e

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
        fix = "start the fit with `torchrun --nproc_per_node N -m warpgs fit ...`, or unset RANK and WORLD_SIZE"
        raise UsageError(f"the environment variable {name} must be a whole number from {least} to {most}, not {text!r}; {fix}")
    return int(text)


def place() -> tuple[int, int]:
    """Return the rank of this process and the number of processes, 0 and 1 for a single one."""
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
    with explained(
        f"rank {rank} of {count} cannot reach {address}:{port}", "start all ranks", RuntimeError, kind=ResourceError
    ):
        store = _store(address, port, count, home, hosts=rank == 0 and not agent)
        watch = RankWatch(rank, count, store, _store(address, port, count, home, hosts=False))
    backend = "nccl" if cuda else "gloo"
    _joined = Group(rank, count, backend, watch)
    if cuda:
        if torch.cuda.device_count() <= local:
            raise ResourceError(f"rank {rank} needs GPU {local}, which is missing. Start fewer processes, or give --device cpu")
        torch.cuda.set_device(local)
    watch.meet(JOIN_SECONDS)
    with explained(f"{backend} cannot connect the {count} ranks", "start them again", RuntimeError, kind=ResourceError):
        group = dist.PrefixStore("group", store)
        dist.init_process_group(backend, store=group, rank=rank, world_size=count, timeout=EXCHANGE_TIME)
    if rank == 0:
        torchrun = [("torchrun", *at) for at in listening_at(os.getppid()) if agent and at[1] == port]
        say_what_is_open([*(("rank 0", *at) for at in listening_at()), *torchrun])
    return _joined


join_ranks = join


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


def _stay_home(address: str) -> str | None:
    """Have gloo and NCCL listen at the loopback interface if all ranks are on this machine; return its address, else None."""
    home = loopback_of(address)
    if home and sys.platform != "win32":  # gloo finds no interface by its name there
        for library in ("GLOO", "NCCL"):
            os.environ.setdefault(f"{library}_SOCKET_IFNAME", loopback_interface(home))
    return home


def last_words(line: str, code: int) -> int:
    """Print why this process ends, and return its exit code."""
    if _joined is None:
        with contextlib.suppress(UsageError):  # unusable variables are those of no rank
            if place()[0]:
                return code
        say(line, error=True)
        return code
    with ignored_signals():  # torchrun ends the others once one has ended
        _joined.watch.fail(line)
    sys.stdout.flush()
    os._exit(code)  # a broken group may wait for ever
