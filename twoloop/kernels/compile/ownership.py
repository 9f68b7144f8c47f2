"""Code is loaded from files and folders that belong to the user, or to root, and that no other user can write.

It is what ssh asks of keys: whoever can write a file of machine code, or put another in its place, runs what he likes
in the name of whoever loads it. A checksum within the file does not help, as he writes that, too.
"""

import hashlib
import os
import stat
import sys
import tempfile
from functools import cache
from pathlib import Path

from numba.misc.appdirs import AppDirs

ADVICE = (
    "Code is loaded only from what belongs to you or root and no other user can write: take that right away (chmod "
    "go-w) or set NUMBA_CACHE_DIR to a folder of your own in folders that others cannot write"
)


class Untrusted(OSError):
    """A file or folder that somebody else could have written; the text says why."""


def read_own(path: Path) -> bytes:
    """The content of a file in a folder of `own_folder`.

    Raises
    ------
    OSError
        If there is none; `Untrusted` if somebody else could have written it, which is said on stderr.
    """
    with path.open("rb") as file:
        if why := _doubt(os.fstat(file.fileno())):
            _say(f"twoloop: {path} {why}, and is not loaded but compiled again. {ADVICE}")
            raise Untrusted(f"{path} {why}")
        return file.read()


def write_own(path: Path, content: bytes) -> None:
    """Write a new file, which no other may write, whatever the umask."""
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644), "wb") as file:
        file.write(content)


def make_own(folder: Path) -> None:
    """Make a folder, and those above it that are missing, which no other may write, whatever the umask."""
    for each in [*reversed(folder.parents), folder]:
        if not each.exists():
            each.mkdir(0o755, exist_ok=True)


@cache
def own_folder(folder: Path) -> Path:
    """The folder, if only the user can write it and change what stands above it; else one of which this holds.

    That is in the folder of the user's caches, or, where that is in doubt too, one that ends with this process.
    """
    why = doubt_of(folder)
    if not why:
        return folder
    subfolder = f"{folder.name}_{hashlib.sha256(str(folder).encode()).hexdigest()[:16]}"
    instead = Path(AppDirs(appname="twoloop", appauthor=False).user_cache_dir) / "code" / subfolder
    if doubt_of(instead):
        instead = Path(_ending_with_the_process()) / subfolder
    _say(f"twoloop: no code is loaded from {folder}: {why}. It is kept in {instead} instead. {ADVICE}")
    return instead


def doubt_of(folder: Path) -> str:
    """Why a folder, or what stands above it, may have been written by somebody else; "" where it cannot."""
    if os.name != "posix":  # rights on other systems are not in the mode
        return ""
    real = Path(os.path.realpath(folder))
    for each in [real, *real.parents]:
        try:
            found = each.stat()
        except FileNotFoundError:  # to be made
            continue
        except OSError as error:
            return f"{each} cannot be looked at ({error.strerror})"
        sticky = each != real and found.st_mode & stat.S_ISVTX  # there only the owner of an entry can replace it
        why = _doubt_of_owner(found) if sticky else _doubt(found)
        if why:
            return f"{each} {why}"
    return ""


def _doubt(found: os.stat_result) -> str:
    if os.name != "posix":
        return ""
    if why := _doubt_of_owner(found):
        return why
    if found.st_mode & stat.S_IWOTH:
        return f"can be written by everybody (mode {stat.S_IMODE(found.st_mode):o})"
    if found.st_mode & stat.S_IWGRP and not _private(found.st_gid):
        return f"can be written by group {found.st_gid} (mode {stat.S_IMODE(found.st_mode):o})"
    return ""


def _doubt_of_owner(found: os.stat_result) -> str:
    return "" if found.st_uid in (0, os.geteuid()) else f"belongs to user {found.st_uid}"


@cache
def _private(gid: int) -> bool:
    """Whether a group has no other member: root's, or the user's own, as distributions with umask 0002 make them."""
    import grp  # not on Windows
    import pwd

    try:
        user, group = pwd.getpwuid(os.geteuid()), grp.getgrgid(gid)
    except KeyError:  # a user without an entry, as in containers
        return False
    own = gid == 0 or (gid == user.pw_gid and group.gr_name == user.pw_name)
    return own and set(group.gr_mem) <= {"root", user.pw_name}


_temporary: list[tempfile.TemporaryDirectory[str]] = []


def _ending_with_the_process() -> str:
    if not _temporary:
        _temporary.append(tempfile.TemporaryDirectory(prefix="twoloop-"))
    return _temporary[0].name


_said: list[str] = []


def _say(text: str) -> None:
    """Print the first warning of a process on stderr."""
    if not _said:
        _said.append(text)
        print(text, file=sys.stderr, flush=True)
