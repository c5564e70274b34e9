"""Finds the colour channels and the depth channel of a file by their names."""

import re
from collections.abc import Sequence

import numpy as np

from .decode import Part

Place = tuple[int, int]
"""Index of a part, and of a channel in it."""

_DEPTH_WORDS = ("depth", "z", "zdepth")
_KINDS_OF_LAYERS = {*_DEPTH_WORDS, "rgb", "rgba", "combined", "colour", "color", "beauty", "image"}
"""Words for the content of a layer or part; the other words of its name are those of a layer, part or view."""


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


def full_name(parts: list[Part], place: Place) -> str:
    """Name of a channel with those of its part and layer."""
    part = parts[place[0]]
    return f"{part.label}.{part.names[place[1]]}" if part.label else part.names[place[1]]


def depth_channels(parts: list[Part]) -> list[Place]:
    """The channels that hold depth by their names: ``Z``, ``depth``, ``left.Z``, ``ViewLayer.Depth.Z``; not ``N.Z``."""
    places = []
    for part, source in enumerate(parts):
        names = [name.lower() for name in source.names]
        for index, name in enumerate(names):
            layer, _, last = name.rpartition(".")
            of_view = last == "z" and f"{layer}.x" not in names
            in_layer = last in ("z", "v", "y", "r") and not {*layer.split(".")}.isdisjoint(_DEPTH_WORDS)
            in_own_part = source.label.lower() in _DEPTH_WORDS and len(names) == 1
            if name == "z" or last == "depth" or of_view or in_layer or in_own_part:
                places.append((part, index))
    return places


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
        ValueError: If two channels of different numbers belong to it equally well, or all belong to the other eye; the
            message lists them.
    """
    wanted = _words(layer)
    listed = ", ".join(full_name(parts, place) for place in places)
    other_eye = {"left": "right", "right": "left"}
    others = {other_eye[word] for word in wanted & other_eye.keys()}
    places = [place for place in places if not others & _words(full_name(parts, place).rpartition(".")[0])]
    if not places:
        raise ValueError(f"its depth is that of the other eye: {listed}; name it (--depth-channel) if it is right")

    def fit(place: Place) -> tuple[int, int]:
        words = _words(full_name(parts, place).rpartition(".")[0])
        return len(words & wanted), -len(words - wanted)

    best = max(map(fit, places))
    nearest = [place for place in places if fit(place) == best]
    first = parts[nearest[0][0]].values[..., nearest[0][1]]
    if not all(np.array_equal(parts[p].values[..., k], first, equal_nan=True) for p, k in nearest[1:]):
        raise ValueError(f"which of its depth channels belongs to the image: {listed}? name it (--depth-channel)")
    return nearest[0]


def _words(name: str) -> set[str]:
    return {*re.split(r"[^a-z0-9]+", name.lower())} - _KINDS_OF_LAYERS - {""}
