"""All uses of private interfaces of numba and llvmlite: locks and checksums of its cache, separately compiled callees, flags.

``policy`` calls ``check`` first, and does not use this module if that raises.
"""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Mapping
from functools import partial
from operator import attrgetter
from pathlib import Path
from types import FunctionType
from typing import Any, cast

import numba
from llvmlite import binding as llvm
from numba.core import caching
from numba.core.codegen import CPUCodegen
from numba.core.compiler_lock import global_compiler_lock
from numba.core.runtime import rtsys

from clothgym._jit.cache import cache_folder, name_of

# versions with which the tests pass
TESTED = ((0, 66), (0, 67), (0, 68))
# before it loads a function numba fills its tables of typing and lowering, which takes longer than all of our loading; a
# function that is compiled already needs its runtime only.  Versions with which this was tested:
LOADS_WITHOUT_TABLES = {(0, 68)}


def check(tested_only: bool) -> None:
    """See that numba is as this module knows it.

    Raises:
        ImportError: it is of another version, and ``tested_only``.
        AttributeError, TypeError: something that is used below is no longer there, or no longer the same.
    """
    if tested_only and numba.version_info.short not in TESTED:
        raise ImportError(f"tested are {', '.join(f'{major}.{minor}' for major, minor in TESTED)}")
    attrgetter("save", "load", "_load_index", "_save_index", "_load_data", "_save_data", "_dump", "_data_path")(
        caching.IndexDataCacheFile
    )
    attrgetter("_load_overload", "load_overload", "save_overload")(caching.FunctionCache)
    attrgetter("reduce", "rebuild", "_locator_classes")(caching.CompileResultCacheImpl)
    attrgetter("get_source_stamp", "get_disambiguator")(caching._SourceFileBackedLocatorMixin)
    attrgetter("_create_empty_module")(CPUCodegen)
    attrgetter("initialize")(rtsys)
    dispatcher = numba.njit(_nothing)
    attrgetter("_compiler._customize_flags", "_cache", "compile", "overloads", "_insert", "typeof_pyval")(dispatcher)
    with contextlib.suppress(RuntimeError):  # imported from an archive, where nothing can be cached
        _Cache(cast(FunctionType, _nothing), apart=False)


def _nothing() -> None:
    """What ``check`` tries a cache with; never compiled."""


def arrange(function: FunctionType, apart: bool, flags: Mapping[str, bool], options: Mapping[str, Any]) -> Any:
    """A dispatcher with the compiler's flags and options and our cache; see ``policy.kernel``.

    numba makes two wrappers of each function, one to be called from Python and one from C.  Few kernels are called from Python, and
    arguments of dozens of arrays make wrappers that take longer to compile than the kernel.  So kernels have none; the first call
    from Python compiles one more version with a wrapper, which ``entry`` caches apart.
    """
    dispatcher, entry = numba.njit(**options)(function), numba.njit(**options)(function)
    try:
        dispatcher._cache = _Cache(function, apart)
        entry._cache = _Cache(function, apart=False, suffix=".entry")
    except RuntimeError:  # it has been typed in, and lies in no file: it is compiled in memory, and linked into its callers
        dispatcher._compiler._customize_flags = partial(_set_flags, values=flags)
        return dispatcher
    for one, called_from_python in ((dispatcher, False), (entry, True)):
        wrappers = {"no_cpython_wrapper": not called_from_python, "no_cfunc_wrapper": True}
        one._compiler._customize_flags = partial(_set_flags, values={**flags, **wrappers})
        one.compile = partial(_compile_locked, one.compile, one._cache.lock_name)
    entry.inserted = set()  # types of arguments with which Python finds its code
    entry._cache_hits, entry._cache_misses = dispatcher._cache_hits, dispatcher._cache_misses
    _dispatchers[dispatcher._cache.name] = dispatcher
    # compiled callers find kernels without wrappers in its table, and Python those with one
    dispatcher.add_overload = partial(_keep, dispatcher)
    dispatcher._compile_for_args = partial(_compile_entry, dispatcher, entry)
    return dispatcher


def is_kept(dispatcher: Any) -> bool:
    """Whether the cache has some version of a kernel that is called from Python."""
    entry = getattr(dispatcher._compile_for_args, "args", (None, None))[1]
    return entry is None or Path(entry._cache._cache_file._index_path).exists()


_most = 0  # kernels that this process may have compiled when the present call from Python is through


def _reachable(function: Any, found: set[str]) -> set[str]:
    """Add the names of all kernels that a function may call to ``found``."""
    for name in function.__code__.co_names:
        callee = function.__globals__.get(name)
        inner = getattr(callee, "py_func", None)
        kernel = f"{inner.__module__}.{inner.__qualname__}" if inner is not None else ""
        if inner is not None and kernel not in found:
            found.add(kernel)
            _reachable(inner, found)
    return {name for name in found if name in _dispatchers}


def _keep(dispatcher: Any, result: Any) -> None:
    """Note a kernel for its compiled callers."""
    dispatcher.overloads[tuple(result.signature.args)] = result


def _compile_entry(dispatcher: Any, entry: Any, *args: Any) -> Any:
    """What a call from Python with these arguments is to call, which the next calls with such arguments find at once."""
    global _most
    outermost = not _most
    if outermost:
        _most = cache_folder().compiled + len(_reachable(dispatcher.py_func, {dispatcher._cache.name}))
    try:
        called = entry._compile_for_args(*args)
    finally:
        if outermost:
            _most = 0
            cache_folder().end_line()
    types = tuple(entry.typeof_pyval(value) for value in args)
    # once: threads may come here together, and numba takes a call that fits two entries for one that fits none
    with global_compiler_lock:
        if types not in entry.inserted:
            entry.inserted.add(types)
            dispatcher._insert([one._code for one in types], called, False)
    return called


def _set_flags(flags: Any, values: Mapping[str, bool]) -> Any:
    for name, value in values.items():
        setattr(flags, name, value)
    return flags


def _compile_locked(compile_or_load: Any, lock_name: str, signature: Any) -> Any:
    """Compile or load a kernel, and release its lock if it was taken for that."""
    with global_compiler_lock:  # numba's own, taken before we look whether this thread holds the file's
        held = lock_name in cache_folder().held
        try:
            return compile_or_load(signature)
        finally:
            if not held:
                cache_folder().release(lock_name)


class _Locator(caching._SourceFileBackedLocatorMixin, caching._CacheLocator):  # type: ignore[misc]
    """Tells numba's cache to use our folder; the stamp is the kernel's own file, the folder's name covers its callees."""

    def __init__(self, py_func: FunctionType, py_file: str) -> None:
        self._py_file, self._module = py_file, py_func.__module__
        self._lineno = py_func.__code__.co_firstlineno

    def get_cache_path(self) -> str:
        return str(cache_folder().folder_of(self._module))

    def ensure_cache_path(self) -> None:
        pass


class _CheckedFiles(caching.IndexDataCacheFile):  # type: ignore[misc]
    """A kernel's index of signatures and files of code, each with a checksum that is seen to before anything is unpickled."""

    def _load_index(self) -> dict[Any, str]:
        found = self._read(self._index_path)
        return found[1] if found is not None and found[0] == self._source_stamp else {}

    def _save_index(self, overloads: dict[Any, str]) -> None:
        cache_folder().write(Path(self._index_path), self._dump((self._source_stamp, overloads)))

    def _load_data(self, name: str) -> Any:
        return self._read(self._data_path(name))

    def _save_data(self, name: str, data: Any) -> None:
        cache_folder().write(Path(self._data_path(name)), self._dump(data))

    def _read(self, path: str) -> Any:
        content = cache_folder().read(Path(path))
        try:
            return None if content is None else pickle.loads(content)
        except (AttributeError, ImportError):  # of a module that is gone or has another name here, as one that is run has
            return None


_code_of = attrgetter("library")  # the machine code of one of numba's compile results, with its linked libraries


class _Outdated(Exception):
    """Compiled code calls code that is no longer there."""


class _Impl(caching.CompileResultCacheImpl):  # type: ignore[misc]
    """Stored form of compiled code, with its separately compiled callees, ``(name, argument types, symbol)`` each."""

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
        # a callee lives as long as its caller
        code.calls, code.called = calls, called
        return result


def _calls_of(library: Any) -> list[tuple[str, Any, str]]:
    """Separately compiled kernels that a library calls, itself or in its linked libraries."""
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

    def __init__(self, py_func: FunctionType, apart: bool, suffix: str = "") -> None:
        super().__init__(py_func)
        place, impl = self._cache_path, self._impl
        self._cache_file = _CheckedFiles(place, impl.filename_base + suffix, impl.locator.get_source_stamp())
        self.name, self.lock_name = f"{py_func.__module__}.{py_func.__qualname__}", name_of(py_func) + suffix
        self.apart = apart

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        folder = cache_folder()
        found = self._load(sig, target_context)
        if found is None and folder.writable and self.lock_name not in folder.held:
            folder.acquire(self.lock_name, Path(self._cache_path))
            found = self._load(sig, target_context)
        if found is None:
            target_context.refresh()
            folder.announce(_most)
        return found

    def _load(self, sig: Any, target_context: Any) -> Any:
        if not Path(self._cache_path).is_dir():
            return None
        if numba.version_info.short in LOADS_WITHOUT_TABLES:
            rtsys.initialize(target_context)
        else:
            target_context.refresh()
        try:
            found = self._load_overload(sig, target_context)
        except (OSError, _Outdated):
            return None
        if found is not None:
            self._set_apart(found)
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        folder = cache_folder()
        if folder.writable:
            try:
                super().save_overload(sig, data)
            except OSError as error:
                folder.give_up(error)
        self._set_apart(data)

    def _set_apart(self, result: Any) -> None:
        """Give callers nothing to link but the symbol, if the kernel is to stay apart."""
        if self.apart:
            code = _code_of(result)
            code.stays_apart = self.name, result.signature.args, result.fndesc.mangled_name
            code._shared_module = llvm.parse_assembly(str(code._codegen._create_empty_module("apart")))
