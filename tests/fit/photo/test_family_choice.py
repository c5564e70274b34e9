"""PSNR on natural images and on highlights, and the choice of the cheapest sufficient family."""

import numpy as np
import pytest

from tests.kernels import kernel_of
from torchdof.fit import natural_psnr
from torchdof.fit.photo.family_choice import choose, highlight_psnr


def test_natural_psnr_equals_the_psnr_of_an_image_with_that_spectrum():
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

    first, second = kernel_of("disc", 6.0).numpy(), kernel_of("gaussian", 3.0).numpy()
    direct = -10 * np.log10(np.mean((blurred(first) - blurred(second)) ** 2))
    assert natural_psnr(first, second) == pytest.approx(direct, abs=0.3)


def test_a_highlight_distinguishes_a_ring_from_a_disc_better_than_a_photograph():
    round_, rim = kernel_of("disc", 8.0, size=33), kernel_of("ring", 3.0, 4.0, size=33)
    assert natural_psnr(round_, rim) > 37 and highlight_psnr(round_, rim) < 17
    assert highlight_psnr(round_, kernel_of("disc", 8.0, size=41)) > 190


def test_the_choice_is_the_cheapest_family_that_looks_like_the_likeliest():
    kernels = {
        "gaussian": kernel_of("gaussian", 3.0),
        "disc": kernel_of("disc", 6.0),
        "radial": kernel_of("disc", 6.002),
    }
    arrays = {k: v.numpy() for k, v in kernels.items()}
    family, why = choose(arrays, {"gaussian": 900.0, "disc": 50.0, "radial": 0.0}, 45)
    assert family == "disc" and "the cheapest with 45 dB" in why and "against radial, the likeliest" in why
    assert "BIC +900; disc " in why
    assert choose(arrays, {"gaussian": 900.0, "disc": 50.0, "radial": 0.0}, 20)[0] == "gaussian"
    family, why = choose(arrays, {"gaussian": 5.0, "disc": -5.0, "radial": 0.0}, 199)
    assert family == "disc" and "against disc, the likeliest (" in why and "radial " in why and "BIC +5)" in why
    assert choose(arrays, {"gaussian": 50.0, "disc": 50.0, "radial": 0.0}, 199)[0] == "radial"
    family, why = choose(arrays, {"gaussian": 50.0, "disc": 1.0, "radial": 0.0}, 199)
    assert family == "disc" and "BIC -1)" in why  # within 2 of the lowest
