"""A module as ONNX: one file, checked against the module it came from, for pipelines that do not run torch.

``to_onnx`` writes the file, ``verify`` compares a file with a module, ``chain`` puts a depth estimator in front of it
and ``describe`` tells what a file holds.
"""

from .conversion import to_onnx
from .joining import chain
from .metadata import describe
from .verification import Verification, verify

__all__ = ["Verification", "chain", "describe", "to_onnx", "verify"]
