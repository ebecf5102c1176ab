"""Floor 0: how every kernel is compiled, cached and run on several threads.

One policy for the whole project, so that the promises made about bits and about start-up are kept in one place:

* plain IEEE arithmetic (no fast-math): an environment's bits do not depend on who else is in its batch;
* compiled code is kept on disk in a folder whose name is a digest of the core's sources.  numba's own cache does not
  notice an edit in a callee that lives in another file; this key does;
* a file lock for each kernel while it is compiled: processes that start together on a cold cache compile each one once, and
  different ones at the same time;
* threads are plain Python threads running kernels that do not hold the GIL.  Unlike numba's threading layers they may be
  used from several threads at once, survive a fork, and cost no parallel compilation.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from operator import attrgetter
from pathlib import Path
from types import FunctionType
from typing import Any, cast

import numba
from llvmlite import binding as llvm
from numba.core import caching
from numba.core.compiler_lock import global_compiler_lock
from numba.core.runtime import rtsys

OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": False, "nogil": True, "boundscheck": False}

# before it loads a function numba fills its tables of typing and lowering, which takes longer than all of our loading; a
# function that is compiled already needs its runtime only.  Versions with which this was tested:
LOADS_WITHOUT_TABLES = {(0, 68)}


def _source_digest() -> str:
    """Digest of all core sources that hold kernels, of numba's version and of Python's."""
    digest = hashlib.sha256(f"{numba.__version__} {sys.version_info[:2]}".encode())
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        text = path.read_bytes()
        if b"kernel" in text:
            digest.update(path.name.encode() + text)
    return digest.hexdigest()[:16]


def _default_root() -> Path:
    if os.environ.get("CLOTHGYM_CACHE_DIR"):
        return Path(os.environ["CLOTHGYM_CACHE_DIR"])
    if os.environ.get("NUMBA_CACHE_DIR"):
        return Path(os.environ["NUMBA_CACHE_DIR"]) / "clothgym"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home())) / "clothgym" / "kernels"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "clothgym" / "kernels"


class _CacheFolder:
    """The folder of compiled kernels, found once, with the locks that guard it."""

    def __init__(self) -> None:
        # locks of kernels that this process compiles now, a caller before its callees: bare descriptors.  Guarded by numba's own
        # compiler lock.  Processes cannot wait for each other in a ring, as no kernel calls itself by way of others
        self.held: dict[str, int] = {}
        self._announced = False
        self.writable = True
        self.path = Path(os.devnull) / "none"
        try:
            self.path = _default_root() / _source_digest()
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
            file = os.open(self.path / f"{hashlib.sha256(name.encode()).hexdigest()[:16]}.lock", os.O_RDWR | os.O_CREAT)
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


_folder: _CacheFolder | None = None


def cache_folder() -> _CacheFolder:
    global _folder
    if _folder is None:
        _folder = _CacheFolder()
    return _folder


class _Locator(caching._SourceFileBackedLocatorMixin, caching._CacheLocator):  # type: ignore[misc]
    """Tells numba's cache to use our folder; the stamp is the kernel's own file, the folder's name covers its callees."""

    def __init__(self, py_func: FunctionType, py_file: str) -> None:
        self._py_file = py_file
        self._lineno = py_func.__code__.co_firstlineno

    def get_cache_path(self) -> str:
        return str(cache_folder().path)

    def ensure_cache_path(self) -> None:
        pass


_code_of = attrgetter("library")  # the machine code of one of numba's compile results, with what is linked to it


class _Outdated(Exception):
    """Compiled code calls code that is no longer there."""


class _Impl(caching.CompileResultCacheImpl):  # type: ignore[misc]
    """What is kept of compiled code: also which kernels that stay apart it calls, ``(name, argument types, symbol)`` each."""

    _locator_classes = [_Locator]  # noqa: RUF012 - numba reads a list

    def reduce(self, result: Any) -> Any:
        return _calls_of(_code_of(result)), super().reduce(result)

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        calls, payload = payload
        # they must be there before the code is, in which their symbols are looked up
        called = []
        for name, types, symbol in calls:
            if name not in _dispatchers:  # a module has another name in the process that runs it than in one that imports it
                raise _Outdated
            _dispatchers[name].compile(types)
            called.append(_dispatchers[name].overloads[types])
            if called[-1].fndesc.mangled_name != symbol:
                raise _Outdated
        result = super().rebuild(target_context, payload)
        code = _code_of(result)
        # what is called lives as long as its caller
        code.calls, code.called = calls, called
        return result


def _calls_of(library: Any) -> list[tuple[str, Any, str]]:
    """Kernels that stay apart which a library calls, itself or in what is linked into it."""
    if not hasattr(library, "calls"):
        library.calls = list(dict.fromkeys(call for part in library._linking_libraries for call in _asks(part)))
    return library.calls


def _asks(library: Any) -> list[tuple[str, Any, str]]:
    """What must be there for a call of a library."""
    return [library.stays_apart] if hasattr(library, "stays_apart") else _calls_of(library)


# all kernels by name, for compiled code that calls them
_dispatchers: dict[str, Any] = {}


class _Cache(caching.FunctionCache):  # type: ignore[misc]
    """numba's disk cache with locks: on a miss it waits for other processes, looks again, and keeps the kernel's lock."""

    _impl_class = _Impl

    def __init__(self, py_func: FunctionType, apart: bool) -> None:
        super().__init__(py_func)
        self.lock_name = f"{py_func.__module__}.{py_func.__qualname__}"
        self.apart = apart

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        folder = cache_folder()
        found = self._load(sig, target_context)
        if found is None and folder.writable and self.lock_name not in folder.held:
            folder.acquire(self.lock_name)
            found = self._load(sig, target_context)
        if found is None:
            target_context.refresh()
            folder.announce()
        return found

    def _load(self, sig: Any, target_context: Any) -> Any:
        if not cache_folder().path.is_dir():
            return None
        if numba.version_info.short in LOADS_WITHOUT_TABLES:
            rtsys.initialize(target_context)
        else:
            target_context.refresh()
        try:
            found = self._load_overload(sig, target_context)
        except (OSError, EOFError, pickle.UnpicklingError, _Outdated):  # a file cut short, by a full disk for instance
            return None
        if found is not None:
            self._set_apart(found)
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        folder = cache_folder()
        if folder.writable:
            try:
                try:
                    super().save_overload(sig, data)
                except (EOFError, pickle.UnpicklingError):  # the index has been cut short: begin it anew
                    self.flush()
                    super().save_overload(sig, data)
            except OSError as error:
                folder.give_up(error)
        self._set_apart(data)

    def _set_apart(self, result: Any) -> None:
        """Give callers nothing to link but the symbol, if the kernel is to stay apart."""
        if self.apart:
            code = _code_of(result)
            code.stays_apart = self.lock_name, result.signature.args, result.fndesc.mangled_name
            code._shared_module = llvm.parse_assembly(str(code._codegen._create_empty_module("apart")))


def kernel(function: Callable[..., Any], apart: bool = False, flags: Callable[[Any], Any] | None = None) -> Any:
    """Compile ``function`` by the project's policy, at its first call, through the locked cache.

    Kernels take arrays and typed scalars only; they must not reduce across lanes (see ``docs/architecture.md``).

    apart: compile it once for all its callers, who jump to it.  Of others numba links the code into each kernel above them, and
    optimises it anew there: right for what is short, and minutes in all for what is long and has many callers.
    flags: changes the compiler's, see ``disjoint``.
    """
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        return function
    dispatcher = numba.njit(**OPTIONS)(function)
    dispatcher.flags = dispatcher._compiler._customize_flags = flags or _counted
    try:
        dispatcher._cache = _Cache(cast(FunctionType, function), apart)
    except RuntimeError:  # it has been typed in, and lies in no file: it is compiled in memory, and linked into its callers
        return dispatcher
    _dispatchers[dispatcher._cache.lock_name] = dispatcher
    compile_or_load = dispatcher.compile

    def compile_locked(signature: Any) -> Any:
        with global_compiler_lock:  # numba's own, taken before we look whether this thread holds the file's
            name = dispatcher._cache.lock_name
            held = name in cache_folder().held
            try:
                return compile_or_load(signature)
            finally:
                if not held:
                    cache_folder().release(name)

    dispatcher.compile = compile_locked
    return dispatcher


# the compiler's flags of each sort of kernel.  All are set: what is not set is taken from whichever kernel is compiled above


def _counted(flags: Any) -> Any:
    flags.nrt, flags.noalias = True, False
    return flags


def _uncounted(flags: Any) -> Any:
    flags.nrt, flags.noalias = False, False
    return flags


def _disjoint(flags: Any) -> Any:
    flags.nrt, flags.noalias = False, True
    return flags


def uncounted(function: Callable[..., Any]) -> Any:
    """An ``apart`` kernel that makes no arrays, and so does not count references to any.

    A count is an atomic addition for each array that is taken from a tuple or sliced: many of them take longer than a small
    sheet's forces.  It must not call counted kernels that return arrays, nor return any: ``inlined`` ones may.
    """
    return kernel(function, apart=True, flags=_uncounted)


def disjoint(function: Callable[..., Any]) -> Any:
    """A ``kernel`` of loops over long rows that makes no arrays, and promises that what it writes to overlaps none of its others.

    Else the compiler tests every pair of rows for overlap whenever the kernel is called: as long as a row of a hundred takes.
    """
    return kernel(function, flags=_disjoint)


def inlined(function: Callable[..., Any]) -> Any:
    """A part of the kernels that call it, by the same policy: for a long one with one caller, and for the shortest.

    It is compiled there alone.  A kernel's code is optimised anew in each kernel above it, so a chain of long ones with one caller
    each would be optimised as often as it is long.
    """
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        return function
    return numba.njit(inline="always", **OPTIONS)(function)


def apart(function: Callable[..., Any]) -> Any:
    """A ``kernel`` that is compiled once for all its callers."""
    return kernel(function, apart=True)


def specialize(function: Any, name: str, apart: bool = False, **callees: Any) -> Any:
    """A ``kernel`` with the code of ``function`` in which the global names ``callees`` stand for the given kernels.

    This is how one substep loop serves every integrator: numba's disk cache misses in each new process when a dispatcher
    is an argument or a closure variable, and hits when it is a global.  ``name`` keeps the cache entries apart, with a digest
    of the source of callees from outside this package, which the folder's name does not cover.  A ``function`` that is a kernel
    already is made as it is.
    """
    flags, function = getattr(function, "flags", None), getattr(function, "py_func", function)
    for callee in callees.values():
        path = Path(getattr(callee, "py_func", callee).__code__.co_filename)
        if Path(__file__).parent not in path.parents:
            name += "_" + hashlib.sha256(path.read_bytes() if path.is_file() else os.urandom(8)).hexdigest()[:12]
    code = function.__code__.replace(co_name=name, co_qualname=name)
    bound = FunctionType(code, {**function.__globals__, **callees}, name)
    bound.__qualname__ = name
    bound.__module__ = function.__module__
    return kernel(bound, apart, flags)


_pool: ThreadPoolExecutor | None = None
_pool_size = 0
_pool_guard = threading.Lock()


def _start_anew() -> None:
    """After a fork the child has no worker threads, and would share its parent's hold on the lock: it makes its own."""
    global _pool, _pool_size, _pool_guard, _folder
    _pool, _pool_size, _pool_guard, _folder = None, 0, threading.Lock(), None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_start_anew)


def default_threads() -> int:
    """Threads to use when the caller does not say: the processors this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _spans(count: int, parts: int) -> Iterator[tuple[int, int]]:
    for part in range(parts):
        yield count * part // parts, count * (part + 1) // parts


def run_spans(work: Callable[[int, int], None], count: int, threads: int) -> None:
    """Call ``work(first, last)`` over ``range(count)`` cut into at most ``threads`` spans, one of them on this thread.

    The spans share nothing, so the outcome does not depend on how many there are.
    """
    global _pool, _pool_size
    parts = min(threads, count)
    if parts <= 1:
        work(0, count)
        return
    with _pool_guard:
        if _pool is None or _pool_size < parts - 1:
            # an outgrown pool ends by itself when its last caller is done with it
            _pool, _pool_size = ThreadPoolExecutor(parts - 1, "clothgym"), parts - 1
        pool = _pool
    first, *rest = _spans(count, parts)
    futures = [pool.submit(work, *span) for span in rest]
    try:
        work(*first)
    finally:
        wait(futures)
    for future in futures:
        future.result()
