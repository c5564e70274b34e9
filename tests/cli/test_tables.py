"""``torchdof tables`` from the outside."""

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


def test_the_picture_shows_kernels_in_front_above_and_behind_below(scene: Path, run: Callable[..., str]) -> None:
    BlurTable.gaussian().save("mine.json")
    told = run("tables disc mine.json --blades 3 --rotation 90 -o kernels.png")
    assert "3 blades, turned by 90" in told and "negative is in front of focus" in told
    picture = read_image("kernels.png").pixels[0, 0]
    assert picture.shape == (6 * 200 + 34 + 8, 76 + 2 * 230 + 3 * 8)
    for row, behind in ((0, False), (5, True)):
        kernel = picture[34 + row * 200 : 34 + (row + 1) * 200, 84:314]
        left, right = kernel[:, :115].sum(), kernel[:, 115:].sum()
        assert (left > right) != behind  # the triangle's corner points left behind focus
        label = picture[34 + row * 200 : 34 + (row + 1) * 200, 8:84]
        assert bool((label[80:120] < 0.1).any()) and bool((label[:70] > 0.7).all()), "a label beside its row"


def test_tables_that_depend_on_the_place_show_kernels_from_the_middle_to_the_corner(
    scene: Path, run: Callable[..., str]
) -> None:
    told = run("tables disc --vignetting 0.6 -o kernels.png")
    assert "vignetting 0.6" in told
    picture = read_image("kernels.png").pixels[0, 0]
    rows = picture[34 + 5 * 200 + 2 : 34 + 6 * 200, 84 : 84 + 4 * 198]
    lit = [float((part > 0.1).sum()) for part in rows.split(198, 1)]
    assert lit[0] > 1.1 * lit[1] > 1.2 * lit[2] > 1.2 * lit[3]


def test_json_tells_programs_the_same(run: Callable[..., str]) -> None:
    facts = json.loads(run("tables double_gauss_50mm_f2 --json"))
    name = "double_gauss_50mm_f2"
    assert [facts[key] for key in ("table", "family", "nodes", "unit")] == [name, "radial", 41, "mm"]
    assert facts["coc"][0] < 0 < facts["coc"][1] and facts["aperture"] is None
