"""Finds the colour channels and the depth channel of a file by their names."""

from .decode import Part


def colour_channels(parts: list[Part], layer: str | None) -> tuple[int, list[int], tuple[str, ...]]:
    """Index of a part, indices in it of R, G, B (or grey, Y) and, if present, A, and their names without layer.

    ``layer`` is the name of the part or layer; None takes the first with colour, preferring channels without a layer.
    """
    layers_with_colour = []
    for part, source in enumerate(parts):
        names = source.names
        for layer_name in dict.fromkeys(name.rpartition(".")[0] if source.is_exr else "" for name in names):
            start = layer_name + "." if layer_name else ""
            colours = next((each for each in ("RGB", "Y") if all(start + name in names for name in each)), "")
            if colours:
                channels = tuple(colours + "A" if start + "A" in names else colours)
                indices = [names.index(start + name) for name in channels]
                layers_with_colour.append((layer_name, source.label, part, indices, channels))
    if layer is None:
        layers_with_colour.sort(key=lambda entry: entry[0] != "")
        chosen = layers_with_colour[:1]
    else:
        chosen = [found for found in layers_with_colour if layer in found[:2] or found[0].startswith(layer + ".")]
    if not chosen:
        all_names = ", ".join(name for source in parts for name in source.names)
        if layer is None:
            raise ValueError(f"has no colour: expected channels R, G, B or Y, found {all_names}")
        layers = ", ".join(dict.fromkeys(found[0] or found[1] or "(unnamed)" for found in layers_with_colour)) or "none"
        raise ValueError(f"has no layer {layer!r} with colour; its layers with colour: {layers}")
    return chosen[0][2:]


def depth_channel(parts: list[Part]) -> tuple[int, int] | None:
    """Indices of the part and of the depth channel in it: ``Z``, ``depth``, ``ViewLayer.Depth.Z``; not ``Normal.Z``."""
    for part, source in enumerate(parts):
        for index, name in enumerate(source.names):
            words = name.lower().split(".")
            in_layer = len(words) > 1 and words[-2] in ("depth", "z", "zdepth") and words[-1] in ("z", "v", "y", "r")
            in_own_part = source.label.lower() in ("depth", "z", "zdepth") and len(source.names) == 1
            if name.lower() == "z" or words[-1] == "depth" or in_layer or in_own_part:
                return part, index
    return None
