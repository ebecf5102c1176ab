"""Whom the folder of compiled kernels trusts: its user, and entries that only its user can have written."""

import hashlib
import hmac
import os
import pickle
import shutil
import stat
import sys

import pytest
from test_jit import ROOT, run

from clothgym._jit import cache
from clothgym._jit.cache import CacheFolder

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="owners and modes are POSIX")

MINE = """
import os
os.umask(0)
from clothgym._jit import apart, kernel
@apart
def double(x):
    return 2.0 * x
@kernel
def shifted(x):
    return double(x) + 1.0
print(shifted(3.0), sum((shifted.stats.cache_misses + double.stats.cache_misses).values()))
"""


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    """A module with two kernels, and a cache that has both.  It prints 2 * 3 + 1, and how many kernels it has compiled."""
    folder = tmp_path_factory.mktemp("mine")
    (folder / "mine.py").write_text(MINE)
    path, root = f"{folder}:{ROOT}", folder / "cache"
    assert run("import mine", PYTHONPATH=path, CLOTHGYM_CACHE_DIR=str(root))[0] == "7.0 2"
    return path, root


@pytest.fixture
def mine(filled, tmp_path):
    """A copy of that cache, and how to run the module with it."""
    path, root = filled[0], tmp_path / "cache"
    shutil.copytree(filled[1], root)

    def start(**environment):
        return run("import mine", PYTHONPATH=path, CLOTHGYM_CACHE_DIR=str(root), **environment)

    return root, start


def one_of_each(root, kernels):
    """A file of each kernel: the index of the first, and the code of the second."""
    paths = [path for kind, name in zip(("nbi", "nbc"), kernels) for path in root.rglob(f"*{name}*.{kind}")]
    assert len(paths) == 2
    return paths


CALLEE_FIRST, CALLER_FIRST = ("double", "shifted"), ("shifted", "double")


@pytest.mark.parametrize(
    ("place", "kernels"),
    [(0.0, CALLEE_FIRST), (0.01, CALLER_FIRST), (0.4, CALLEE_FIRST), (0.999, CALLER_FIRST), (None, CALLEE_FIRST)],
    ids=["checksum", "head", "middle", "end", "cut short"],
)
def test_a_flipped_bit_is_compiled_again(place, kernels, mine):
    """Whether it is in an index or in code: either kernel alone would be one that is compiled."""
    root, start = mine
    for path in one_of_each(root, kernels):
        content = bytearray(path.read_bytes())
        if place is None:
            del content[100:]
        else:
            content[max(int(place * len(content)), 33 if place else 0)] ^= 1
        path.write_bytes(content)
    out, err = start()
    assert out == "7.0 2" and err.count("\n") == 1 and "compiling kernels" in err
    assert start() == ("7.0 0", "")


class Planted:
    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


@pytest.mark.parametrize(
    ("checked", "kernels"), [(True, CALLEE_FIRST), (False, CALLER_FIRST)], ids=["with a checksum of another key", "bare"]
)
def test_foreign_cache_entries_are_not_unpickled(checked, kernels, mine, tmp_path):
    root, start = mine
    payload = pickle.dumps(Planted(tmp_path / "marker"))
    for path in one_of_each(root, kernels):
        code = hmac.digest(bytes(32), f"{path.parent.name}/{path.name}\0".encode() + payload, hashlib.sha256)
        path.write_bytes(code + payload if checked else payload)
    assert start()[0] == "7.0 2"
    assert not (tmp_path / "marker").exists()
    pickle.loads(payload)
    assert (tmp_path / "marker").exists(), "the payload does what it is planted for"


def test_one_entry_does_not_pass_for_another(mine):
    root, start = mine
    double, shifted = sorted(root.rglob("*.nbc"))
    assert "double" in double.name and "shifted" in shifted.name
    shifted.write_bytes(double.read_bytes())
    assert start()[0] == "7.0 1"


def test_a_folder_that_others_can_write_is_refused(mine):
    root, start = mine
    folders = [root, *(path for path in root.iterdir() if path.is_dir())]
    assert len(folders) == 3
    for folder in folders:
        folder.chmod(0o777)
        before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
        out, err = start()
        assert out == "7.0 2"
        assert err.count("UserWarning") == 1 and "other users" in err and "chmod go-w" in err and "CLOTHGYM_CACHE_DIR" in err
        assert before == {path: path.stat().st_mtime_ns for path in root.rglob("*")}
        folder.chmod(0o700)
    assert start() == ("7.0 0", "")


def test_a_folder_of_another_user_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("CLOTHGYM_CACHE_DIR", str(tmp_path))
    own = CacheFolder()
    assert own.writable and own.path.parent == tmp_path
    monkeypatch.setattr(cache.os, "geteuid", lambda: os.getuid() + 1)
    with pytest.warns(UserWarning, match=f"belongs to user {os.getuid()}"):
        refused = CacheFolder()
    assert not refused.writable and not refused.path.exists()


def test_a_key_that_others_can_read_is_refused_and_one_cut_short_is_made_again(mine):
    root, start = mine
    (root / "key").chmod(0o644)
    out, err = start()
    assert out == "7.0 2" and "chmod 600" in err
    (root / "key").chmod(0o600)
    (root / "key").write_bytes(b"short")
    assert start()[0] == "7.0 2"
    assert len((root / "key").read_bytes()) == 32
    assert start()[0] == "7.0 0"


def test_all_is_closed_to_others_and_nothing_can_be_run(mine):
    """The module sets the umask to none."""
    root, start = mine
    start(CLOTHGYM_PLAIN_NUMBA="1")
    folders = [path for path in root.rglob("*") if path.is_dir() and "plain" not in path.parent.parts]
    assert len(folders) == 3 and {stat.S_IMODE(path.stat().st_mode) for path in (root, *folders)} == {0o700}
    files = [path for path in root.rglob("*") if path.is_file() and "plain" not in path.parts]
    assert {path.suffix for path in files} == {"", ".lock", ".nbi", ".nbc"}
    assert {stat.S_IMODE(path.stat().st_mode) for path in files} == {0o600}


def test_a_cache_entry_is_complete_or_missing(tmp_path, monkeypatch):
    monkeypatch.setenv("CLOTHGYM_CACHE_DIR", str(tmp_path))
    folder = CacheFolder()
    entry = folder.path / "entry.nbc"
    folder.write(entry, b"first")
    monkeypatch.setattr(folder, "_checksum", lambda path, content: content.missing)
    with pytest.raises(AttributeError):
        folder.write(entry, b"second")
    monkeypatch.undo()
    assert folder.read(entry) == b"first"
    assert not list(folder.path.glob("*.part"))
