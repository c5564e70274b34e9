"""Data sets of blurred images, made by many processes: a callable for Ray Data, and a function that runs it."""

from .dataset import Summary, make_dataset, pairs_in, summary_of
from .shards import Pair, RenderShards, shard_rows

__all__ = ["Pair", "RenderShards", "Summary", "make_dataset", "pairs_in", "shard_rows", "summary_of"]
