import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch import Tensor

from tests.processes import output_of
from torchdof.optics.kernel_cache import KernelCache


def test_results_are_kept_and_the_least_recently_used_is_dropped_first() -> None:
    cache, made = KernelCache(25_000), []

    def kernel(name: str) -> Tensor:
        def make() -> Tensor:
            made.append(name)
            return torch.zeros(1000, dtype=torch.float64)

        return cache.get(name, make)

    for name in ("a", "b", "a", "c", "a", "d", "a", "c", "b"):  # 8 kB each: two fit, "a" is used all the time
        kernel(name)
    assert made == ["a", "b", "c", "d", "c", "b"]
    assert cache.bytes <= 25_000


def test_a_result_above_the_limit_is_not_kept_and_a_view_counts_with_its_whole_storage() -> None:
    cache = KernelCache(10_000)
    small = cache.get("small", lambda: torch.zeros(100))
    first, second = (cache.get("large", lambda: torch.zeros(10_000)) for _ in range(2))
    cache.get("view", lambda: torch.zeros(10_000)[:10])
    assert first is not second and cache.bytes < 2000
    assert cache.get("small", lambda: torch.ones(100)) is small


def test_threads_share_a_cache() -> None:
    cache = KernelCache(20_000)

    def look(i: int) -> bool:
        return float(cache.get(i % 7, lambda: torch.full((500,), float(i % 7)))[0]) == i % 7

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(look, range(2000)))
    assert 0 < cache.bytes <= 20_000


SMALL = """
import resource, torch
from torchdof.optics.kernel_cache import KernelCache
def resident():
    return resource.getpagesize() * int(open("/proc/self/statm").read().split()[1])
for tensors in (1, 5):
    cache = KernelCache(2**30)
    for i in range(25_000):
        cache.get(("lens", i, float(i)), lambda: tuple(torch.zeros(4) for _ in range(tensors)))
        if i == 15_000:  # the memory that importing has freed is in use again
            before, bytes_before = resident(), cache.bytes
    print((resident() - before) / (cache.bytes - bytes_before))
    kept = cache
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_small_results_count_with_the_memory_that_they_take() -> None:
    """A limit in bytes would otherwise be exceeded several times by index tables of a few numbers."""
    one, five = map(float, output_of(SMALL).split())
    assert 0.8 < one < 1.2 and 0.8 < five < 1.2
