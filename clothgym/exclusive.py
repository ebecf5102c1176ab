"""Floor 0: a guard that admits one thread at a time to an object, and records interrupted calls."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Iterable
from threading import get_ident
from typing import Any, TypeVar, cast

Method = TypeVar("Method", bound=Callable[..., Any])


class CallGuard:
    """A guard that admits one thread at a time to an object with a batch of environments.

    Attributes:
        what, error: the object's name, for messages, and the exception for unfinished environments.
        unfinished: environments that a call is changing.  After an interruption they are still here: only a reset or a restored
            state takes them out.
    """

    def __init__(self, what: str, unfinished: Collection[int] = (), error: type[Exception] = RuntimeError) -> None:
        self.what, self.unfinished, self.error = what, unfinished, error
        self._holder: dict[str, int] = {}

    def acquire(self) -> bool:
        """Begin a call; returns whether it is the outermost one of this thread, which has to ``release``.

        Raises:
            RuntimeError: another thread is in a call.
        """
        me = get_ident()
        if self._holder.get("thread") == me:
            return False
        # one operation of the interpreter: of two threads one comes first
        if self._holder.setdefault("thread", me) != me:
            raise RuntimeError(
                f"another thread is in the middle of a call of this {self.what}: give each thread one of its own, or let them "
                "take turns, with a threading.Lock"
            )
        return True

    def release(self) -> None:
        """End the outermost call."""
        self._holder.pop("thread", None)

    def check_consistent(self) -> None:
        """Check that no environment is left in the middle of a step.

        Raises:
            RuntimeError: a call was interrupted, and not all environments have been reset since.
        """
        if self.unfinished:
            raise self.error(
                f"a call of this {self.what} was interrupted and left environment {min(self.unfinished)} between two steps: call "
                "reset(), or set_state() with a state from before"
            )

    def begin(self, envs: Iterable[int]) -> None:
        """Mark these environments as changing."""
        self.unfinished = {*self.unfinished, *envs}

    def finish(self, envs: Iterable[int]) -> None:
        """Mark these environments as consistent again."""
        self.unfinished = set(self.unfinished).difference(envs)

    def __reduce__(self) -> tuple[type[CallGuard], tuple[str, Collection[int], type[Exception]]]:
        """A copy starts released.  Copying raises a RuntimeError while another thread is in a call."""
        if self.acquire():
            self.release()
        return CallGuard, (self.what, self.unfinished, self.error)


def exclusive(method: Method) -> Method:
    """Decorate a method that admits one thread at a time, by the object's ``turn``; it may call other methods of the object."""

    @functools.wraps(method)
    def taken(self: Any, *args: Any, **kwargs: Any) -> Any:
        turn = self.turn
        if not turn.acquire():
            return method(self, *args, **kwargs)
        try:
            return method(self, *args, **kwargs)
        finally:
            turn.release()

    return cast(Method, taken)
