"""Permissions of folders: whether other users can change their contents."""

from __future__ import annotations

import os
import stat
from pathlib import Path


def open_to_others(folder: Path, depth: int = 0) -> Path | None:
    """Return the first path through which another user can change a folder's contents, or None.

    On Windows nothing is checked: mode bits have no meaning there, and the folder of a user's caches is private. Root is
    trusted, as root may do anything, and so is the owner of the whole file system.

    Args:
        folder: An existing folder, without links in its path.
        depth: Levels of the folder's contents that are checked as well.
    """
    if not hasattr(os, "getuid"):
        return None
    trusted = {os.getuid(), 0, Path(folder.anchor).stat().st_uid}
    for above in folder.parents:  # users with write access there can replace this folder
        found = above.stat()
        sticky = found.st_mode & stat.S_ISVTX  # as /tmp: users can move only their own files
        if found.st_uid not in trusted or (_writable_by_others(found, trusted) and not sticky):
            return above
    if _writable_by_others(folder.stat(), trusted):
        return folder
    if not folder.stat().st_mode & (stat.S_IXGRP | stat.S_IXOTH):
        return None  # other users cannot enter it
    for level in range(1, depth + 1):
        for path in folder.glob("/".join("*" * level)):
            try:
                found = path.lstat()
            except FileNotFoundError:  # another process has put its new file in place
                continue
            if stat.S_ISLNK(found.st_mode) or _writable_by_others(found, trusted):
                return path
    return None


def _writable_by_others(found: os.stat_result, trusted: set[int]) -> bool:
    if found.st_uid not in trusted or found.st_mode & stat.S_IWOTH:
        return True
    return bool(found.st_mode & stat.S_IWGRP) and not _is_own_group(found.st_gid)


def _is_own_group(gid: int) -> bool:
    """Return whether a group belongs to this user alone: many systems make a group per user, with the user's name or number."""
    import grp
    import pwd

    try:
        name = pwd.getpwuid(os.getuid()).pw_name
        group = grp.getgrgid(gid)
    except KeyError:
        return False
    return set(group.gr_mem) <= {name} and (gid == os.getuid() or group.gr_name == name)
