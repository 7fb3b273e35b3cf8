"""One thread for the linear algebra of a fit."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
R = TypeVar("R")


def one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """The function, with one thread for the linear algebra while it runs.

    Its matrices are small: on a computer that does something else too, threads that wait for one another take four
    times as long, and how a sum is shared among them shows in the last bits of the result.
    """

    @wraps(function)
    def alone(*args: P.args, **kwargs: P.kwargs) -> R:
        with ThreadpoolController().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return alone
