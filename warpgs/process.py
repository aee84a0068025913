"""This process and its children: output, the terminal, signals, and Python modules in processes of their own."""

import atexit
import contextlib
import errno
import gc
import io
import os
import signal
import subprocess
import sys
import tempfile
import threading
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn, TextIO, TypeVar, cast

from warpgs.errors import ResourceError, UsageError
from warpgs.files import FULL, readable
from warpgs.folders import shared_locks

# Output that cannot be written: one line on stderr, and the command continues.
#
# Causes are a closed pipe, a full disk, a closed descriptor or a closed terminal. After the first failed write, all
# output goes to the null device, including that of native libraries.


def open_missing_descriptors() -> None:
    """Open the null device instead of a closed stdin, stdout or stderr."""
    # Otherwise the next file that is opened gets the free descriptor, and output is written into that file.
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            _send_to_null(number)


def _send_to_null(number: int) -> None:
    """Point a descriptor at the null device; leave it unchanged if no further descriptor can be opened."""
    with contextlib.suppress(OSError):
        null = os.open(os.devnull, os.O_RDWR)
        if null == number:  # it was closed, and the lowest free descriptor
            os.set_inheritable(number, True)
            return
        os.dup2(null, number)
        os.close(null)


def _lost(error: BaseException, remedy: str) -> None:
    """Print to stderr, if possible, why stdout cannot be written and what happens next."""
    reason = (isinstance(error, OSError) and error.strerror) or str(error)
    line = f"warpgs: stdout cannot be written ({reason}); {remedy}"
    if sys.stderr is not None:
        with contextlib.suppress(OSError, ValueError):
            print(line.encode("ascii", "backslashreplace").decode(), file=sys.stderr, flush=True)


GOES_ON = "the command continues without it"


class CarefulStream:
    """A text stream that does not raise if it cannot be written: the first error is kept, and later writes are dropped."""

    def __init__(self, stream: TextIO | None, says: bool = True):
        """Wrap a stream, or none where it was closed at the start; ``says`` prints on stderr that the command continues."""
        self.stream: TextIO = io.StringIO() if stream is None else stream
        self.says, self.failure = says, cast("BaseException | None", None)
        if stream is None:
            self._lose(OSError(errno.EBADF, os.strerror(errno.EBADF)))

    def write(self, text: str) -> int:
        """Write text, if the stream takes it; return its length."""
        self._try(self.stream.write, text)
        return len(text)

    def flush(self) -> None:
        """Flush the buffer, if the stream takes it."""
        self._try(self.stream.flush)

    def _try(self, call: Callable[..., object], *arguments: object) -> None:
        """Call a method of the stream, unless it has failed before."""
        if self.failure is None:
            try:
                call(*arguments)
            except (OSError, ValueError) as e:
                self._lose(e)

    def _lose(self, error: OSError | ValueError) -> None:
        """Keep the first error, and point the descriptor at the null device: buffers are flushed once more when Python ends."""
        if isinstance(error, ValueError) and not isinstance(error, OSError) and not self.stream.closed:
            raise error
        self.failure = error
        with contextlib.suppress(OSError, ValueError):
            _send_to_null(self.stream.fileno())
        if self.says:
            _lost(error, GOES_ON)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextlib.contextmanager
def careful_output(is_product: bool) -> Iterator[Callable[[int], int]]:
    """Replace stdout and stderr by streams whose writes do not raise; give a function that returns the final exit code.

    It is that of ResourceError if the command succeeded but its only result, stdout, could not be written.
    """
    open_missing_descriptors()
    before = sys.stdout, sys.stderr
    streams = out, _ = CarefulStream(before[0], not is_product), CarefulStream(before[1], False)
    sys.stdout, sys.stderr = (cast(TextIO, s) for s in streams)

    def exit_code(code: int) -> int:
        for stream in streams:
            stream.flush()
        failure, number = out.failure, getattr(out.failure, "errno", None)
        # as with ``| head``
        gone = isinstance(failure, BrokenPipeError) or (sys.platform == "win32" and number == errno.EINVAL)
        if code or failure is None or not is_product or gone:
            return code
        _lost(failure, ("free some disk space, or " if number in FULL else "") + "send the output elsewhere")
        return ResourceError.exit_code

    try:
        yield exit_code
    finally:
        for stream in streams:
            stream.flush()
        sys.stdout, sys.stderr = before


def careful(stream: TextIO) -> TextIO:
    """Return a stream whose writes do not raise, wrapped unless it already is; for displays that draw during a fit."""
    return stream if isinstance(stream, CarefulStream) else cast(TextIO, CarefulStream(stream))


T = TypeVar("T")
Say = Callable[[str], object]
"""A function that shows a line to the user, such as `say`."""

HIDDEN = {"Cc", "Cf", "Cs", "Zl", "Zp"}
"""Categories of characters that move the cursor, change the direction of text, end a line, or are surrogates."""
JOINERS = "\u200c\u200d"
"""Exceptions to `HIDDEN` that scripts and emoji need; they affect only adjacent letters."""


class Detail(str):
    """A note that needs no action: it goes to the files of a run and the last section of its report, not to the terminal."""

    __slots__ = ()


class Task(str):
    """A note that asks the user to act: it also stands in the last lines of the terminal, and first in the report."""

    __slots__ = ()


def printable(text: object) -> str:
    """Return text with codes in place of control characters, such as ESC, and of bytes that are not text."""
    letters = readable(str(text))
    hidden = {c for c in letters if unicodedata.category(c) in HIDDEN and c not in JOINERS}
    return "".join(c.encode("unicode_escape").decode() if c in hidden else c for c in letters)


_quiet = _is_lost = False


def be_quiet() -> None:
    """Print only errors from now on, since another process prints the same lines."""
    global _quiet
    _quiet = True


def say(line: object = "", *, error: bool = False) -> None:
    """Print one `printable` line at once, with codes for letters that the terminal does not have."""
    global _is_lost
    if _quiet and not error:
        return
    try:
        answer(line, error)
    except OSError as e:
        if not (error or _is_lost):
            _is_lost = True
            _lost(e, GOES_ON)


def say_lines(lines: Iterable[object], *, error: bool = False) -> None:
    """Print lines as `say` does."""
    for line in lines:
        say(line, error=error)


def answer(line: object, error: bool = False) -> None:
    """Print one line as `say` does, for the process that started this one: an error is raised if nobody reads it."""
    stream = sys.stderr if error else sys.stdout
    encoding = getattr(stream, "encoding", None) or "utf-8"
    print(printable(line).encode(encoding, "backslashreplace").decode(encoding), file=stream, flush=True)


def silent(line: str) -> None:
    """Show nothing."""


def counted(items: Sequence[T], tell: Say, what: str, unit: str) -> Iterator[T]:
    """Yield items; before each item, print how many are done: ``scoring: 3 of 12 views``."""
    for done, item in enumerate(items):
        tell(f"{what}: {done} of {len(items)} {unit}")
        yield item


def accept_all_letters() -> None:
    """Print codes for letters that the terminal does not have, also in the output of other libraries to stdout and stderr."""
    for stream in (sys.stdout, sys.stderr):
        if (reconfigure := getattr(stream, "reconfigure", None)) is not None:
            reconfigure(errors="backslashreplace")


@contextlib.contextmanager
def output_to(descriptor: int, numbers: tuple[int, ...] = (1, 2)) -> Iterator[None]:
    """Send stdout (1) and stderr (2) in the block to an open file, also for native libraries and other threads."""
    open_missing_descriptors()
    _flush(*numbers)
    saved = [os.dup(number) for number in numbers]
    try:
        for number in numbers:
            os.dup2(descriptor, number)
        yield
    finally:
        _flush(*numbers)
        for number, old in zip(numbers, saved, strict=True):
            os.dup2(old, number)
            os.close(old)


@contextlib.contextmanager
def hidden_stderr() -> Iterator[None]:
    """Hide the output to stderr in the block, also that of native libraries and other threads."""
    open_missing_descriptors()  # the null device must not become stdout or stderr
    with open(os.devnull, "wb") as null, output_to(null.fileno(), (2,)):
        yield


def _flush(*numbers: int) -> None:
    """Flush stdout (1) or stderr (2), if there is one and it can be written."""
    for number in numbers:
        with contextlib.suppress(AttributeError, OSError, ValueError):  # none, or nobody reads it
            (sys.stdout, sys.stderr)[number - 1].flush()


# File names that are not UTF-8: Linux allows any bytes in a name, and Python stores undecodable bytes as surrogates.
#
# Python opens such files. Libraries that expect UTF-8 fail on such names, and some end the process.


def utf8_name(path: Path) -> str:
    """Return the name of a file or folder for a library that needs UTF-8."""
    if readable(str(path)) != str(path):
        raise UsageError(f"{readable(str(path))}: the name is not UTF-8, which is needed here; rename the file or its folder")
    return str(path)


@contextlib.contextmanager
def fast_imports() -> Iterator[None]:
    """Switch garbage collection off for imports in the block, and exempt the imported objects from later collections."""
    if "torch" in sys.modules or not gc.isenabled():
        yield
        return
    atexit.register(gc.freeze)  # the system frees all memory at once, where a last collection would take .2 s
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def leave(code: int) -> NoReturn:
    """End the process as `sys.exit` does, but let the system free all memory at once, that of a GPU, too."""
    threading._shutdown()  # waits for all threads but daemons
    atexit._run_exitfuncs()
    _flush(1, 2)
    os._exit(code)


STOPPING = tuple(s for n in ("SIGINT", "SIGTERM", "SIGHUP") if (s := getattr(signal, n, None)))  # Windows has no SIGHUP
AGAIN = 0.05
"""Time after which a signal that Python discarded is sent again [s]."""


def _heeded() -> list[signal.Signals]:
    """Return the signals that end this process, without those that it was started to ignore, as by nohup."""
    if threading.current_thread() is not threading.main_thread():
        return []
    return [s for s in STOPPING if signal.getsignal(s) not in (signal.SIG_IGN, None)]


@contextlib.contextmanager
def _handled(handler: Callable[..., Any] | signal.Handlers) -> Iterator[None]:
    """Handle the signals by a function while the body runs."""
    before = {s: signal.signal(s, handler) for s in _heeded()}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def _send(number: signal.Signals) -> None:
    """Send a signal to the main thread, and wake the thread where the system can do that."""
    if sys.platform == "win32":
        signal.raise_signal(number)
    else:
        signal.pthread_kill(threading.main_thread().ident or 0, number)


@contextlib.contextmanager
def interrupting_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt in the body when a signal comes."""
    # Python discards an exception that is raised in a destructor or in a callback of a weak reference. A signal that
    # comes there is sent again.
    before = sys.unraisablehook

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    def unraisable(thrown: "sys.UnraisableHookArgs") -> None:
        if thrown.exc_type is not KeyboardInterrupt:
            before(thrown)
        elif numbers:  # from a thread: a signal sent here would interrupt this function
            timers.append(threading.Timer(AGAIN, _send, numbers[:1]))
            timers[-1].daemon = True
            timers[-1].start()

    numbers, timers = _heeded(), list[threading.Timer]()
    sys.unraisablehook = unraisable
    try:
        with _handled(interrupt):
            yield
    finally:
        for timer in timers:
            timer.cancel()
        sys.unraisablehook = before


@contextlib.contextmanager
def noted_signals() -> Iterator[Callable[[], bool]]:
    """Note the first signal, so that the body can end normally; a second one raises KeyboardInterrupt in the body."""
    came = False

    def note(*_: object) -> None:
        nonlocal came
        if came:
            raise KeyboardInterrupt
        came = True

    with _handled(note):
        yield lambda: came


def ignored_signals() -> contextlib.AbstractContextManager[None]:
    """Drop signals while the body prints the last lines of a program that is already ending."""
    return _handled(signal.SIG_IGN)


# Other processes. Python processes import nothing from the folder that warpgs was called in; no shell is started.

SAFE = {"PYTHONSAFEPATH": "1", "PYTHONIOENCODING": "utf-8"}


def end_with_parent() -> None:
    """Have this process end with its parent, even if the parent is killed: the stdin of this process ends then."""
    threading.Thread(target=lambda: (os.read(0, 1), os._exit(1)), daemon=True).start()


class ProcessFailed(Exception):
    """A process that ended with another exit code than 0."""

    def __init__(self, code: int, errors: str):
        """Keep the exit code, negative for a signal, and the text that the process wrote to stderr."""
        super().__init__(f"exit code {code}")
        self.code, self.errors = code, errors


def _environment(more: dict[str, str] | None) -> dict[str, str]:
    """Return variables with which a process imports this package as this process does, and nothing from the current folder."""
    search = os.pathsep.join(p for p in (str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")) if p)
    return {**os.environ, **SAFE, "PYTHONPATH": search, **(more or {})}


def python_lines(module: str, *arguments: str, folder: Path, environment: dict[str, str] | None = None) -> Iterator[str]:
    """Run a module of this package in ``folder``, yield the lines of its stdout, and end it once no more lines are read."""
    # the module calls `end_with_parent`: its stdin ends when this process is killed
    with shared_locks() as locks:
        worker = PythonWorker(module, *arguments, folder=folder, environment=environment, locks=locks)
    try:
        yield from worker.lines()
        code, errors = worker.end(None)
        if code:
            raise ProcessFailed(code, errors)
    finally:
        worker.end(0)


def run_program(
    program: str, *options: str, stdin: str = "", timeout: float, hidden: tuple[str, ...] = ()
) -> tuple[int, str, str]:
    """Run another program without the variables of ``hidden`` beginnings, and return its exit code, stdout and stderr."""
    environment = {k: v for k, v in _environment(None).items() if not k.startswith(hidden)}
    try:
        done = subprocess.run(
            [program, *options], input=stdin, env=environment, capture_output=True, text=True, encoding="utf-8",
            errors="replace", timeout=timeout, check=False,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as e:
        return 1, "", str(e)
    return done.returncode, done.stdout, done.stderr


def fed_program(*words: str, folder: str) -> tuple[Callable[[Any], object], Callable[[], object]]:
    """Start a program in a folder; return the function that writes to its stdin, and the one that ends it there.

    The latter raises ResourceError if the program failed.
    """
    process = subprocess.Popen(words, stdin=subprocess.PIPE, cwd=folder)
    assert process.stdin is not None

    def end() -> None:
        process.communicate()
        if process.returncode:
            raise ResourceError(f"{words[0]} ended with code {process.returncode}; repair it, or write another kind of file")

    return process.stdin.write, end


LAST_BYTES = 10_000
"""Bytes at the end of a process's stderr that are kept."""


class PythonWorker:
    """A process that runs a module of this package, takes lines on its stdin and answers on its stdout.

    Neither it nor its children import modules from the current folder (``-P``, PYTHONSAFEPATH), which may be an untrusted scene
    with a numpy.py. Only its parent handles Ctrl-C. The process stops at the end of its stdin, which also ends if the parent is
    killed.
    """

    def __init__(
        self, module: str, *arguments: str, folder: Path | None = None, environment: dict[str, str] | None = None,
        locks: tuple[int, ...] = (),
    ):  # fmt: skip
        """Start the process in ``folder``, with more ``environment`` variables and descriptors of ``locks`` to inherit."""
        self._errors = tempfile.TemporaryFile()  # closed by `end`
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", module, *arguments], env=_environment(environment), cwd=folder, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, stderr=self._errors, text=True, encoding="utf-8", errors="replace", pass_fds=locks,
            start_new_session=True,
        )  # fmt: skip

    def send(self, line: str) -> bool:
        """Send a line; return False where the process has ended."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError, ValueError):
            self._process.stdin.write(f"{line}\n")
            self._process.stdin.flush()
            return True
        return False

    def lines(self) -> Iterator[str]:
        """Yield the lines that the process answers, until the process ends."""
        assert self._process.stdout is not None
        yield from self._process.stdout

    def end(self, seconds: float | None) -> tuple[int, str]:
        """Close stdin, kill the process if it still runs after ``seconds``; return its exit code and the end of its stderr."""
        with contextlib.suppress(OSError):
            if self._process.stdin is not None:
                self._process.stdin.close()
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._errors.closed:
            return self._process.returncode, ""
        with self._errors:
            self._errors.seek(0, os.SEEK_END)
            self._errors.seek(max(0, self._errors.tell() - LAST_BYTES))
            return self._process.returncode, self._errors.read().decode("utf-8", "replace").strip()
