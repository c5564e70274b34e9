"""Finds the colour channels and the depth channel of a file by their names."""

import re
from collections.abc import Sequence

import numpy as np

from .decode import Part

_EYES = {"l": "left", "r": "right"}

Place = tuple[int, int]
"""Index of a part, and of a channel in it."""

_KINDS_OF_LAYERS = {"rgb", "rgba", "combined", "colour", "color", "beauty", "image"}
"""Words for the content of a layer or part, beside those for depth; other words of its name are of layer or view."""
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


def full_name(parts: list[Part], place: Place) -> str:
    """Name of a channel with those of its part and layer."""
    part = parts[place[0]]
    return f"{part.label}.{part.names[place[1]]}" if part.label else part.names[place[1]]


def depth_channels(parts: list[Part]) -> list[Place]:
    """The channels that hold depth by their names: ``Z``, ``depth``, ``left.Z``, ``VRayZDepth``; not ``N.Z``."""
    every = [(part, index) for part, source in enumerate(parts) for index in range(len(source.names))]
    return [place for place in every if _is_depth(parts[place[0]], place[1])]


def _is_depth(part: Part, index: int) -> bool:
    """Whether a channel is depth by its name, by its layer's without other coordinates, or by its part's."""
    layer, channel = plain(part.names[index])
    word = channel.lower()
    if word.endswith("depth") or (not layer and word == "pz"):
        return True
    is_coordinate = any(plain(name) in ((layer, "x"), (layer, "X")) for name in part.names)
    if word == "z" and not is_coordinate and not layer.lower().endswith("mist"):  # Blender's mist is from 0 to 1
        return True
    in_own_part = _of_depth(part.label) and len(part.names) == 1
    return in_own_part or (_of_depth(layer) and channel.upper() in ("Z", "V", "Y", "R"))


def _of_depth(name: str) -> bool:
    """Whether a layer or part is depth by a word of its name, as ``FinalImageWorldDepth`` or ``ViewLayer.Depth``."""
    return any(_means_depth(word) for word in name.lower().split("."))


def _means_depth(word: str) -> bool:
    return word == "z" or word.endswith("depth")


def named_channels(parts: list[Part], name: str) -> list[Place]:
    """The channels of a name, with or without that of the part; else the depth channel or only one of a part, layer."""
    every = [(part, index) for part, source in enumerate(parts) for index in range(len(source.names))]
    exact = [place for place in every if name in (parts[place[0]].names[place[1]], full_name(parts, place))]
    if exact:
        return exact
    inside = [place for place in every if name in (parts[place[0]].label, full_name(parts, place).rpartition(".")[0])]
    inside = inside or [p for p in every if parts[p[0]].names[p[1]].rpartition(".")[0] == name]
    of_depth = [place for place in depth_channels(parts) if place in inside]
    return of_depth or (inside if len(inside) == 1 else [])


def nearest_channel(parts: list[Part], places: Sequence[Place], layer: str = "") -> Place:
    """The channel of depth that belongs to a layer: it shares most words of its name, and has the fewest others.

    Raises:
        ValueError: If two channels of different numbers belong to it equally well, or all belong to other views; the
            message lists them.
    """
    wanted = _words(layer)
    listed = ", ".join(full_name(parts, place) for place in places)
    places = [place for place in places if not _is_of_other_view(parts, place, wanted)]
    if not places:
        raise ValueError(f"its depth is that of another view: {listed}; name it (--depth-channel) if it is right")

    def fit(place: Place) -> tuple[int, int]:
        words = _words(full_name(parts, place).rpartition(".")[0])
        return len(words & wanted), -len(words - wanted)

    best = max(map(fit, places))
    nearest = [place for place in places if fit(place) == best]
    first = parts[nearest[0][0]].values[..., nearest[0][1]]
    if not all(np.array_equal(parts[p].values[..., k], first, equal_nan=True) for p, k in nearest[1:]):
        raise ValueError(f"which of its depth channels belongs to the image: {listed}? name it (--depth-channel)")
    return nearest[0]


def _is_of_other_view(parts: list[Part], place: Place, wanted: set[str]) -> bool:
    """Whether a channel belongs to another eye or numbered camera than an image with these words in its name.

    A channel without a layer beside colours without one belongs to these.
    """
    part, words = parts[place[0]], _words(full_name(parts, place).rpartition(".")[0])
    of_image, of_channel = _views(wanted), _views(words)
    is_beside_colours = not words and all(("", name) in map(plain, part.names) for name in "RGB")
    return bool(of_image) and (is_beside_colours if not of_channel else not of_image & of_channel)


def _views(words: set[str]) -> set[str]:
    return {_EYES.get(word, word) for word in words if re.fullmatch(r"[lr]|left|right|(cam|camera|view|eye)\d+", word)}


def _words(name: str) -> set[str]:
    words = {*re.split(r"[^a-z0-9]+", name.lower())} - _KINDS_OF_LAYERS - {""}
    return {word for word in words if not _means_depth(word)}
