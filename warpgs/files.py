"""Files: read with a bounded size, written whole or not at all."""

import contextlib
import csv
import errno
import hashlib
import io
import json
import os
import re
import shutil
import stat
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from warpgs import folders
from warpgs.errors import DataError, MalformedError, ResourceError, UsageError, expect, explained
from warpgs.folders import WINDOWS, Folder, RefusedError, Temporary, is_below, open_folder, output_folder, sweep, temporary_file

# Opening of input files: only regular files of bounded size, so that no pipe hangs a command and no device fills its
# memory.
#
# Every untrusted file is opened here. An unreadable file raises an OSError with the reason as its ``strerror``. Callers
# then raise a `DataError` with the reason and a remedy, as `read_file` does.

MAX_BYTES = 2**34
"""Default size of the largest file that is read into memory [bytes]."""
NOT_REGULAR = "is not a regular file"
"""Reason for a pipe, a socket or a device."""
PIECE = 1 << 20
"""Bytes read at a time from a file that is longer than its reported size."""


def open_input(path: str | os.PathLike[str], below: Path | None = None) -> BinaryIO:
    """Open a regular file for reading in binary mode; from a folder ``below`` to the file there must be no link."""
    if below is not None:
        path = Path(path)
        with output_folder(below), open_folder(path.parent) as folder:
            return os.fdopen(folder.open_regular(path.name, os.O_RDONLY), "rb")
    path = os.fspath(path)
    _check_kind(os.stat(path).st_mode, path)  # a device is not even opened
    # a pipe that took the file's place since then must not block
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0))
    try:
        _check_kind(os.fstat(descriptor).st_mode, path)
        if not WINDOWS:
            os.set_blocking(descriptor, True)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def _check_kind(mode: int, path: str) -> None:
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "is a folder" if stat.S_ISDIR(mode) else NOT_REGULAR, path)


def read_input(path: str | os.PathLike[str], most: int = MAX_BYTES, below: Path | None = None) -> bytes:
    """Return the contents of a regular file of at most ``most`` bytes; ``below`` as in `open_input`."""
    with open_input(path, below) as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(size + 1) if size <= most else b""
        while size < len(data) <= most and (more := file.read(PIECE)):  # files of /proc have no size, logs grow
            data += more
    if max(size, len(data)) > most:
        limit = f"{most // 2**20:,} MiB" if most >= 2**20 else f"{most:,} bytes"
        raise OSError(errno.EFBIG, f"is larger than {limit}", str(Path(path)))
    return data


def read_start(path: str | os.PathLike[str], count: int) -> bytes:
    """Return the first bytes of a regular file, at most ``count``."""
    with open_input(path) as file:
        return file.read(count)


def read_file(
    path: Path, below: Path | None = None, most: int = MAX_BYTES, fix: str = "restore it, or make it again", what: str = ""
) -> bytes:
    """Return what `read_input` does, or raise a DataError with a remedy, in which ``what`` names the contents."""
    with explained(f"{path}: {what}cannot be read", fix):
        return read_input(path, most, below)


DTYPES = {
    "torch.float64": "F64", "torch.float32": "F32", "torch.int64": "I64", "torch.int32": "I32", "torch.uint8": "U8",
    "torch.bool": "BOOL",
}  # fmt: skip
"""Names of scalar types in a safetensors file."""
PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
"""Scalar types of a PLY file, as numpy names them without the order of bytes."""


PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
"""Order of bytes by format; the numbers of an ASCII file do not need one."""
PLY_LIST = "list"
"""Type of a property that is a list, so that rows differ in length."""
PlyElement = tuple[str, int, list[tuple[str, str]]]
"""Name and number of rows of an element, and pairs (name, numpy type) of its properties in file order."""
MAX_HEADER_BYTES = 65536
"""Largest accepted header of a PLY file [bytes]; real headers have some two thousand."""


def ply_header(head: bytes) -> tuple[list[PlyElement], int, bool]:
    """Return the elements of the header in a PLY file's first bytes, the offset [bytes] of the data, and if they are ASCII."""
    expect(re.match(rb"ply[ \t]*\r?\n", head), "it does not start with 'ply' (other formats: warpgs.export.read_gaussians)")
    end: Any = re.search(rb"^end_header[ \t]*\r?\n", head, re.MULTILINE)
    expect(end, f"no 'end_header' line within the first {MAX_HEADER_BYTES} bytes")
    elements: list[PlyElement] = []
    formats = []
    # comments may have any encoding
    for line in head[: end.start()].decode("utf-8", "replace").split("\n")[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", *words]:
                formats.append(" ".join(words))
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,18}", count):
                elements.append((name, int(count), []))
            case ["property", "list", count, item, name] if elements and count in PLY_TYPES and item in PLY_TYPES:
                elements[-1][2].append((name, PLY_LIST))
            case ["property", kind, name] if elements and kind in PLY_TYPES:
                elements[-1][2].append((name, PLY_TYPES[kind]))
            case _:
                raise MalformedError(f"header line {line[:80]!r} is invalid")
    known = [f"{name} 1.0" for name in PLY_ORDERS]
    given = " and ".join(formats)[:80] or "not given"
    expect(given in known, f"its format is {given}, not one of {', '.join(known)}")
    order = PLY_ORDERS[given.split()[0]]
    elements = [(n, c, [(p, k if k in (PLY_LIST, "i1", "u1") else order + k) for p, k in own]) for n, c, own in elements]
    return elements, end.end(), given == "ascii 1.0"


def tensor_pieces(tensors: dict[str, Any], metadata: dict[str, str]) -> list[memoryview | bytes]:
    """Return a safetensors file in pieces, the same for the same tensors; those of CPU tensors share their memory."""
    import torch

    ordered = sorted(tensors.items(), key=lambda item: (-item[1].element_size(), item[0]))  # aligned for every reader
    parts = [t.detach().cpu().contiguous().reshape(-1).view(torch.uint8) for _, t in ordered]
    header: dict[str, Any] = {"__metadata__": metadata}
    end = 0
    for (name, t), part in zip(ordered, parts):
        begin, end = end, end + len(part)
        header[name] = {"dtype": DTYPES[str(t.dtype)], "shape": list(t.shape), "data_offsets": [begin, end]}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    return [len(text).to_bytes(8, "little"), text, *(p.numpy().data for p in parts)]


def tensors_of(data: bytes) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the tensors [...] of a safetensors file by name, on the CPU, and its metadata; ValueError if it is damaged."""
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        tensors = load(data)
    except SafetensorError as e:
        raise ValueError(str(e)) from e
    return tensors, json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")]).get("__metadata__") or {}


def read_tensors(path: Path, fix: str, again: str) -> tuple[dict[str, Any], dict[str, Any], bytes]:
    """Return what `tensors_of` returns, and the file itself; ``again`` is the remedy for a damaged one."""
    data = read_file(path, fix=fix)
    with explained(f"{path}: damaged or not a safetensors file", again, ValueError):
        return *tensors_of(data), data


def input_digest(path: str | os.PathLike[str], below: Path | None = None) -> str:
    """Return the SHA-256 of a regular file, hexadecimal, or raise DataError; ``below`` as in `open_input`."""
    fix = "fix its permissions or copy it again"
    with explained(f"{path}: cannot be read", fix), open_input(path, below) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


LOCK = ".warpgs.lock"
"""Name of the file that a process holds while it writes into a folder."""
UNDECODABLE = re.compile("[\udc80-\udcff]")
"""Characters that Python puts in the place of bytes that are not UTF-8."""
FULL = (errno.ENOSPC, errno.EDQUOT)
"""Errors of a full disk, or of an exhausted disk quota."""
FIXES = {errno.ENOENT: "create its folder", errno.EACCES: "change its permissions"}
"""What to do about an error, other than to free disk space."""
NO_FOLDER_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.EACCES)
"""Errors of file systems that cannot sync a folder."""


@contextlib.contextmanager
def writable(path: Path, remedy: str = "", done: str = "written", amount: str = "", note: str = "") -> Iterator[None]:
    """Raise ResourceError where the block cannot write ``path``; it names what cannot be done with what amount, and the fix."""
    try:
        yield
    except RefusedError as e:
        raise ResourceError(f"{path}: cannot be {done}, as {e}") from e
    except OSError as e:
        held = WINDOWS and isinstance(e, PermissionError)
        first = "close the programs that have it open" if held else FIXES.get(e.errno or 0, "free some disk space")
        fix = remedy or f"{first}, or write elsewhere"
        raise ResourceError(f"{path}: {amount}cannot be {done} ({e.strerror or e}){note}; {fix}") from e


@contextlib.contextmanager
def replacing(
    path: Path, check: Callable[[Path], object] | None = None, *, size: int | None = None, suffix: str = ""
) -> Iterator[tuple[BinaryIO, Path]]:
    """Give a temporary file beside ``path``, open and by its path; the block writes it, and then it replaces ``path``."""
    # The temporary file is synced to the disk and checked first; the folder is synced afterwards. On any error,
    # including one in the block, the temporary file is removed and an old file stays unchanged. If ``path`` is a link,
    # the link is replaced.
    amount = "" if size is None else f"{size / 2**20:.1f} MiB " if size >= 2**20 else f"{size:,} bytes "
    with (
        writable(path, amount=amount, note="; the old file is untouched" * os.path.lexists(path)),
        open_folder(path.parent) as folder,
        temporary_file(folder, suffix) as (name, file),
    ):
        reachable = folder.reachable() / name
        yield file, reachable
        file.flush()
        os.fsync(file.fileno())
        written = os.fstat(file.fileno())
        if not os.path.samestat(written, folder.lstat(name)):
            raise OSError(errno.EIO, "another file took the place of the temporary one")
        if size is not None and written.st_size != size:  # some file systems report no error
            raise OSError(errno.EIO, f"only {written.st_size} of {size} bytes were written")
        if check is not None:
            check(reachable)
        if WINDOWS:  # where no open file can be replaced
            file.close()
        folder.replace(name, path.name)
        _sync(folder)


@contextlib.contextmanager
def filling(folder: Path) -> Iterator[Path]:
    """Give the path of a temporary folder beside ``folder``; the block fills it, and then it is renamed to ``folder``."""
    target = folder.absolute() if is_below(folder) else Path(os.path.realpath(folder))
    if os.path.realpath(target) == os.path.realpath(Path.cwd()):
        raise UsageError(f"{folder}: refusing to replace the current directory; choose another path")
    make_folder(target.parent)
    with contextlib.ExitStack() as stack:
        with writable(folder, done="created"):
            above = stack.enter_context(open_folder(target.parent))
            sweep(above)
            temporary = stack.enter_context(Temporary(above))
            above.mkdir(temporary.name)
        with output_folder(temporary.path):
            yield temporary.path
        with writable(folder, done="created"):
            with contextlib.suppress(FileNotFoundError), above.folder(target.name) as inside:
                sweep(inside)  # leftovers of killed writers
                above.rmdir(target.name)
            above.replace(temporary.name, target.name)
        _sync(above)


def _sync(folder: Folder) -> None:
    """Sync a folder to the disk, so that the names in it survive a power failure."""
    try:
        if folder.descriptor is not None:  # Windows has no such call
            os.fsync(folder.descriptor)
    except OSError as e:
        if e.errno not in NO_FOLDER_SYNC:
            raise ResourceError(f"{folder.path}: the disk does not confirm a write ({e.strerror or e}); check the disk") from e


def write_bytes(path: Path, *chunks: bytes | memoryview) -> None:
    """Replace a file by chunks of bytes, once all of them are on disk."""
    with replacing(path, size=sum(map(len, chunks))) as (file, _):
        file.writelines(chunks)


def write_text(path: Path, text: str) -> None:
    """Replace a text file (UTF-8) as `write_bytes` does; undecodable bytes of file names are escaped by `readable`."""
    write_bytes(path, readable(text).encode())


def write_csv(path: Path, rows: Iterable[Iterable[object]]) -> None:
    """Replace a CSV file as `write_text` does."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    write_text(path, text.getvalue())


def readable(text: str) -> str:
    r"""Return text in which undecodable bytes of file names, and lone surrogates, are escaped: ``b\xe4r``."""
    escaped = UNDECODABLE.sub(lambda byte: f"\\x{ord(byte[0]) - 0xDC00:02x}", text)
    return escaped.encode("utf-8", "backslashreplace").decode()


def write_json(path: Path, values: object) -> None:
    """Replace a JSON file as `write_bytes` does; NaN and infinity become null, because JSON cannot hold them."""
    write_text(path, json.dumps(plain(values), indent=1) + "\n")


def plain(value: object) -> object:
    """Return a value that JSON can hold: tuples become lists, NaN and infinity null."""
    if isinstance(value, float) and not (value - value == 0):
        return None
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    return [plain(v) for v in value] if isinstance(value, (list, tuple)) else value


def appending(path: Path) -> BinaryIO:
    """Open a file to append to, made if it is missing; a link is not followed."""
    with open_folder(path.parent) as folder:
        descriptor = folder.open_regular(path.name, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    return open(descriptor, "ab")


def remove_file(path: Path) -> None:
    """Remove a file, or a link itself, if it is there."""
    with writable(path, "remove it by hand", "removed"), contextlib.suppress(FileNotFoundError):
        with open_folder(path.parent) as folder:
            folder.unlink(path.name)


def move_folder(folder: Path, name: str) -> Path:
    """Rename a folder within its parent folder, and return the new path."""
    with open_folder(folder.parent) as above:
        above.folder(folder.name).close()
        above.replace(folder.name, name)
    return folder.with_name(name)


def make_folder(folder: Path) -> bool:
    """Make a folder and its missing parents; return False if the folder existed."""
    with writable(folder, "choose another folder, or free some disk space", "written, as the folder cannot be created"):
        made = not os.path.exists(folder)  # False where Path.exists would raise an error
        if is_below(folder):
            open_folder(folder, make=True).close()
        else:
            folder.mkdir(parents=True, exist_ok=True)
    return made


@contextlib.contextmanager
def writing_into(folder: Path) -> Iterator[bool]:
    """Make a folder if it is missing, and follow no link below it in this block; yield whether it was missing."""
    made = make_folder(folder)
    with contextlib.ExitStack() as stack:
        with writable(folder, "choose another folder"):
            stack.enter_context(output_folder(folder))
        yield made


def is_empty(folder: Path) -> bool:
    """Return whether a folder is empty, except for a lock and leftovers of interrupted writes."""
    with explained(f"{folder}: cannot be read", "choose a folder that you may read and write", kind=ResourceError):
        return all(p.name == LOCK or folders.NAMES.fullmatch(p.name) for p in folder.iterdir())


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files and folders of killed processes; those that a running process has locked stay."""
    try:
        with open_folder(folder) as found:
            sweep(found)
    except RefusedError as e:
        raise ResourceError(f"{folder}: cannot be written, as {e}") from e
    except OSError:  # the folder is missing or cannot be read: nothing has to be removed
        return


def inside(path: Path, root: Path, noun: str) -> Path:
    """Return a path after a check that no link in it points outside ``root``; ``noun`` is its name in messages."""
    if not is_within(path, root):
        raise DataError(f"{path}: a link points outside {noun}; put the files inside of it, or pass --allow-outside")
    return path


def is_within(path: Path, root: Path) -> bool:
    """Return True if a path is below ``root``, links followed; a circular link is not followed."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(root))


WORDS = (*map(os.strerror, FULL), "disk is full", f"[Errno {errno.ENOSPC}]", f"[Errno {errno.EDQUOT}]")
"""Parts of the messages that systems, SQLite and Python give for a full disk."""
MIN_FREE = 2**16
"""Free space below which a disk counts as full [bytes]: some libraries fail without naming the full disk."""


def disk_is_full(folder: Path, said: str) -> bool:
    """Return whether a process failed because the disk of a folder that it wrote into is full."""
    if any(words in said for words in WORDS):
        return True
    with contextlib.suppress(OSError):
        return shutil.disk_usage(folder).free < MIN_FREE
    return False
