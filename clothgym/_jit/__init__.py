"""Floor 0: how every kernel is compiled, cached and run on several threads.

One policy for the whole project, so that the promises made about bits and about start-up are kept in one place:

    policy             the sorts of kernels and their compiler's flags; plain numba where the rest does not fit numba
    binding            one kernel from the code of another with other callees: ``specialize``, ``placeholder``
    merging            views that join the last two axes of an array, private to numba with a public fallback
    cache              the folder of compiled kernels: its name, its locks
    numba_internals    all other uses of private interfaces of numba and llvmlite
    threads            spans of blocks on Python threads
"""

from clothgym._jit.binding import callees_of, placeholder, specialize
from clothgym._jit.cache import cache_folder
from clothgym._jit.merging import merged
from clothgym._jit.policy import WITHOUT_JIT, apart, disjoint, inlined, is_kept, kernel, uncounted
from clothgym._jit.threads import default_threads, run_spans

__all__ = [
    "WITHOUT_JIT", "apart", "cache_folder", "callees_of", "default_threads", "disjoint", "inlined", "is_kept", "kernel", "merged",
    "placeholder", "run_spans", "specialize", "uncounted",
]  # fmt: skip
