"""Finds the colour channels and the depth channel of a file by their names."""

__all__ = ["colour_channels", "depth_channel"]

Parts = list[tuple[str, tuple[str, ...]]]  # label and channel names of each part of a file


def colour_channels(parts: Parts, layer: str | None, layered: bool) -> tuple[int, list[int], tuple[str, ...]]:
    """Finds R, G, B (or grey, Y) and, if present, A.

    Names may have a layer before a dot if the file is ``layered`` (EXR). ``layer`` is the name of the part or layer;
    None takes the first with colour, preferring channels without a layer name.

    Returns:
        Index of the part, indices of the channels in it, and their names without layer.
    """
    layers_with_colour = []
    for part, (label, names) in enumerate(parts):
        layer_names = dict.fromkeys(name.rpartition(".")[0] if layered else "" for name in names)
        for layer_name in layer_names:
            start = layer_name + "." if layer_name else ""
            for colours in (("R", "G", "B"), ("Y",)):
                if all(start + name in names for name in colours):
                    channels = (*colours, "A") if start + "A" in names else colours
                    indices = [names.index(start + name) for name in channels]
                    layers_with_colour.append((layer_name, label, part, indices, channels))
                    break
    if layer is None:
        layers_with_colour.sort(key=lambda entry: entry[0] != "")
        chosen = layers_with_colour[:1]
    else:
        chosen = [found for found in layers_with_colour if layer in found[:2] or found[0].startswith(layer + ".")]
    if not chosen:
        all_names = ", ".join(name for _, names in parts for name in names)
        if layer is None:
            raise ValueError(f"has no colour: expected channels R, G, B or Y, found {all_names}")
        layers = ", ".join(dict.fromkeys(found[0] or found[1] or "(unnamed)" for found in layers_with_colour)) or "none"
        raise ValueError(f"has no layer {layer!r} with colour; its layers with colour: {layers}")
    return chosen[0][2:]


def depth_channel(parts: Parts) -> tuple[int, int] | None:
    """Indices of the part and of the depth channel in it: ``Z``, ``depth``, ``ViewLayer.Depth.Z``; not ``Normal.Z``."""
    for part, (label, names) in enumerate(parts):
        for index, name in enumerate(names):
            words = name.lower().split(".")
            in_layer = len(words) > 1 and words[-2] in ("depth", "z", "zdepth") and words[-1] in ("z", "v", "y", "r")
            in_own_part = label.lower() in ("depth", "z", "zdepth") and len(names) == 1
            if name.lower() == "z" or words[-1] == "depth" or in_layer or in_own_part:
                return part, index
    return None
