"""Finds the colour channels and the depth channel of a file by their names."""

from .decode import Part

_LETTERS = {"red": "R", "green": "G", "blue": "B", "alpha": "A", **{letter.lower(): letter for letter in "RGBAYZ"}}


def plain(name: str) -> tuple[str, str]:
    """Layer and channel of a name as programs write them: ``.R``, ``r``, ``Beauty.red`` and ``Beauty.[red]`` are R."""
    layer, _, channel = name.rpartition(".")
    channel = channel.removeprefix("[").removesuffix("]")
    return layer, _LETTERS.get(channel.lower(), channel)


def colour_channels(parts: list[Part], layer: str | None) -> tuple[int, list[int], tuple[str, ...]]:
    """Index of a part, indices in it of R, G, B (or grey, Y) and, if present, A, and their names without layer.

    ``layer`` is the name of the part or layer; None takes the first with colour, preferring channels without a layer.
    """
    layers_with_colour = []
    for part, source in enumerate(parts):
        names = [plain(name) if source.is_exr else ("", name) for name in source.names]
        for layer_name in dict.fromkeys(layer_name for layer_name, _ in names):
            colours = next((each for each in ("RGB", "Y") if all((layer_name, name) in names for name in each)), "")
            if colours:
                channels = tuple(colours + "A" if (layer_name, "A") in names else colours)
                indices = [names.index((layer_name, name)) for name in channels]
                layers_with_colour.append((layer_name, source.label, part, indices, channels))
    if layer is None:
        layers_with_colour.sort(key=lambda entry: (entry[0] != "", _of_depth(entry[0])))
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
    """Indices of the part and of the depth channel in it: ``Z``, ``ViewLayer.Depth.Z``, ``VRayZDepth``; not ``N.Z``."""
    places = [(part, index) for part, source in enumerate(parts) for index in range(len(source.names))]
    return next((place for place in places if _is_depth(parts[place[0]], place[1])), None)


def _is_depth(part: Part, index: int) -> bool:
    """Whether a channel is depth by its name, the last word of its layer, or the name of its part."""
    layer, channel = plain(part.names[index])
    word = channel.lower()
    if word.endswith("depth") or (not layer and word in ("z", "pz")):
        return True
    in_own_part = part.label.lower() in ("depth", "z", "zdepth") and len(part.names) == 1
    return in_own_part or (_of_depth(layer) and channel in ("Z", "V", "Y", "R"))


def _of_depth(layer: str) -> bool:
    """Whether a layer is depth by the last word of its name, as in ``FinalImageWorldDepth.R``."""
    word = layer.lower().rpartition(".")[2]
    return word == "z" or word.endswith("depth")
