"""For the site: docstrings as mkdocstrings reads them. In Python they keep the form that ``help`` shows."""

import re
from typing import Any

import griffe

_ROLE = re.compile(r":(?:class|func|meth|mod|data|attr):`~?([^`]+)`")


class Docstrings(griffe.Extension):
    """Names of other things are shown as code, and examples as examples."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Of each object, once all of it is known."""
        if obj.docstring is not None:
            text = _ROLE.sub(r"`\1`", obj.docstring.value)
            obj.docstring.value = re.sub(r"^Example:$", "Examples:", text, flags=re.M)
