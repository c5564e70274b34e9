"""One kernel per colour from one capture of a simulated lens with lateral and longitudinal colour."""

import numpy as np
import pytest

from torchdof import BlurTable
from torchdof.fit import Capture, Captures, fit_captures, read_captures
from torchdof.fit.photo.captures import PATTERNS, demosaiced

PER_DIOPTRE, FOCUS = 24.0, (-0.04, 0.0, 0.05)  # blur radius in px per dioptre; focus of each colour minus green's, 1/m
SIDE = ((0.5, -0.2), (0.0, 0.0), (-0.3, 0.4))  # displacement (x, y) of each colour from green, px
DISTANCES = (0.75, 1.4)


def frames(simulator, distance, seed, size=61):
    """Picture of a dot `[3, H, W]`: red, green and blue with their own focus and place."""
    rng, m = np.random.default_rng(seed), 1 / distance
    seen = []
    for focus, (x, y) in zip(FOCUS, SIDE, strict=True):
        dot = simulator.draw_dot(size, 7.0 * m, (x * m, y * m))
        radius = abs(PER_DIOPTRE * (1 - 1 / distance + focus))
        blurred = simulator.blur(dot, "disc", {"radius": radius}) if radius else dot
        seen.append(blurred + rng.normal(0, 0.005, dot.shape))
    return np.stack(seen)


def captures(simulator):
    still = frames(simulator, 1.0, 0)
    pairs = []
    for distance in DISTANCES:
        moved = frames(simulator, distance, round(100 * distance))
        pairs.append(Capture(still.mean(0), moved.mean(0), distance, colours=(still, moved)))
    return Captures(tuple(pairs), focus_m=1.0, width_px=1000)


# the mean of discs of three sizes is not a disc; its residual looks like that of a tone curve
@pytest.mark.filterwarnings("ignore:the fit.s residual depends on the level:torchdof.fit.problems.FitWarning")
def test_each_colour_has_its_own_blur_and_place(simulator, tmp_path):
    result = fit_captures(captures(simulator), "disc")
    for fits, focus, side in zip(result.colours.values(), FOCUS, SIDE, strict=True):
        true = [abs(PER_DIOPTRE * (1 - 1 / d + focus)) for d in DISTANCES]
        assert [f.params["radius"] for f in fits] == pytest.approx(true, rel=0.012)
        lateral = [np.subtract(f.centre, g.centre) for f, g in zip(fits, result.colours["green"], strict=True)]
        assert np.allclose(lateral, [(side[0] / d, side[1] / d) for d in DISTANCES], atol=0.036)  # px
    result.table.save(tmp_path / "colours.json")
    table = BlurTable.load(tmp_path / "colours.json")
    assert table.channels == 3 and table.provenance["colours"] == ["red", "green", "blue"]
    nodes = 1000 * table.node_params["radius"].numpy()
    assert nodes[0, 1] < nodes[1, 1] < nodes[2, 1] and nodes[0, 0] > nodes[1, 0] > nodes[2, 0]


@pytest.mark.parametrize("pattern", PATTERNS)
def test_demosaicing_is_exact_for_linear_gradients(pattern):
    rows, columns = np.indices((8, 10))
    planes = np.stack([0.1 * columns + 0.2, 0.1 * rows + 0.3, 0.05 * (rows + columns)])
    mosaic = np.zeros((8, 10))
    for i, name in enumerate(pattern):
        mosaic[i // 2 :: 2, i % 2 :: 2] = planes["RGB".index(name)][i // 2 :: 2, i % 2 :: 2]
    assert np.allclose(demosaiced(mosaic, pattern)[:, 2:-2, 2:-2], planes[:, 2:-2, 2:-2])


def test_a_folder_is_read_by_colour(simulator, tmp_path):
    camera = simulator.Simulator(level=0.7, snr_db=46, dot_radius=7.0, black=0.02)
    simulator.write_captures(tmp_path, camera, 0.5, [0.8], lambda d: ("disc", {"radius": 6.0}), width=120, height=90)
    (pair,) = read_captures(tmp_path, colours="each")[0].pairs
    still, moved = pair.colours
    assert still.shape == moved.shape == (3, *pair.sharp.shape)
    assert np.allclose(still.mean(0), pair.sharp) and np.allclose(moved.mean(0), pair.blurred)
    assert read_captures(tmp_path)[0].pairs[0].colours is None
