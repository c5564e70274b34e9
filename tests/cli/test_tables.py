"""``torchdof tables``: the list of tables and pictures of their kernels."""

import json
from collections.abc import Callable
from pathlib import Path

from torchdof import BlurTable
from torchdof.io.images import read_image


def test_every_table_that_ships_is_listed(run: Callable[..., str]) -> None:
    lines = run("tables").splitlines()
    assert [line.split()[0] for line in lines[:2]] == ["disc", "gaussian"]
    folder = Path(BlurTable.load.__code__.co_filename).parent / "tables"
    assert [line.split()[0] for line in lines[2:]] == sorted(path.stem for path in folder.glob("*.json"))


def test_the_picture_shows_kernels_of_the_foreground_above_those_of_the_background(
    scene: Path, run: Callable[..., str]
) -> None:
    BlurTable.gaussian().save("mine.json")
    output = run("tables disc mine.json --blades 3 --rotation 90 -o kernels.png")
    assert "3 blades, turned by 90" in output and "negative is in front of focus" in output
    picture = read_image("kernels.png").pixels[0, 0]
    assert picture.shape == (6 * 200 + 34 + 8, 76 + 2 * 230 + 3 * 8)
    for row, behind in ((0, False), (5, True)):
        kernel = picture[34 + row * 200 : 34 + (row + 1) * 200, 84:314]
        left, right = kernel[:, :115].sum(), kernel[:, 115:].sum()
        assert (left > right) != behind  # the triangle's corner points left behind focus
        label = picture[34 + row * 200 : 34 + (row + 1) * 200, 8:84]
        assert bool((label[80:120] < 0.1).any()) and bool((label[:70] > 0.7).all()), "a label beside its row"


def test_tables_that_vary_across_the_field_show_kernels_from_the_centre_to_the_corner(
    scene: Path, run: Callable[..., str]
) -> None:
    output = run("tables disc --vignetting 0.6 -o kernels.png")
    assert "vignetting 0.6" in output
    picture = read_image("kernels.png").pixels[0, 0]
    rows = picture[34 + 5 * 200 + 2 : 34 + 6 * 200, 84 : 84 + 4 * 198]
    lit = [float((part > 0.1).sum()) for part in rows.split(198, 1)]
    assert lit[0] > 1.1 * lit[1] > 1.2 * lit[2] > 1.2 * lit[3]


def test_json_has_the_printed_facts(run: Callable[..., str]) -> None:
    facts = json.loads(run("tables double_gauss_50mm_f2 --json"))
    name = "double_gauss_50mm_f2"
    assert [facts[key] for key in ("table", "family", "nodes", "unit")] == [name, "radial", 41, "mm"]
    assert facts["coc"][0] < 0 < facts["coc"][1] and facts["aperture"] is None
