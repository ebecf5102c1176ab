"""The folder of compiled kernels: its name, and the locks that guard it.

* Its name is a digest of all sources that a kernel may hold something of: numba's own cache does not notice an edit in a callee
  that lies in another file; this name does.
* A file lock for each kernel while it is compiled: processes that start together on a cold cache compile each one once, and
  different ones at the same time.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.util
import os
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numba

# modules and folders without kernels, from which none below them takes a constant: who edits them need not compile
WITHOUT_KERNELS = {"__main__", "adapters", "cli", "playground"}


@functools.cache
def package_folders() -> dict[str, Path]:
    """Where the package lies.  In a checkout ``clothgym.envs`` has a folder beside it, in a wheel one in it."""
    folders = {"clothgym": Path(__file__).parents[1]}
    envs = importlib.util.find_spec("clothgym.envs")  # found, not imported
    if envs is not None and envs.submodule_search_locations:
        folders["clothgym.envs"] = Path(envs.submodule_search_locations[0])
    return folders


def kernel_sources(folders: Mapping[str, Path]) -> dict[str, bytes]:
    """Texts of all modules that kernels may hold something of, be it a constant.

    folders: by the name of the package that lies in each.
    """
    sources = {}
    for package, folder in folders.items():
        for path in folder.rglob("*.py"):
            inside = path.relative_to(folder)
            if inside.parts[0].removesuffix(".py") not in WITHOUT_KERNELS:
                sources[f"{package.replace('.', '/')}/{inside.as_posix()}"] = path.read_bytes()
    return sources


def source_digest(folders: Mapping[str, Path]) -> str:
    """Digest of these sources, each with its name, of numba's version and of Python's."""
    digest = hashlib.sha256(f"{numba.__version__} {sys.version_info[:2]}".encode())
    for name, text in sorted(kernel_sources(folders).items()):
        digest.update(f"{name} {len(text)}\n".encode() + text)
    return digest.hexdigest()[:16]


def name_of(function: Any) -> str:
    """A kernel's, as that of a file."""
    return hashlib.sha256(f"{function.__module__}.{function.__qualname__}".encode()).hexdigest()[:16]


def _default_root() -> Path:
    if os.environ.get("CLOTHGYM_CACHE_DIR"):
        return Path(os.environ["CLOTHGYM_CACHE_DIR"])
    if os.environ.get("NUMBA_CACHE_DIR"):
        return Path(os.environ["NUMBA_CACHE_DIR"]) / "clothgym"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home())) / "clothgym" / "kernels"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "clothgym" / "kernels"


class CacheFolder:
    """The folder of compiled kernels, found once, with the locks that guard it."""

    def __init__(self) -> None:
        # locks of kernels that this process compiles now, a caller before its callees: bare descriptors.  Guarded by numba's own
        # compiler lock.  Processes cannot wait for each other in a ring, as no kernel calls itself by way of others
        self.held: dict[str, int] = {}
        self._announced = False
        self.writable = True
        self.path = Path(os.devnull) / "none"
        try:
            self.path = _default_root() / source_digest(package_folders())
            self.path.mkdir(parents=True, exist_ok=True)
            os.close(os.open(self.path / "lock", os.O_RDWR | os.O_CREAT))
        except (OSError, RuntimeError) as error:  # RuntimeError: no home folder
            self.give_up(error)

    def give_up(self, error: Exception) -> None:
        """Go on without writing to the folder, and say so once."""
        if self.writable:
            self.writable = False
            warnings.warn(
                f"clothgym cannot write its kernel cache {str(self.path.parent)!r} ({error}): kernels that it lacks are compiled "
                "anew in each process, which takes some seconds. Set CLOTHGYM_CACHE_DIR to a folder that can be written.",
                stacklevel=2,
            )

    def acquire(self, name: str) -> None:
        """Wait until no other process compiles the kernel of that name."""
        try:
            file = os.open(self.path / f"{name}.lock", os.O_RDWR | os.O_CREAT)
            _lock_file(file)
            self.held[name] = file
        except OSError as error:  # the folder has vanished, or its file system has no locks
            self.give_up(error)

    def release(self, name: str) -> None:
        file = self.held.pop(name, None)
        if file is not None:
            _unlock_file(file)
            os.close(file)

    def announce(self) -> None:
        if not self._announced:
            self._announced = True
            where = f", kept in {self.path}" if self.writable else ""
            print(
                f"clothgym: compiling kernels (once after an install or a change, some seconds){where}", file=sys.stderr, flush=True
            )


if sys.platform == "win32":
    import msvcrt

    def _lock_file(file: int) -> None:
        while True:
            with contextlib.suppress(OSError):  # LK_LOCK gives up after ten seconds; a compilation may take longer
                msvcrt.locking(file, msvcrt.LK_LOCK, 1)
                return

    def _unlock_file(file: int) -> None:
        msvcrt.locking(file, msvcrt.LK_UNLCK, 1)
else:
    import fcntl

    def _lock_file(file: int) -> None:
        fcntl.flock(file, fcntl.LOCK_EX)

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
