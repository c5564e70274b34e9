"""Exports a module as one ONNX file, verified against the module, for pipelines without PyTorch.

``to_onnx`` writes the file, ``verify`` compares a file with a module, ``chain`` joins a depth estimator and the module
in one file, and ``describe`` reads a file's metadata.
"""

from torchdof.extras import missing

try:
    import onnx  # noqa: F401
    import onnxruntime  # noqa: F401
    import onnxscript  # noqa: F401
except ModuleNotFoundError as error:
    raise missing("torchdof.export", error.name) or error from None

from .conversion import to_onnx
from .joining import chain
from .metadata import describe
from .verification import Verification, verify

__all__ = ["Verification", "chain", "describe", "to_onnx", "verify"]
