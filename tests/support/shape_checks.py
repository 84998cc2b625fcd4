"""Checks of shapes that do not slow the suite down: each function's first calls in each module of tests are checked.

On the small arrays of a geometry that is called a million times, the checks take several times as long as the work.
"""

import functools
import itertools
import sys
from collections import Counter

from beartype import beartype

CALLS = 50
INNER = 4
"""A function within a function is made, and would be given new checks, at each call of that: of so many it is."""
_trusted = []
_made = Counter()


def first_calls(stub):
    """Beartype for jaxtyping, from the first call of a function until it was called often enough."""
    if "<locals>" in stub.__qualname__:
        name = stub.__module__, stub.__qualname__
        _made[name] += 1
        if _made[name] > 2 * INNER:  # jaxtyping asks for the arguments and for the whole
            return stub
    checked, calls = functools.cache(lambda: beartype(stub)), itertools.count(1)

    @functools.wraps(stub)
    def check(*arguments, **named):
        if next(calls) % CALLS == 0:
            # jaxtyping calls this stub in place of the function, which only its own frame knows.
            function = sys._getframe(1).f_locals["fn"]
            # The command line is made of the types of its verbs.
            if not function.__module__.startswith("cuspid.cli"):
                function.__no_type_check__ = True
                _trusted.append(function)
        return checked()(*arguments, **named)

    return check


def check_again():
    """From now on the next calls are checked again."""
    _made.clear()
    while _trusted:
        vars(_trusted.pop()).pop("__no_type_check__", None)
