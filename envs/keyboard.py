"""The keys with which ``gymnasium.utils.play`` moves attachments, all at once.

d and a move them along x and against it, w and s along y, e and q up and down; o opens them, or lets go, and c closes them.
"""

from __future__ import annotations

from itertools import chain, combinations

import numpy as np
from numpy.typing import NDArray

# what each key adds to the action of an attachment: velocity along x, y and z, and what comes after it
KEYS = {
    "d": (1, 0, 0, 0), "a": (-1, 0, 0, 0),
    "w": (0, 1, 0, 0), "s": (0, -1, 0, 0),
    "e": (0, 0, 1, 0), "q": (0, 0, -1, 0),
    "o": (0, 0, 0, 1), "c": (0, 0, 0, -1),
}  # fmt: skip


def actions_of_keys(attachments: int, numbers: int) -> dict[str, NDArray]:
    """The action of every set of keys, of none too, as ``play`` does not know how to keep still in a box of numbers.

    attachments: that an action is for.  numbers: of each.
    """
    keys = [key for key, change in KEYS.items() if any(change[:numbers])]
    sets = chain.from_iterable(combinations(keys, count) for count in range(len(keys) + 1))
    return {"".join(held): np.tile(_sum(held)[:numbers], attachments) for held in sets}


def _sum(held: tuple[str, ...]) -> NDArray[np.float32]:
    """What these keys ask for together."""
    return np.array([KEYS[key] for key in held], np.float32).reshape(-1, 4).sum(axis=0)
