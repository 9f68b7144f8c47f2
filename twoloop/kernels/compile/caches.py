"""Cache machine code on disk: where numba keeps it, when it is out of date, and what happens if it cannot be kept.

Numba watches the file in which a function stands, and nothing else: not the helpers in other files, and not the values
of globals, which it freezes. It raises when no folder can be written and when a file is damaged, and runs what others
have put into one. Here each function and key has a file of its own behind a checksum, and code is loaded only from
files and folders that belong to the user, or to root, and that no other user can write. That is what ssh asks of keys:
whoever can write a file of machine code, or put another in its place, runs what he likes in the name of whoever loads
it. A checksum within the file does not help, as he writes that, too.
"""

import gc
import glob
import hashlib
import inspect
import os
import pickle
import stat
import sys
import tempfile
import types
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numba
from numba import njit
from numba.core import caching
from numba.core.caching import FunctionCache, NullCache
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps
from numba.misc.appdirs import AppDirs

from twoloop.kernels.compile.dependencies import Digest, NotDigestible, enclosed_by, names_reached
from twoloop.kernels.compile.linking import forget_compiled, jitable_templates

ADVICE = (
    "Code is loaded only from what belongs to you or root and no other user can write: take that right away (chmod "
    "go-w) or set NUMBA_CACHE_DIR to a folder of your own in folders that others cannot write"
)


class Untrusted(OSError):
    """Error for a file or folder that somebody else could have written; the text gives the reason."""


def read_trusted(path: Path) -> bytes:
    """Read a file in a folder of `trusted_folder`.

    Raises
    ------
    OSError
        If there is none; `Untrusted` if somebody else could have written it, which is said on stderr.
    """
    with path.open("rb") as file:
        if why := _reason_of_mode(os.fstat(file.fileno())):
            _warn_first(f"twoloop: {path} {why}, and is not loaded but compiled again. {ADVICE}")
            raise Untrusted(f"{path} {why}")
        return file.read()


def write_trusted(path: Path, content: bytes) -> None:
    """Write a new file that no other user may write, whatever the umask."""
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644), "wb") as file:
        file.write(content)


def make_trusted_folder(folder: Path) -> None:
    """Create a folder, and missing ones above it, that no other user may write, whatever the umask."""
    for each in [*reversed(folder.parents), folder]:
        if not each.exists():
            each.mkdir(0o755, exist_ok=True)


@cache
def trusted_folder(folder: Path) -> Path:
    """Return the folder if only the user can write it and change the folders above it; otherwise a replacement.

    The replacement is in the folder of the user's caches or, if that is in doubt too, a temporary one of this process.
    """
    why = reason_to_distrust(folder)
    if not why:
        return folder
    subfolder = f"{folder.name}_{hashlib.sha256(str(folder).encode()).hexdigest()[:16]}"
    instead = Path(AppDirs(appname="twoloop", appauthor=False).user_cache_dir) / "code" / subfolder
    if reason_to_distrust(instead):
        instead = Path(_temporary_folder()) / subfolder
    _warn_first(f"twoloop: no code is loaded from {folder}: {why}. It is kept in {instead} instead. {ADVICE}")
    return instead


def reason_to_distrust(folder: Path) -> str:
    """Return why somebody else may have written a folder, or one above it; "" if nobody can."""
    if os.name != "posix":  # other systems do not keep access rights in the mode
        return ""
    real = Path(os.path.realpath(folder))
    for each in [real, *real.parents]:
        try:
            found = each.stat()
        except FileNotFoundError:  # the folder does not exist yet
            continue
        except OSError as error:
            return f"{each} cannot be looked at ({error.strerror})"
        # in a sticky folder only the owner of an entry can replace it
        sticky = each != real and found.st_mode & stat.S_ISVTX
        why = _reason_of_owner(found) if sticky else _reason_of_mode(found)
        if why:
            return f"{each} {why}"
    return ""


def _reason_of_mode(found: os.stat_result) -> str:
    if os.name != "posix":
        return ""
    if why := _reason_of_owner(found):
        return why
    if found.st_mode & stat.S_IWOTH:
        return f"can be written by everybody (mode {stat.S_IMODE(found.st_mode):o})"
    if found.st_mode & stat.S_IWGRP and not _is_private_group(found.st_gid):
        return f"can be written by group {found.st_gid} (mode {stat.S_IMODE(found.st_mode):o})"
    return ""


def _reason_of_owner(found: os.stat_result) -> str:
    return "" if found.st_uid in (0, os.geteuid()) else f"belongs to user {found.st_uid}"


@cache
def _is_private_group(gid: int) -> bool:
    """Return whether a group has no other member: root's, or the user's own, as distributions with umask 0002 make."""
    import grp  # not on Windows
    import pwd

    try:
        user, group = pwd.getpwuid(os.geteuid()), grp.getgrgid(gid)
    except KeyError:  # a user without an entry, as in containers
        return False
    own = gid == 0 or (gid == user.pw_gid and group.gr_name == user.pw_name)
    return own and set(group.gr_mem) <= {"root", user.pw_name}


_temporary: list[tempfile.TemporaryDirectory[str]] = []


def _temporary_folder() -> str:
    if not _temporary:
        _temporary.append(tempfile.TemporaryDirectory(prefix="twoloop-"))
    return _temporary[0].name


_warnings: list[str] = []


def _warn_first(text: str) -> None:
    """Print the first warning of a process on stderr."""
    if not _warnings:
        _warnings.append(text)
        print(text, file=sys.stderr, flush=True)


MAX_ON_DISK = 500  # most sets of functions generated for single mechanisms, of each kind, on disk
CHECKSUM = hashlib.sha256().digest_size


class CodeFiles:
    """Store machine code of one function: a file for each key, behind a checksum, that only the user can write.

    A file that is damaged or out of date counts as missing. Numba's own keep an index, through which two processes that
    write at the same time may lead one function to the machine code of another.
    """

    def __init__(self, folder: Path, name: str, stamp: Any, limited: bool = False):
        self.folder, self.name, self.limited = folder, name, limited
        self.made_of = numba.__version__, stamp

    def save(self, key: Any, data: Any) -> None:
        """Write numba's data for a key, in place of the previous file."""
        content = pickle.dumps((repr((*self.made_of, key)), dumps(data)))
        path = self._path(key)
        unfinished = path.with_suffix(f".{uuid.uuid4().hex}")
        make_trusted_folder(self.folder)
        try:
            write_trusted(unfinished, hashlib.sha256(content).digest() + content)
            unfinished.replace(path)
        finally:
            unfinished.unlink(missing_ok=True)
        if self.limited:
            for old in sorted(self._all(), key=_time_written)[:-MAX_ON_DISK]:
                old.unlink(missing_ok=True)

    def has(self, key: Any) -> bool:
        """Return whether there is a file for a key."""
        return self._path(key).exists()

    def load(self, key: Any) -> Any:
        """Read numba's data for a key; return None if the file is missing."""
        try:
            content = read_trusted(self._path(key))
        except OSError:
            return None
        if hashlib.sha256(content[CHECKSUM:]).digest() != content[:CHECKSUM]:
            return None
        made_of, data = pickle.loads(content[CHECKSUM:])
        return pickle.loads(data) if made_of == repr((*self.made_of, key)) else None

    def flush(self) -> None:
        """Remove the files of all keys."""
        for path in self._all():
            path.unlink(missing_ok=True)

    def _all(self) -> list[Path]:
        return list(self.folder.glob(f"{glob.escape(self.name)}.*.nbc"))

    def _path(self, key: Any) -> Path:
        return self.folder / f"{self.name}.{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.nbc"


def _time_written(path: Path) -> float:
    """Return the time at which a file was written; 0 if another process has removed it."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


UNWRITABLE = (
    "twoloop: machine code cannot be kept on disk, so every process compiles again. Set NUMBA_CACHE_DIR to a folder "
    "that only you can write"
)
MAX_IN_MEMORY = 50  # most sets of functions generated for single mechanisms, of each kind, in memory
# numba 0.61 has this class under a private name
_LOCATOR: Any = vars(caching).get("UserProvidedCacheLocator") or vars(caching)["_UserProvidedCacheLocator"]


def compile_cached(
    function: Callable[..., Any],
    signature: Any,
    watched: tuple[str, str] | None,
    *,
    announcement: str = "",
    **options: Any,
) -> Dispatcher:
    """Compile a function for one signature, or read its machine code from the disk.

    Parameters
    ----------
    function : callable
        What numba compiles.
    signature : numba signature
        The only one that it will have.
    watched : (str, str) or None
        What the machine code depends on beside the file of the function, see `digests_of`: when the first changes, all
        is compiled again; the second tells functions apart that share their source. None: the machine code is not kept.
    announcement : str
        Said on stderr, once a process, before it compiles.
    **options
        Of numba.njit.
    """
    dispatcher = njit(**options)(with_unique_name(function, watched))
    function = dispatcher.py_func
    if watched is not None:
        try:
            dispatcher._cache = _Cache(function, *watched, announcement)
        except RuntimeError:  # numba finds no folder; functions typed at a prompt have none
            if Path(inspect.getfile(function)).exists():
                warn_once(UNWRITABLE)
    with garbage_collection_off():
        dispatcher.compile(signature)
    dispatcher.disable_compile()
    _N_COMPILED[0] += 1
    return dispatcher


@contextmanager
def garbage_collection_off() -> Iterator[None]:
    """Suspend the collection of cycles, which takes a sixth of the time: numba's objects live until the end."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


class BoundedCache(dict[Any, Any]):
    """Cache data of single mechanisms by digests: the newest MAX_IN_MEMORY, because a sweep adds one for each run."""

    def __setitem__(self, key: Any, made: Any) -> None:
        super().__setitem__(key, made)
        for old in list(self)[:-MAX_IN_MEMORY]:
            self.pop(old, None)


_N_COMPILED = [0]


def n_compiled() -> int:
    """Return the number of numba functions, all in memory, that this process has compiled or read from the disk."""
    return _N_COMPILED[0]


def cache_folder(package: types.ModuleType) -> Path | None:
    """Return the folder of the machine code of a package; None if no folder can be written."""

    def anything() -> None:
        pass

    code = anything.__code__.replace(co_filename=str(package.__file__))
    anything.__code__ = code
    try:
        return trusted_folder(Path(FunctionCache(anything).cache_path))
    except RuntimeError:
        return None


def with_unique_name(function: Callable[..., Any], watched: tuple[str, str] | None) -> Callable[..., Any]:
    """Return a copy of a nested function, or a lambda, under a unique name; return any other function unchanged.

    Numba's symbols consist of the qualified name and of a number that counts within a process. Two closures of one name
    whose machine code comes from different processes may share a symbol: the one that is loaded first is then called in
    the place of both.
    """
    if watched is None or "<" not in function.__qualname__:
        return function
    code = function.__code__
    copy = types.FunctionType(
        code, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    copy.__kwdefaults__, copy.__module__ = function.__kwdefaults__, function.__module__
    apart = hashlib.sha256(repr((watched, code.co_filename, code.co_firstlineno)).encode()).hexdigest()
    copy.__qualname__ = f"{function.__qualname__}.{apart[:16]}"
    return copy


class _Cache(FunctionCache):
    """Extend numba's cache of one function by the stamp of twoloop; its errors cost time but are never raised."""

    def __init__(self, function: Callable[..., Any], stamp: str, key: str, announcement: str):
        chosen: str = numba.config.CACHE_DIR  # type: ignore[attr-defined]
        if chosen:  # numba would create the folder by the umask
            with suppress(OSError):
                make_trusted_folder(Path(chosen, _LOCATOR.get_suitable_cache_subpath(inspect.getfile(function))))
        super().__init__(function)
        source = self._cache_file._source_stamp
        own = trusted_folder(Path(self._cache_path))
        self._cache_path = str(own)
        self._cache_file = CodeFiles(own, self._impl.filename_base, (source, stamp))
        self._key, self._announcement = key, announcement

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        return sig, codegen.magic_tuple(), self._key

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            found = super().load_overload(sig, target_context)
        except Exception:  # a file of another installation: the function is compiled again and the file overwritten
            found = None
        if found is None and self._announcement:
            warn_once(self._announcement)
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError:
            warn_once(UNWRITABLE)


def sources_folder() -> Path:
    """Return the folder of generated source: NUMBA_CACHE_DIR if it is set, else the folder of the user's caches.

    If others can write there, return a folder that they cannot write.
    """
    chosen: str = numba.config.CACHE_DIR  # type: ignore[attr-defined]
    folder = chosen or AppDirs(appname="twoloop", appauthor=False).user_cache_dir
    return trusted_folder(Path(folder) / "equations")


@cache
def warn_once(text: str) -> None:
    """Print a line on stderr, once a process."""
    print(text, file=sys.stderr, flush=True)


def compiled_when_called(**options: Any) -> Callable[[Callable[..., Any]], Dispatcher]:
    """Decorate a closure of callbacks by `numba.njit(**options)`: compiled when called, with machine code on disk."""

    def decorate(function: Callable[..., Any]) -> Dispatcher:
        watched = digests_of(function)
        dispatcher = njit(**options)(with_unique_name(function, watched))
        if watched is not None:
            _COMPILED_DIGESTS[dispatcher] = (
                watched  # then a closure that encloses this function does not compile it again
            )
            with suppress(RuntimeError):  # no folder can be written
                dispatcher._cache = _Cache(dispatcher.py_func, *watched, "")
        return dispatcher

    return decorate


def digests_of(function: Callable[..., Any]) -> tuple[str, str] | None:
    """Return digests of all that the machine code of a function depends on, and of the values that it encloses.

    The first is of its code, its defaults, and the values of the globals and of the attributes of modules that it
    names; of compiled helpers among them the same, and so on. None: something among it cannot be watched.
    """
    watched, helpers = _digests_and_helpers(function)
    for each in helpers:
        _put_under_cache(each)
    return watched


def _digests_and_helpers(function: Callable[..., Any]) -> tuple[tuple[str, str] | None, list[Any]]:
    """Return the digests of `digests_of`, and the helpers found, each after those that it names."""
    code, enclosed = Digest(), Digest()
    enclosed.names = names_reached(function)  # names of attributes of the modules that it encloses
    try:
        code.add_function(function, enclosed=False)
        enclosed.add(enclosed_by(function))
        watched = code.hash.hexdigest(), enclosed.hash.hexdigest()
    except NotDigestible:
        watched = None
    return watched, [*code.helpers, *enclosed.helpers]


def helper(function: Callable[..., Any]) -> Any:
    """Decorate a function that compiled callbacks call: numba's `njit` with the cache of twoloop.

    Such a function allocates nothing. So it needs no numba runtime, whose counts of references to arrays take longer
    than a row of C_q.
    """
    options: dict[str, Any] = {"_nrt": False, "error_model": "numpy"}
    dispatcher = njit(**options)(function)
    dispatcher.enable_caching()
    _put_under_cache(dispatcher)
    return dispatcher


# digests of what helpers depended on when they were compiled
_COMPILED_DIGESTS: WeakKeyDictionary[Any, tuple[str, str]] = WeakKeyDictionary()


def _put_under_cache(helper: Any) -> None:
    """Replace numba's cache of a helper by that of twoloop, and recompile a helper that names other values now.

    Numba's cache does not see what a helper calls in other files. Numba keeps what it has compiled, or read, for all
    functions that call it later; it may have done so before the helper came here, unless the signatures were given.
    """
    watched, known = _digests_and_helpers(getattr(helper, "py_func", helper))[0], _COMPILED_DIGESTS.get(helper)
    changed = known is not None and known != watched
    if watched is not None:
        _COMPILED_DIGESTS[helper] = watched
    if jitable_templates(helper):
        if changed or known is None:
            forget_compiled(helper)
        return
    if isinstance(helper._cache, FunctionCache) and (changed or not isinstance(helper._cache, _Cache)):
        try:
            helper._cache = NullCache() if watched is None else _Cache(helper.py_func, *watched, "")
        except RuntimeError:
            helper._cache = NullCache()
    if helper.overloads and (changed or (known is None and (helper._can_compile or helper.stats.cache_hits))):
        helper.recompile()
