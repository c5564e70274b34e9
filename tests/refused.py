"""Tables of calls that are refused."""

from collections.abc import Callable
from typing import Any

import pytest


def refuses(*rows: tuple[Callable[[], Any], str], errors: Any = ValueError) -> Callable[..., None]:
    """A test with a case for each row: the call raises an error whose message matches."""

    @pytest.mark.parametrize(("call", "message"), rows)
    def test(call: Callable[[], Any], message: str) -> None:
        with pytest.raises(errors, match=message):
            call()

    return test
