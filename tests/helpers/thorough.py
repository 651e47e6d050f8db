"""How much is asked: some of it by `make test`, all of it by `make thorough`."""

import os
from collections.abc import Iterable, Sequence
from typing import TypeVar

Case = TypeVar("Case")

#: Whether all is asked.
THOROUGH = os.environ.get("HYBRIDVE_TESTS") == "thorough"

#: Of how many cases, or drawn examples, `make test` asks one.
_ONE_OF = 3

#: So many examples are asked in any case, if there are as many.
_LEAST = 5


def asked(n_examples: int) -> int:
    """Return how many of a property's examples are asked."""
    return n_examples if THOROUGH else max(n_examples // _ONE_OF, min(n_examples, _LEAST))


def some_of(cases: Iterable[Case]) -> Sequence[Case]:
    """Return those of many cases that are asked: the first, and every third after it."""
    every = list(cases)
    return every if THOROUGH else every[::_ONE_OF]
