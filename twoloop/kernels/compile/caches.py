"""Cache machine code on disk: choose folders, detect files that are out of date, and check who can write files.

Numba's own cache has three shortcomings. It recompiles a function when the file that defines it changes, but not when
globals change, whose values are part of the machine code, nor when called functions in other files change. It raises an
error if no folder can be written, or if a file is damaged. And it runs code that other users have put into its folder.

Here each function and key (such as a signature) has its own file with a checksum. Code is loaded only from files and
folders that belong to the user or root, and that no other user can write: whoever can write a file of machine code can
run any code in the name of the user who loads it. A checksum does not prevent this, as the attacker can write it, too.
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

from twoloop.kernels.compile.dependencies import Digest, NotDigestible, closure_values, reachable_names
from twoloop.kernels.compile.linking import discard_compiled_code, jitable_templates

ADVICE = (
    "Code is loaded only from what belongs to you or root and no other user can write: take that right away (chmod "
    "go-w) or set NUMBA_CACHE_DIR to a folder of your own in folders that others cannot write"
)


class UntrustedFile(OSError):
    """Error: another user could have written this file; the message says why."""


def read_trusted(path: Path) -> bytes:
    """Return the content of a file in a folder from `trusted_folder`; raise OSError if the file cannot be read.

    If another user could have written the file, print a warning and raise UntrustedFile.
    """
    with path.open("rb") as file:
        if reason := _reason_of_mode(os.fstat(file.fileno())):
            _warn_first(f"twoloop: {path} {reason}, and is not loaded but compiled again. {ADVICE}")
            raise UntrustedFile(f"{path} {reason}")
        return file.read()


def replace_trusted(path: Path, content: bytes) -> None:
    """Write a new file, which only the user can write, and let it replace the file `path` in one operation."""
    make_trusted_folder(path.parent)
    unfinished = path.with_suffix(f".{uuid.uuid4().hex}")
    try:
        with open(os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644), "wb") as file:
            file.write(content)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def make_trusted_folder(folder: Path) -> None:
    """Create a folder, and missing folders above it, that only the user can write."""
    for each in [*reversed(folder.parents), folder]:
        if not each.exists():
            each.mkdir(0o755, exist_ok=True)


@cache
def trusted_folder(folder: Path) -> Path:
    """Return `folder` if no other user can write to it or to a folder above it; otherwise, return a replacement.

    The replacement is in the user's cache folder; if others can write to that, too, it is in a temporary folder.
    """
    reason = reason_to_distrust(folder)
    if not reason:
        return folder
    subfolder = f"{folder.name}_{hashlib.sha256(str(folder).encode()).hexdigest()[:16]}"
    replacement = Path(AppDirs(appname="twoloop", appauthor=False).user_cache_dir) / "code" / subfolder
    if reason_to_distrust(replacement):
        replacement = Path(_temporary_folder().name) / subfolder
    _warn_first(f"twoloop: no code is loaded from {folder}: {reason}. It is kept in {replacement} instead. {ADVICE}")
    return replacement


def reason_to_distrust(folder: Path) -> str:
    """Return a reason if another user may be able to write to a folder or to a folder above it; otherwise return ""."""
    if os.name != "posix":  # on Windows, the mode does not contain the access rights
        return ""
    real_path = Path(os.path.realpath(folder))
    for each in [real_path, *real_path.parents]:
        try:
            status = each.stat()
        except FileNotFoundError:  # the folder does not exist yet
            continue
        except OSError as error:
            return f"{each} cannot be examined ({error.strerror})"
        # anybody can create files in a sticky folder (/tmp), but only the folder's or file's owner can replace a file
        is_sticky = each != real_path and status.st_mode & stat.S_ISVTX
        reason = _reason_of_owner(status) if is_sticky else _reason_of_mode(status)
        if reason:
            return f"{each} {reason}"
    return ""


def _reason_of_mode(status: os.stat_result) -> str:
    """Return why another user can write a file or folder, given its status; "" if no other user can."""
    if os.name != "posix":
        return ""
    if reason := _reason_of_owner(status):
        return reason
    if status.st_mode & stat.S_IWOTH:
        return f"can be written by everybody (mode {stat.S_IMODE(status.st_mode):o})"
    if status.st_mode & stat.S_IWGRP and not _is_private_group(status.st_gid):
        return f"can be written by group {status.st_gid} (mode {stat.S_IMODE(status.st_mode):o})"
    return ""


def _reason_of_owner(status: os.stat_result) -> str:
    """Return "belongs to user N" if another user N owns a file or folder; "" if the user or root owns it."""
    return "" if status.st_uid in (0, os.geteuid()) else f"belongs to user {status.st_uid}"


@cache
def _is_private_group(gid: int) -> bool:
    """Return True if a group is root's or the user's own group, and has no members except root and the user."""
    import grp  # not available on Windows
    import pwd

    try:
        user, group = pwd.getpwuid(os.geteuid()), grp.getgrgid(gid)
    except KeyError:  # the system has no entry for the user or the group, which happens in containers
        return False
    is_own = gid == 0 or (gid == user.pw_gid and group.gr_name == user.pw_name)
    return is_own and set(group.gr_mem) <= {"root", user.pw_name}


@cache
def _temporary_folder() -> tempfile.TemporaryDirectory[str]:
    """Create a temporary folder at the first call; return it at every call. It is removed when the process ends."""
    return tempfile.TemporaryDirectory(prefix="twoloop-")


_warnings: list[str] = []  # the warning that `_warn_first` has printed; empty if none


def _warn_first(text: str) -> None:
    """Warn on stderr about code that other users can write; only the first call in a process prints its text."""
    if not _warnings:
        _warnings.append(text)
        print(text, file=sys.stderr, flush=True)


MAX_ON_DISK = 500  # a CodeFiles object with `is_limited` keeps at most this many files; it removes the oldest
CHECKSUM_SIZE = hashlib.sha256().digest_size  # length (bytes) of the checksum at the beginning of a file


class CodeFiles:
    """Store the machine code of a function on disk: for each key, such as a signature, one file with a checksum.

    Only the user can write these files. A file counts as missing if it is damaged or out of date: written with another
    `stamp` or version of numba. There is no index file like numba's, which several processes may damage.
    """

    def __init__(self, folder: Path, name: str, stamp: Any, is_limited: bool = False):
        self.folder, self.name, self.is_limited = folder, name, is_limited
        self.origin = numba.__version__, stamp

    def save(self, key: Any, data: Any) -> None:
        """Write the data for a key to a file, which replaces the previous file for this key."""
        content = pickle.dumps((repr((*self.origin, key)), dumps(data)))
        replace_trusted(self._path_for_key(key), hashlib.sha256(content).digest() + content)
        if self.is_limited:
            for old in sorted(self._paths_of_files(), key=_time_written)[:-MAX_ON_DISK]:
                old.unlink(missing_ok=True)

    def has_file(self, key: Any) -> bool:
        """Return True if there is a file for a key, even if it is damaged or out of date."""
        return self._path_for_key(key).exists()

    def load(self, key: Any) -> Any:
        """Return the data for a key, or None if the file is missing, damaged or out of date."""
        try:
            content = read_trusted(self._path_for_key(key))
        except OSError:
            return None
        if hashlib.sha256(content[CHECKSUM_SIZE:]).digest() != content[:CHECKSUM_SIZE]:
            return None
        origin, data = pickle.loads(content[CHECKSUM_SIZE:])
        return pickle.loads(data) if origin == repr((*self.origin, key)) else None

    def flush(self) -> None:
        """Remove all files of the function, for all keys (such as signatures)."""
        for path in self._paths_of_files():
            path.unlink(missing_ok=True)

    def _paths_of_files(self) -> list[Path]:
        return list(self.folder.glob(f"{glob.escape(self.name)}.*.nbc"))

    def _path_for_key(self, key: Any) -> Path:
        return self.folder / f"{self.name}.{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.nbc"


def _time_written(path: Path) -> float:
    """Return the time (s) at which a file was written; 0 if another process has removed the file."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


UNWRITABLE_CACHE_WARNING = (
    "twoloop: machine code cannot be kept on disk, so every process compiles again. Set NUMBA_CACHE_DIR to a folder "
    "that only you can write"
)
MAX_IN_MEMORY = 50  # largest number of entries of a BoundedCache
# numba's class that chooses subfolders of the folder NUMBA_CACHE_DIR; its name is private in numba 0.61
_LOCATOR: Any = vars(caching).get("UserProvidedCacheLocator") or vars(caching)["_UserProvidedCacheLocator"]


def compile_cached(
    function: Callable[..., Any],
    signature: Any,
    digests: tuple[str, str] | None,
    *,
    announcement: str = "",
    **options: Any,
) -> Dispatcher:
    """Compile a function for one signature, or read its machine code from the disk; return numba's dispatcher.

    digests : two digests of everything on which the machine code depends, see `digests_of`. A file with another first
        digest is out of date. The second one, of closure variables, is part of the name of the file, because functions
        with the same source may have different closure variables. None: no machine code is stored on disk.
    announcement : text to print on stderr if the function must be compiled; each text is printed once in a process.
    **options : options of numba.njit.
    """
    dispatcher = njit(**options)(give_unique_name(function, digests))
    function = dispatcher.py_func
    if digests is not None:
        try:
            dispatcher._cache = _CodeCache(function, *digests, announcement)
        except RuntimeError:  # no folder can be written, or the function has no file, as it was typed at a prompt
            if Path(inspect.getfile(function)).exists():
                warn_once(UNWRITABLE_CACHE_WARNING)
    with garbage_collection_off():
        dispatcher.compile(signature)
    dispatcher.disable_compile()
    _N_COMPILED[0] += 1
    return dispatcher


@contextmanager
def garbage_collection_off() -> Iterator[None]:
    """Return a context without garbage collection, which takes a sixth of the compile time and frees nothing."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


class BoundedCache(dict[Any, Any]):
    """Dictionary that keeps only the newest MAX_IN_MEMORY entries, so that it does not grow with each run."""

    def __setitem__(self, key: Any, value: Any) -> None:
        super().__setitem__(key, value)
        for old in list(self)[:-MAX_IN_MEMORY]:
            self.pop(old, None)


_N_COMPILED = [0]  # number of calls of `compile_cached`


def n_compiled() -> int:
    """Return the number of functions that `compile_cached` has compiled or read from the disk in this process."""
    return _N_COMPILED[0]


def cache_folder(package: types.ModuleType) -> Path | None:
    """Return the folder for machine code of the functions of a package, or None if no folder can be written."""

    def placeholder() -> None:
        pass

    code = placeholder.__code__.replace(co_filename=str(package.__file__))
    placeholder.__code__ = code
    try:
        return trusted_folder(Path(FunctionCache(placeholder).cache_path))
    except RuntimeError:
        return None


def give_unique_name(function: Callable[..., Any], digests: tuple[str, str] | None) -> Callable[..., Any]:
    """Return a copy of a nested function or lambda, with a unique name; return any other function itself.

    Numba names code by the qualified name and a counter: closures compiled by two processes may get the same name, and
    a process that loads both would run one code for both. If `digests` is None, no code is stored, and no copy is made.
    """
    if digests is None or "<" not in function.__qualname__:
        return function
    code = function.__code__
    copy = types.FunctionType(
        code, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    copy.__kwdefaults__, copy.__module__ = function.__kwdefaults__, function.__module__
    suffix = hashlib.sha256(repr((digests, code.co_filename, code.co_firstlineno)).encode()).hexdigest()
    copy.__qualname__ = f"{function.__qualname__}.{suffix[:16]}"
    return copy


class _CodeCache(FunctionCache):
    """Numba's cache of a function, but with CodeFiles; `stamp` and `key` are the two digests of `compile_cached`."""

    def __init__(self, function: Callable[..., Any], stamp: str, key: str, announcement: str):
        cache_dir: str = numba.config.CACHE_DIR  # type: ignore[attr-defined]
        if cache_dir:  # create the folder first: numba might create a folder that other users can write
            with suppress(OSError):
                make_trusted_folder(Path(cache_dir, _LOCATOR.get_suitable_cache_subpath(inspect.getfile(function))))
        super().__init__(function)
        source_stamp = self._cache_file._source_stamp
        folder = trusted_folder(Path(self._cache_path))
        self._cache_path = str(folder)
        self._cache_file = CodeFiles(folder, self._impl.filename_base, (source_stamp, stamp))
        self._key, self._announcement = key, announcement

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        """Return the key of the file for a signature; it includes the processor and the digest of closure variables."""
        return sig, codegen.magic_tuple(), self._key

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the machine code for a signature, or None if it has to be compiled."""
        try:
            overload = super().load_overload(sig, target_context)
        except Exception:  # the file is from an incompatible installation: numba compiles again and overwrites it
            overload = None
        if overload is None and self._announcement:
            warn_once(self._announcement)
        return overload

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store machine code on disk; print a warning if this is impossible."""
        try:
            super().save_overload(sig, data)
        except OSError:
            warn_once(UNWRITABLE_CACHE_WARNING)


def sources_folder() -> Path:
    """Return the folder of generated code: `equations` in NUMBA_CACHE_DIR, or else in the user's cache folder.

    If other users can write this folder, return a replacement, see `trusted_folder`.
    """
    cache_dir: str = numba.config.CACHE_DIR  # type: ignore[attr-defined]
    folder = cache_dir or AppDirs(appname="twoloop", appauthor=False).user_cache_dir
    return trusted_folder(Path(folder) / "equations")


@cache
def warn_once(text: str) -> None:
    """Print a text on stderr, unless this process has already printed it."""
    print(text, file=sys.stderr, flush=True)


def compiled_when_called(**options: Any) -> Callable[[Callable[..., Any]], Dispatcher]:
    """Return a decorator like numba.njit(**options), but with twoloop's cache. The first call compiles the function."""

    def decorate(function: Callable[..., Any]) -> Dispatcher:
        digests = digests_of(function)
        dispatcher = njit(**options)(give_unique_name(function, digests))
        if digests is not None:
            # `_use_twoloop_cache` recompiles this function if a callback calls it and its digests differ from these
            _COMPILED_DIGESTS[dispatcher] = digests
            with suppress(RuntimeError):  # if no folder can be written, do not store machine code
                dispatcher._cache = _CodeCache(dispatcher.py_func, *digests, "")
        return dispatcher

    return decorate


def digests_of(function: Callable[..., Any]) -> tuple[str, str] | None:
    """Return two digests of all that a function's machine code depends on; replace numba's cache of functions it calls.

    The first digest covers code, defaults and globals of the function, and attributes of modules that it uses. The
    second digest covers its closure variables. Both also cover the values used by helpers, the compiled functions that
    the function calls. Twoloop's cache replaces numba's cache of the helpers. Return None if a value could change
    without a change of the digests.
    """
    digests, helpers = _digests_and_helpers(function)
    for each in helpers:
        _use_twoloop_cache(each)
    return digests


def _digests_and_helpers(function: Callable[..., Any]) -> tuple[tuple[str, str] | None, list[Any]]:
    """Return the result of `digests_of` for a function, and its helpers, each one after the helpers that it calls."""
    code, closure = Digest(), Digest()
    closure.names = reachable_names(function)  # if a closure variable is a module, hash its attributes with these names
    try:
        code.add_function(function, enclosed=False)
        closure.add(closure_values(function))
        digests = code.hash.hexdigest(), closure.hash.hexdigest()
    except NotDigestible:
        digests = None
    return digests, [*code.helpers, *closure.helpers]


def helper(function: Callable[..., Any]) -> Any:
    """Compile a function that compiled callbacks call, like numba's `njit`, but with twoloop's cache.

    The function must not create arrays: references to arrays are not counted, as this would take longer than the
    computation of a row of C_q.
    """
    options: dict[str, Any] = {"_nrt": False, "error_model": "numpy"}
    dispatcher = njit(**options)(function)
    dispatcher.enable_caching()
    _use_twoloop_cache(dispatcher)
    return dispatcher


# keys: compiled functions that callbacks call; values: their digests when they were compiled
_COMPILED_DIGESTS: WeakKeyDictionary[Any, tuple[str, str]] = WeakKeyDictionary()


def _use_twoloop_cache(helper: Any) -> None:
    """Replace numba's cache of a helper by twoloop's cache, and recompile the helper if its digests have changed.

    Numba's cache ignores changes of functions in other files that the helper calls. So numba may have loaded outdated
    code, which callbacks compiled later would contain.
    """
    digests, compiled = _digests_and_helpers(getattr(helper, "py_func", helper))[0], _COMPILED_DIGESTS.get(helper)
    has_changed = compiled is not None and compiled != digests
    if digests is not None:
        _COMPILED_DIGESTS[helper] = digests
    if jitable_templates(helper):
        if has_changed or compiled is None:
            discard_compiled_code(helper)
        return
    if isinstance(helper._cache, FunctionCache) and (has_changed or not isinstance(helper._cache, _CodeCache)):
        try:
            helper._cache = NullCache() if digests is None else _CodeCache(helper.py_func, *digests, "")
        except RuntimeError:
            helper._cache = NullCache()
    if helper.overloads and (has_changed or (compiled is None and (helper._can_compile or helper.stats.cache_hits))):
        helper.recompile()
