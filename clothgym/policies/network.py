"""A small network, evaluated so that an environment's action has the same bits alone, in any batch and on any x86-64 processor.

BLAS sums in an order that depends on the processor and on the size of the batch, and tanh of a library differs between processors.
Here every sum goes over the inputs in their order, and tanh is made of additions, products and divisions.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined, kernel

NONE, TANH, RELU = 0, 1, 2
ACTIVATIONS = {"tanh": TANH, "relu": RELU}
SATURATED = 9.0  # beyond it tanh is 1 to single precision


@inlined
def _tanh(x):
    """tanh x, to 1e-8: ``tanh 2y = 2 t / (1 + t^2)``, ``t = tanh y``, twice, from the continued fraction of tanh (Lambert 1768),

    ``tanh y = y / (1 + y^2 / (3 + y^2 / (5 + ...)))``, cut off after 13, at ``y = x/4``, which is at most 2.25.
    """
    y = min(max(x, -SATURATED), SATURATED) / 4
    s = y * y
    t = y * (135135.0 + s * (17325.0 + s * (378.0 + s))) / (135135.0 + s * (62370.0 + s * (3150.0 + s * 28.0)))
    t = 2 * t / (1 + t * t)
    return 2 * t / (1 + t * t)


@kernel
def _dense(x, weight, bias, activation, out):
    """``out = f(x weight + bias)``, each sum in the order of the inputs, from the bias on.

    x: (rows, inputs).  weight: (inputs, outputs).  bias: (outputs,).  out: (rows, outputs).
    """
    for row in range(x.shape[0]):
        # the inner loop is over the outputs, which lie side by side
        for j in range(out.shape[1]):
            out[row, j] = bias[j]
        for i in range(x.shape[1]):
            value = x[row, i]
            for j in range(out.shape[1]):
                out[row, j] += value * weight[i, j]
        if activation == TANH:
            for j in range(out.shape[1]):
                out[row, j] = _tanh(np.float64(out[row, j]))
        elif activation == RELU:
            for j in range(out.shape[1]):
                out[row, j] = max(out[row, j], np.float32(0))


def forward(x: NDArray, layers: Sequence[tuple[NDArray, NDArray]], activation: str, squashed: bool) -> NDArray[np.float32]:
    """Actions within [-1, 1], (rows, numbers); x: (rows, inputs).  The last layer has no activation, but a tanh if ``squashed``."""
    x = np.ascontiguousarray(x, np.float32)
    for number, (weight, bias) in enumerate(layers):
        out = np.empty((len(x), weight.shape[1]), np.float32)
        last = number == len(layers) - 1
        _dense(x, weight, bias, (TANH if squashed else NONE) if last else ACTIVATIONS[activation], out)
        x = out
    return np.clip(x, -1, 1)
