"""Steps of small images run PyTorch's operations on one thread, and are the same steps."""

import threading
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from torchdof import native
from torchdof.render.engines import one_thread
from torchdof.render.engines.one_thread import on_one_thread

pytestmark = pytest.mark.skipif(one_thread._openmp_setter() is None, reason="this PyTorch does not show its OpenMP")


@pytest.fixture(autouse=True)
def _two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    assert torch.get_num_threads() == 2
    torch.set_num_threads(before)


def leaves() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    image, coc = (torch.rand(1, n, 5, 6, generator=generator, dtype=torch.float64) for n in (3, 1))
    return image.requires_grad_(), coc.requires_grad_()


def product(image: Tensor, coc: Tensor) -> Tensor:
    return torch.sin(image * coc + coc.square())


def counting(counts: list[int]) -> Any:
    """A rendering that lists the number of threads in its forward and in its backward pass."""

    def render(image: Tensor, coc: Tensor) -> Tensor:
        counts.append(torch.get_num_threads())
        out = product(image, coc)
        out.register_hook(lambda _: counts.append(torch.get_num_threads()))
        return out

    return render


def test_small_images_take_one_thread_forward_and_backward_and_large_ones_all(monkeypatch: pytest.MonkeyPatch) -> None:
    for most, threads in ((30, 1), (29, 2)):
        monkeypatch.setattr(one_thread, "_MOST_PIXELS", most)
        counts: list[int] = []
        on_one_thread(counting(counts), *leaves()).sum().backward()
        assert counts == [threads, threads]


def test_the_engine_and_other_threads_keep_their_number_of_threads() -> None:
    seen: list[int] = []

    def render(image: Tensor, coc: Tensor) -> Tensor:
        seen.append(native._threads())
        other = threading.Thread(target=lambda: seen.append(torch.get_num_threads()))
        other.start()
        other.join()
        return product(image, coc)

    on_one_thread(render, *leaves())
    assert seen == [2, 2] and native._threads() == 2


def test_gradients_of_every_order_are_those_of_the_rendering() -> None:
    assert gradcheck(lambda *x: on_one_thread(product, *x), leaves())
    assert gradgradcheck(lambda *x: on_one_thread(product, *x), leaves())
    inputs, seen = leaves(), torch.rand(1, 3, 5, 6, dtype=torch.float64)
    out, expected = on_one_thread(product, *inputs), product(*inputs)
    assert torch.equal(out, expected)
    for keep in (True, False):
        gradients = [torch.autograd.grad(o, inputs, seen, retain_graph=keep) for o in (out, expected)]
        assert all(map(torch.equal, *gradients))
    with pytest.raises(RuntimeError, match="second time"):
        torch.autograd.grad(out, inputs, seen)


def test_a_constant_input_and_one_without_effect_have_no_gradient() -> None:
    image, coc = leaves()
    on_one_thread(product, image, coc.detach()).sum().backward()
    assert image.grad is not None and coc.grad is None
    assert torch.autograd.grad(on_one_thread(lambda a, b: 2 * a, image, coc).sum(), coc, allow_unused=True) == (None,)


def test_an_error_in_either_pass_leaves_the_number_of_threads() -> None:
    def fails(*_: Any) -> Tensor:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        on_one_thread(fails, *leaves())
    assert torch.get_num_threads() == 2

    def fails_backward(image: Tensor, coc: Tensor) -> Tensor:
        out = product(image, coc)
        out.register_hook(fails)
        return out

    with pytest.raises(KeyboardInterrupt):
        on_one_thread(fails_backward, *leaves()).sum().backward()
    assert torch.get_num_threads() == native._threads() == 2
