"""Finds the colour channels and the depth channel of a file by their names."""

__all__ = ["colour_channels", "depth_channel"]

Parts = list[tuple[str, tuple[str, ...]]]  # label and channel names of each part of a file


def colour_channels(parts: Parts, layer: str | None, layered: bool) -> tuple[int, list[int], tuple[str, ...]]:
    """Finds R, G, B (or grey, Y) and, if present, A.

    Args:
        parts: Label and channel names of each part of the file.
        layer: Name of the part or layer; None takes the first with colour, preferring channels without a layer name.
        layered: Whether names may have a layer before a dot (EXR).

    Returns:
        Index of the part, indices of the channels in it, and their names without layer.

    Raises:
        ValueError: If there is no colour, or no such layer with colour.

    Example:
        >>> colour_channels([("", ("A", "B", "G", "R", "Z"))], None, True)
        (0, [3, 2, 1, 0], ('R', 'G', 'B', 'A'))
    """
    layers_with_colour = []
    for part, (label, names) in enumerate(parts):
        prefixes = dict.fromkeys(name.rpartition(".")[0] if layered else "" for name in names)
        for prefix in prefixes:
            dot = prefix + "." if prefix else ""
            for wanted in (("R", "G", "B"), ("Y",)):
                if all(dot + name in names for name in wanted):
                    plain = (*wanted, "A") if dot + "A" in names else wanted
                    layers_with_colour.append((prefix, label, part, [names.index(dot + name) for name in plain], plain))
                    break
    if layer is None:
        layers_with_colour.sort(key=lambda entry: entry[0] != "")
        chosen = layers_with_colour[:1]
    else:
        chosen = [f for f in layers_with_colour if layer in (f[0], f[1]) or f[0].startswith(layer + ".")]
    if not chosen:
        every = ", ".join(name for _, names in parts for name in names)
        if layer is None:
            raise ValueError(f"has no colour: expected channels R, G, B or Y, found {every}")
        layers = ", ".join(dict.fromkeys(f[0] or f[1] or "(unnamed)" for f in layers_with_colour)) or "none"
        raise ValueError(f"has no layer {layer!r} with colour; its layers with colour: {layers}")
    return chosen[0][2:]


def depth_channel(parts: Parts) -> tuple[int, int] | None:
    """Indices of the part and of the depth channel in it: ``Z``, ``depth``, ``ViewLayer.Depth.Z``; not ``Normal.Z``.

    Example:
        >>> depth_channel([("", ("N.X", "N.Y", "N.Z", "ViewLayer.Depth.Z"))])
        (0, 3)
    """
    for part, (label, names) in enumerate(parts):
        for index, name in enumerate(names):
            words = name.lower().split(".")
            of_depth = len(words) > 1 and words[-2] in ("depth", "z", "zdepth") and words[-1] in ("z", "v", "y", "r")
            whole_part = label.lower() in ("depth", "z", "zdepth") and len(names) == 1
            if name.lower() == "z" or words[-1] == "depth" or of_depth or whole_part:
                return part, index
    return None
