"""Code is loaded from what no other user can write, as ssh asks of keys; what others can write is compiled anew."""

import hashlib
import os
import pickle
import shutil
from pathlib import Path

import pytest

from tests.own_cache import RUN, Folder
from twoloop.kernels.compile import ownership
from twoloop.kernels.compile.ownership import doubt_of, make_own, own_folder, read_own, write_own

pytestmark = pytest.mark.skipif(os.name != "posix", reason="rights on other systems are not in the mode")


class Planted:
    """A pickle that makes a file when it is read."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.fixture(autouse=True)
def first_warning(monkeypatch):
    monkeypatch.setattr(ownership, "_said", [])
    own_folder.cache_clear()
    yield
    own_folder.cache_clear()


@pytest.fixture
def user(tmp_path):
    """Runs of a mechanism with caches of its own: its value, how often it was read, and what was said."""
    folder, home = Folder(tmp_path), tmp_path / "home"
    folder.mechanism(force="2.0 * q[0]")

    def run(umask=0o022):
        _, value, hits = folder.run(f"import os; os.umask({umask})\n{RUN}", XDG_CACHE_HOME=str(home)).split()
        return float(value), int(hits), folder.said

    run.cache, run.home, run.planted = folder.cache, home, tmp_path / "planted"
    run.file = lambda: next(folder.cache.glob("*/mechanism.force-*.nbc"))
    return run


def plant(path, mark):
    """What whoever can write a file does: other content, and the right checksum."""
    content = pickle.dumps(("", pickle.dumps(Planted(mark)), Planted(mark)))
    path.write_bytes(hashlib.sha256(content).digest() + content)


def test_what_others_can_write_is_not_loaded(user, monkeypatch):
    assert user(umask=0)[:2] == (2.0, 0)
    assert user.file().stat().st_mode & 0o022 == user.file().parent.stat().st_mode & 0o022 == 0
    plant(user.file(), user.planted)
    user.file().chmod(0o666)
    value, hits, said = user()
    assert (value, hits) == (2.0, 0) and not user.planted.exists()
    assert said.count("can be written by everybody (mode 666), and is not loaded but compiled again") == 1
    assert user() == (2.0, 1, "")  # repaired
    plant(user.file(), user.planted)
    user.cache.chmod(0o777)  # above the folder of the file
    monkeypatch.setenv("XDG_CACHE_HOME", str(user.home))
    for folder in set(user.cache.iterdir()) - {user.file().parent}:  # of the kernels, which would be compiled again
        shutil.copytree(folder, own_folder(folder))
    value, hits, said = user()
    assert (value, hits) == (2.0, 0) and not user.planted.exists()
    assert said.count("twoloop: no code is loaded from") == 1 and "set NUMBA_CACHE_DIR to a folder of your own" in said
    assert user()[:2] == (2.0, 1)  # from the folder of this user's caches


def test_generated_source_that_others_can_write_is_not_run(tmp_path, monkeypatch, capsys):
    generated = pytest.importorskip("twoloop.problem.generated")
    monkeypatch.setattr(generated, "sources_folder", lambda: tmp_path)
    code = generated.GeneratedCode("key", "def energy(t, q, v, p):\n    return 0.0\n")
    generated._write(tmp_path / "equations_key.py", f"{generated._head(code.source)}\n{code.source}")
    assert generated.GeneratedCode.stored("key") == code
    (tmp_path / "equations_key.py").chmod(0o646)
    assert generated.GeneratedCode.stored("key") is None
    assert "equations_key.py can be written by everybody" in capsys.readouterr().err


OTHER = 4242  # neither root nor us


def seen_as(monkeypatch, path, **changes):
    """Let a file or folder look as if it had another owner, group or mode."""
    real = os.stat

    def stat(where, *arguments, **options):
        found = real(where, *arguments, **options)
        if isinstance(where, (str, Path)) and Path(where) == path:
            values = list(found)[:10]
            for name, place in {"mode": 0, "uid": 4, "gid": 5}.items():
                values[place] = changes.get(name, values[place])
            found = os.stat_result(values)
        return found

    monkeypatch.setattr(os, "stat", stat)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({}, ""),
        ({"uid": 0}, ""),
        ({"uid": OTHER}, f"belongs to user {OTHER}"),
        ({"mode": 0o040777}, "can be written by everybody (mode 777)"),
        ({"mode": 0o040775, "gid": OTHER}, f"can be written by group {OTHER} (mode 775)"),
        ({"mode": 0o040755, "gid": OTHER}, ""),
    ],
)
@pytest.mark.parametrize("above", [False, True])
def test_whose_folders_are_in_doubt(tmp_path, monkeypatch, changes, why, above):
    folder = tmp_path / "above" / "folder"
    make_own(folder)
    at = folder.parent if above else folder
    seen_as(monkeypatch, at, **changes)
    assert doubt_of(folder) == (f"{at} {why}" if why else "") and (own_folder(folder) == folder) == (not why)


@pytest.mark.parametrize(
    ("name", "members", "primary", "private"),
    [("ann", [], True, True), ("ann", ["bob"], True, False), ("staff", [], True, False), ("ann", [], False, False)],
)
def test_the_group_of_one_user_alone_may_write(tmp_path, monkeypatch, name, members, primary, private):
    """Distributions with umask 0002 give each user such a group: it is never refused."""
    import grp
    import pwd

    gid = 5000
    entry = pwd.struct_passwd(("ann", "x", os.geteuid(), gid if primary else 100, "", "/", "/bin/sh"))
    monkeypatch.setattr(pwd, "getpwuid", lambda uid: entry)
    monkeypatch.setattr(grp, "getgrgid", lambda gid: grp.struct_group((name, "x", gid, members)))
    ownership._private.cache_clear()
    seen_as(monkeypatch, tmp_path, mode=0o040775, gid=gid)
    assert (doubt_of(tmp_path) == "") == private
    ownership._private.cache_clear()


def test_where_the_users_caches_are_in_doubt_too_code_ends_with_the_process(tmp_path, monkeypatch):
    make_own(tmp_path / "open")
    (tmp_path / "open").chmod(0o777)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "open"))
    folder = own_folder(tmp_path / "open" / "kept")
    assert tmp_path not in folder.parents and doubt_of(folder) == ""
    make_own(folder)
    write_own(folder / "file", b"content")
    assert read_own(folder / "file") == b"content"
