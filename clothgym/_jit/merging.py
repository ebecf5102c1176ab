"""Views that join the last two axes of an array.

A block of one sheet has a last axis of length one, (3, particles, 1), and loops over its particles are only vectorized over rows
that the compiler knows to be contiguous.  Numba's ``reshape`` returns such a view, too, but calls a C function that checks whether
a view is possible.  The main loop needs a few dozen views in each substep.
"""

from __future__ import annotations

from typing import Any

import numba
from numba import types
from numba.core.errors import TypingError
from numba.extending import intrinsic

try:
    from numba.core.imputils import impl_ret_borrowed
    from numba.np.arrayobj import make_array, populate_array

    KNOWN = True
except ImportError:  # private to numba: plain reshaping does the same
    KNOWN = False


def _merged_in_python(a: Any) -> Any:
    """``merged``, by numba's public means."""
    return a.reshape(a.shape[:-2] + (a.shape[-2] * a.shape[-1],))


@intrinsic  # type: ignore[untyped-decorator]
def _merged(typing_context: Any, a: Any) -> Any:
    """A view of a C-contiguous array."""
    if not (isinstance(a, types.Array) and a.layout == "C" and a.ndim >= 2):
        raise TypingError(f"merged takes C-contiguous arrays of two or more axes, not {a}")
    view = types.Array(a.dtype, a.ndim - 1, "C", readonly=not a.mutable)

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        """The same data with the shape and strides of the view."""
        array = make_array(signature.args[0])(context, builder, arguments[0])
        out = make_array(signature.return_type)(context, builder)
        shape = [builder.extract_value(array.shape, k) for k in range(a.ndim)]
        strides = [builder.extract_value(array.strides, k) for k in range(a.ndim)]
        populate_array(
            out, data=array.data, shape=[*shape[:-2], builder.mul(shape[-2], shape[-1])], strides=[*strides[:-2], strides[-1]],
            itemsize=array.itemsize, meminfo=array.meminfo, parent=array.parent,
        )  # fmt: skip
        return impl_ret_borrowed(context, builder, signature.return_type, out._getvalue())

    return view(a), build


def _choose() -> Any:
    """``merged`` for kernels, or for plain Python."""
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        return _merged_in_python
    return numba.njit(inline="always")(_merged_in_python) if not KNOWN else _merged


merged = _choose()
