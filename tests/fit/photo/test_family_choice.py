"""Accuracy on a natural image, and the choice by need."""

import numpy as np
import pytest
import torch

from torchdof.fit import natural_psnr
from torchdof.fit.photo.family_choice import choose
from torchdof.optics.psf import disc, gaussian


def test_equal_kernels_reach_the_top_whatever_their_padding():
    assert natural_psnr(disc(4.0), disc(4.0, size=31)) > 190


def test_psnr_falls_with_the_difference():
    reached = [natural_psnr(disc(8.0), disc(8.0 * f)) for f in (1.01, 1.05, 1.2)]
    assert reached == sorted(reached, reverse=True)
    assert 30 < reached[2] < reached[0] < 80


def test_psnr_is_that_of_an_image_with_the_spectrum():
    # an image drawn with a 1/f amplitude and random phase, blurred both ways and compared
    rng = np.random.default_rng(0)
    n = 256
    f = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.fftfreq(n)[None, :])
    f[0, 0] = np.inf
    image = np.real(np.fft.ifft2(np.exp(2j * np.pi * rng.random((n, n))) / f))
    image *= 0.22 / image.std()

    def blurred(kernel):
        padded = np.zeros((n, n))
        padded[: kernel.shape[0], : kernel.shape[1]] = kernel
        return np.real(np.fft.ifft2(np.fft.fft2(image) * np.fft.fft2(np.roll(padded, -(kernel.shape[0] // 2), (0, 1)))))

    first, second = disc(6.0).numpy(), gaussian(3.0).numpy()
    direct = -10 * np.log10(np.mean((blurred(first) - blurred(second)) ** 2))
    assert natural_psnr(first, second) == pytest.approx(direct, abs=0.3)


def test_choice_prefers_cheap_then_likely_then_radial():
    kernels = {"gaussian": gaussian(3.0), "disc": disc(6.0), "radial": disc(6.02)}
    arrays = {k: v.numpy() for k, v in kernels.items()}
    assert choose(arrays, dict.fromkeys(arrays, 0.0), 45)[0] == "disc"
    assert choose(arrays, dict.fromkeys(arrays, 0.0), 20)[0] == "gaussian"
    family, why, _ = choose(arrays, {"gaussian": 5.0, "disc": -5.0, "radial": 0.0}, 199)
    assert family == "disc" and "noise hides" in why
    family, why, psnr = choose(arrays, {"gaussian": 5.0, "disc": 5.0, "radial": 0.0}, 199)
    assert family == "radial" and "no cheaper family" in why
    assert psnr["radial"] == 200 and torch.is_tensor(kernels["disc"])
