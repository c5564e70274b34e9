"""A calibrated depth-of-field post-process: an all-in-focus image and its depth in, a real lens's photograph out."""

import importlib
import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .module import DepthOfField, blur_by_coc, depth_of_field
    from .optics.blur_table import BlurTable
    from .optics.camera import Camera
    from .photograph import photo

__all__ = ["BlurTable", "Camera", "DepthOfField", "blur_by_coc", "depth_of_field", "photo"]

# Imported on first use, so that ``torchdof --help`` does not import PyTorch.
_HOMES = {
    "BlurTable": "optics.blur_table",
    "Camera": "optics.camera",
    "DepthOfField": "module",
    "blur_by_coc": "module",
    "depth_of_field": "module",
    "photo": "photograph",
}
_SUBPACKAGES = ("augmentation", "depth", "distributed", "export", "fit", "functional")


# A checkout has the packages fit and export beside this one, where an installation has them inside.
_CHECKOUT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
if all(os.path.isfile(os.path.join(_CHECKOUT, name)) for name in ("Makefile", os.path.join("fit", "__init__.py"))):
    __path__.append(_CHECKOUT)


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        value = getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
    elif name in _SUBPACKAGES:
        value = importlib.import_module(f".{name}", __name__)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_SUBPACKAGES})
