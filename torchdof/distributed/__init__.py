"""Data sets of blurred images, made by many processes: a callable for Ray Data, and what drives it."""

from .dataset import Summary, make_dataset, summary_of
from .pairs import Pair, pairs_in
from .shards import RenderShards, shard_rows

__all__ = ["Pair", "RenderShards", "Summary", "make_dataset", "pairs_in", "shard_rows", "summary_of"]
