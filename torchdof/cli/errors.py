"""Whatever is wrong with the input ends in one sentence on standard error and exit code 2."""

import contextlib
import errno
import sys
from collections.abc import Iterator

import click

__all__ = ["told_in_one_sentence"]

_EXTRAS = {
    "scipy": "fit",
    "threadpoolctl": "fit",
    "onnx": "export",
    "onnxscript": "export",
    "onnxruntime": "export",
    "matplotlib": "plot",
}

_TOO_LITTLE = "there is too little memory for this image; try a smaller one, or --tolerance draft"
# PyTorch's own words for it on the CPU are those of what it is built from
_NO_MEMORY = ("can't allocate memory", "not enough memory", "bad_alloc", "size calculation overflowed", "new thread")


@contextlib.contextmanager
def told_in_one_sentence() -> Iterator[None]:
    """Turns errors of the input, of files, of memory and of missing packages into their message; others pass.

    Raises:
        SystemExit: With code 2, after the message.
    """
    try:
        yield
        return
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in _EXTRAS:
            raise
        message = f"this command needs {package}; install it with: pip install 'torchdof[{_EXTRAS[package]}]'"
    except OSError as error:
        if error.errno == errno.EPIPE:
            raise
        message = str(error)
    except ValueError as error:
        message = str(error) or type(error).__name__
    except MemoryError:  # numpy's has a message of its own, about arrays
        message = _TOO_LITTLE
    except RuntimeError as error:
        torch = sys.modules.get("torch")  # whoever ran out of a device's memory has imported it
        if torch is not None and isinstance(error, torch.OutOfMemoryError):
            message = "the device has too little memory for this image; try --device cpu"
        elif any(words in str(error) for words in _NO_MEMORY):
            message = _TOO_LITTLE
        else:
            raise
    click.echo(f"error: {message}", err=True)
    raise SystemExit(2)
