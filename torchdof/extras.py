"""Optional packages: the extra that installs each, and the message if one is missing."""

_EXTRAS = {"scipy": "fit", "threadpoolctl": "fit", "matplotlib": "plot"}
_EXTRAS |= dict.fromkeys(("onnx", "onnx_ir", "onnxscript", "onnxruntime"), "export")
_EXTRAS |= dict.fromkeys(("ray", "webdataset", "pyarrow"), "ray")


def missing(what: str, package: str | None) -> ModuleNotFoundError | None:
    """An error that names ``what`` needs a package and how to install it; None for a package of no extra.

    Example:
        >>> print(missing("torchdof.fit", "scipy"))
        torchdof.fit needs scipy; in the folder of torchdof's source, run: pip install '.[fit]'
    """
    name = (package or "").partition(".")[0]
    if name not in _EXTRAS:
        return None
    remedy = f"in the folder of torchdof's source, run: pip install '.[{_EXTRAS[name]}]'"
    return ModuleNotFoundError(f"{what} needs {name}; {remedy}", name=name)
