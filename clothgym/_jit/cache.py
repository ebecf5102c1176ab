"""The folder of compiled kernels: its name, the locks that guard it, and whom it trusts.

* Its name is a digest of all sources that a kernel may hold something of: numba's own cache does not notice an edit in a callee
  that lies in another file; this name does.  Kernels of the core have a folder of their own, named by the core's sources alone:
  imports only go down, so who edits a task need not compile the main loop again.
* A file lock for each kernel while it is compiled: processes that start together on a cold cache compile each one once, and
  different ones at the same time.
* Its entries are unpickled and run.  It must therefore be the user's own and closed to others, and each entry begins with a
  checksum that only this user can make: damaged or foreign entries are compiled again.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import hmac
import importlib.util
import os
import stat
import sys
from collections.abc import Iterator, Mapping, Set
from pathlib import Path
from typing import Any

import numba

from clothgym.folders import CACHE, named
from clothgym.warning import warn_caller

# modules and folders without kernels, from which none below them takes a constant: who edits them need not compile
WITHOUT_KERNELS = {"__main__", "adapters", "cli", "playground"}
# modules and folders above the core, which imports none of them
ABOVE_CORE = {*WITHOUT_KERNELS, "envs", "lab", "policies", "render", "starts"}
CHECKSUM = 32  # bytes of a checksum, and of its key
NOWHERE = Path(os.devnull) / "none"


@functools.cache
def package_folders() -> dict[str, Path]:
    """Folders of the package.  In a checkout ``clothgym.envs`` has a folder next to it, in a wheel one in it."""
    folders = {"clothgym": Path(__file__).parents[1]}
    envs = importlib.util.find_spec("clothgym.envs")  # found, not imported
    if envs is not None and envs.submodule_search_locations:
        folders["clothgym.envs"] = Path(envs.submodule_search_locations[0])
    return folders


def kernel_sources(folders: Mapping[str, Path], without: Set[str] = WITHOUT_KERNELS) -> dict[str, bytes]:
    """Texts of all modules that kernels may hold something of, be it a constant.

    folders: by the name of the package that lies in each.  without: modules and folders in them that are left out.
    """
    sources = {}
    for package, folder in folders.items():
        for path in folder.rglob("*.py"):
            inside = path.relative_to(folder)
            if inside.parts[0].removesuffix(".py") not in without:
                sources[f"{package.replace('.', '/')}/{inside.as_posix()}"] = path.read_bytes()
    return sources


def source_digest(folders: Mapping[str, Path], without: Set[str] = WITHOUT_KERNELS) -> str:
    """Digest of these sources, each with its name, of numba's version and of Python's."""
    digest = hashlib.sha256(f"{numba.__version__} {sys.version_info[:2]}".encode())
    for name, text in sorted(kernel_sources(folders, without).items()):
        digest.update(f"{name} {len(text)}\n".encode() + text)
    return digest.hexdigest()[:16]


def name_of(function: Any) -> str:
    """Name of a kernel's files in the cache: a digest of its module and qualified name."""
    return hashlib.sha256(f"{function.__module__}.{function.__qualname__}".encode()).hexdigest()[:16]


def _default_root() -> Path:
    if own := named(CACHE):
        return own
    if numba_s := named("NUMBA_CACHE_DIR"):
        return numba_s / "clothgym"
    if sys.platform == "win32":
        return (named("LOCALAPPDATA") or Path.home()) / "clothgym" / "kernels"
    return (named("XDG_CACHE_HOME") or Path.home() / ".cache") / "clothgym" / "kernels"


class CacheFolder:
    """The folder of compiled kernels, found once, with the locks that guard it and the key of its checksums.

    path: where kernels are, or a place that cannot be; core: where those of the core are.  writable: whether new ones are kept.
    """

    def __init__(self) -> None:
        # locks of kernels that this process compiles now, a caller before its callees: bare descriptors.  Guarded by numba's own
        # compiler lock.  Processes cannot wait for each other in a ring, as no kernel calls itself by way of others
        self.held: dict[str, int] = {}
        self.compiled, self._counting = 0, False
        self.writable = True
        self.path = self.core = NOWHERE
        self._key = b""
        root = NOWHERE
        try:
            root = _default_root()
            packages = package_folders()
            path = root / source_digest(packages)
            core = root / source_digest({"clothgym": packages["clothgym"]}, ABOVE_CORE)
            for folder in (root, path, core):
                folder.mkdir(mode=0o700, parents=True, exist_ok=True)
                _refuse_others(folder, stat.S_IWGRP | stat.S_IWOTH, "chmod go-w")
            self._key = _key_of(root / "key")
            self.path, self.core = path, core
            for folder in (path, core):
                os.close(os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o600))
        except (OSError, RuntimeError) as error:  # RuntimeError: no home folder
            self.give_up(error, root)

    def give_up(self, error: Exception, root: Path | None = None) -> None:
        """Go on without writing to the folder, and say so once."""
        if self.writable:
            self.writable = False
            warn_caller(
                f"clothgym cannot use its kernel cache {str(root or self.path.parent)!r} ({error}): kernels that it lacks are "
                "compiled again in each process, for a minute or two. Set CLOTHGYM_CACHE_DIR to a folder of your own that can "
                "be written."
            )

    def read(self, path: Path) -> memoryview | None:
        """What ``write`` has written there; None where nothing is, or nothing that this user's processes have written.

        Raises:
            OSError: something is there that cannot be read.
        """
        try:
            entry = memoryview(path.read_bytes())
        except FileNotFoundError:
            return None
        content = entry[CHECKSUM:]
        return content if hmac.compare_digest(entry[:CHECKSUM], self._checksum(path, content)) else None

    def write(self, path: Path, content: bytes) -> None:
        """Write an entry, whole or not at all.

        Raises:
            OSError: the folder has vanished, cannot be written, or is full.
        """
        part = path.with_name(f"{path.name}.{os.urandom(8).hex()}.part")
        try:
            with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
                file.write(self._checksum(path, content))
                file.write(content)
            part.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                part.unlink()
            raise

    def _checksum(self, path: Path, content: bytes | memoryview) -> bytes:
        """Of an entry and its name, so that none passes for another."""
        code = hmac.new(self._key, f"{path.parent.name}/{path.name}\0".encode(), "sha256")
        code.update(content)
        return code.digest()

    def folder_of(self, module: str) -> Path:
        """Where the kernels of a module are."""
        package, _, inside = module.partition(".")
        return self.core if package == "clothgym" and inside.partition(".")[0] not in ABOVE_CORE else self.path

    def acquire(self, name: str, folder: Path) -> None:
        """Wait until no other process compiles the kernel of that name into that folder."""
        try:
            file = os.open(folder / f"{name}.lock", os.O_RDWR | os.O_CREAT, 0o600)
            _lock_file(file)
            self.held[name] = file
        except OSError as error:  # the folder has vanished, or its file system has no locks
            self.give_up(error)

    @contextlib.contextmanager
    def only_one(self, name: str) -> Iterator[bool]:
        """Whether no other process is in such a block with that name."""
        if not self.writable:
            yield False
            return
        file = os.open(self.core / f"{name}.lock", os.O_RDWR | os.O_CREAT, 0o600)
        try:
            yield _try_lock(file)
        finally:
            os.close(file)  # which gives the lock back

    def release(self, name: str) -> None:
        file = self.held.pop(name, None)
        if file is not None:
            _unlock_file(file)
            os.close(file)

    def announce(self, most: int) -> None:
        """Say that one more kernel is being compiled, of ``most`` at most: in a terminal each time, else once."""
        self.compiled += 1
        if self.compiled == 1:
            where = f", kept in {self.path.parent}" if self.writable else ""
            print(
                f"clothgym: compiling kernels, {most} at most (once after an install or a change, about a minute){where}",
                file=sys.stderr,
                flush=True,
            )
        if sys.stderr.isatty():
            self._counting = True
            print(f"\rclothgym: compiling {self.compiled} of {max(most, self.compiled)} ", end="", file=sys.stderr, flush=True)

    def end_line(self) -> None:
        """End the line that a terminal shows while kernels are compiled."""
        if self._counting:
            self._counting = False
            print("\r" + 40 * " " + "\r", end="", file=sys.stderr, flush=True)


def _refuse_others(place: Path | int, rights: int, remedy: str) -> None:
    """See that a file or folder is the user's own, and that others have none of these rights.

    Raises:
        PermissionError: it is not; the message tells why.
    """
    if sys.platform == "win32":
        return
    found = os.stat(place)
    if found.st_uid != os.geteuid():
        raise PermissionError(f"it belongs to user {found.st_uid}, who could put code of theirs in it, and not to you")
    if found.st_mode & rights:
        raise PermissionError(f"other users could put code of theirs in it; make it yours alone by {remedy}")


def _key_of(path: Path) -> bytes:
    """The key of this user's checksums: random, made by the first process that needs it.

    Raises:
        OSError: it cannot be read or made, or others can read it.
    """
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    except OSError:  # a folder that can be read only
        file = os.open(path, os.O_RDONLY)
    try:
        _lock_file(file)
        _refuse_others(file, stat.S_IRWXG | stat.S_IRWXO, f"chmod 600 {path}")
        key = os.read(file, CHECKSUM + 1)
        os.lseek(file, 0, os.SEEK_SET)
        if len(key) != CHECKSUM:  # it is new, or was cut short
            key = os.urandom(CHECKSUM)
            os.ftruncate(file, 0)
            os.write(file, key)
        return key
    finally:
        os.close(file)  # and with it goes the lock


if sys.platform == "win32":
    import msvcrt

    def _lock_file(file: int) -> None:
        while True:
            with contextlib.suppress(OSError):  # LK_LOCK gives up after ten seconds; a compilation may take longer
                msvcrt.locking(file, msvcrt.LK_LOCK, 1)
                return

    def _try_lock(file: int) -> bool:
        try:
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True

    def _unlock_file(file: int) -> None:
        msvcrt.locking(file, msvcrt.LK_UNLCK, 1)
else:
    import fcntl

    def _lock_file(file: int) -> None:
        fcntl.flock(file, fcntl.LOCK_EX)

    def _try_lock(file: int) -> bool:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return False
        return True

    def _unlock_file(file: int) -> None:
        fcntl.flock(file, fcntl.LOCK_UN)


_folder: CacheFolder | None = None


def cache_folder() -> CacheFolder:
    """This process's."""
    global _folder
    if _folder is None:
        _folder = CacheFolder()
    return _folder


def _forget_folder() -> None:
    """After a fork the child holds no locks: it looks for the folder itself."""
    global _folder
    _folder = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_folder)
