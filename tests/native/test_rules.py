"""The small rules of `native/src/rules.h` are those of Python, with their derivatives."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchdof.render.layers import composite, layer_weights
from torchdof.render.surfaces import disocclusion, frame, matting

ROOT = Path(__file__).parents[2]
COMPILER = os.environ.get("CXX") or shutil.which("c++")

# C++ expression of a float x or a vector v of it -> the same in Python; of 0.3 px the level is read
RULES: dict[str, Callable[[Tensor], Tensor]] = {
    "apart_px(v, broadcast(0.7f))[0]": lambda x: matting._apart_px(x, torch.full_like(x, 0.7)),
    "on_near(v)[0]": matting.on_near,
    "on_far(v)[0]": matting._on_far,
    "clamp01(unlimited_sided(v))[0]": lambda x: (matting.PLACE_SLOPE * (x - matting._SIDED_FROM)).clamp(0.0, 1.0),
    "own_end(x)": disocclusion.own_end,
    "is_another_surface(x)": disocclusion.is_another_surface,
    "is_another_surface(v)[0]": disocclusion.is_another_surface,
    "on_one_side(v, broadcast(3.7f))[0]": lambda x: disocclusion._on_one_side(x, torch.full_like(x, 3.7)),
    "is_read(std::fabs(x), 0.5f)": lambda x: disocclusion.is_read(x, 0.5),
    "ramp(x, true)": lambda x: layer_weights.eased(x.clamp(0.0, 1.0)),
    "ramp(v, true)[0]": lambda x: layer_weights.eased(x.clamp(0.0, 1.0)),
    "ramp(x, false)": lambda x: x.clamp(0.0, 1.0),
    "continuation(v)[0]": frame.continuation_weight,
    "visible_part(v)[0]": frame.visible_part,
    "end_of_surface(v)[0]": frame.end_of_surface,
    "is_clear(v, broadcast(-0.7f), broadcast(0.8f), broadcast(0.97f))[0]": lambda x: frame.is_clear(
        x, torch.full_like(x, -0.7), torch.full_like(x, 0.8), torch.full_like(x, 0.97)
    ),
    "at_focus(v)[0]": frame.at_focus,
    "stands_in(v)[0]": frame.stands_in,
    "counts(v)[0]": frame.counts,
    "seen(v)[0]": frame.seen,
    "(v + raise(lacking(broadcast(5e-4f), v)))[0]": lambda x: composite.raised(torch.full_like(x, 5e-4), x),
}
# C++ expression of a derivative -> the rule
SLOPES: dict[str, str] = {
    "slope_of_own_end(x)": "own_end(x)",
    "slope_of_ramp(v, true)[0]": "ramp(v, true)[0]",
    "slope_of_ramp(v, false)[0]": "ramp(x, false)",
    "slope_of_continuation(v)[0]": "continuation(v)[0]",
    "slope_of_visible_part(v)[0]": "visible_part(v)[0]",
    "slope_of_end(v)[0]": "end_of_surface(v)[0]",
    "slope_of_at_focus(v)[0]": "at_focus(v)[0]",
    "slope_of_stands_in(v)[0]": "stands_in(v)[0]",
    "slope_of_counts(v)[0]": "counts(v)[0]",
    "slope_of_seen(v)[0]": "seen(v)[0]",
    "1.0f + slope_of_raise(lacking(broadcast(5e-4f), v))[0]": "(v + raise(lacking(broadcast(5e-4f), v)))[0]",
    "float(within(unlimited_another_surface(x)))": "is_another_surface(x)",
}
# beside and between the limits of all rules, not on them
X = torch.tensor(
    [-9.3, -4.6, -1.7, -0.6, -0.01, 0.0004, 0.0012, 0.0021, 0.02, 0.05, 0.12, 0.4, 0.8, 0.97, 1.2, 1.7, 4.6]
)


@pytest.fixture(scope="module")
def computed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Tensor]:
    """Values of all expressions at X, by a program that is compiled with the header."""
    folder = tmp_path_factory.mktemp("rules")
    lines = [f'    std::printf("%.9g ", (double)({expression}));' for expression in [*RULES, *SLOPES]]
    source = f"""
#include "rules.h"
#include "simd.h"
#include <cmath>
#include <cstdio>
#include <initializer_list>
using namespace torchdof;
int main() {{
  for (const float x : {{{", ".join(f"{value!r}f" for value in X.tolist())}}}) {{
    const vec v = broadcast(x);
{chr(10).join(lines)}
  }}
}}
"""
    (folder / "rules.cpp").write_text(source)
    subprocess.run([sys.executable, ROOT / "cmake" / "constants.py", folder / "constants"], check=True)
    includes = [f"-I{ROOT / 'torchdof' / 'native' / 'src'}", f"-I{folder}"]
    command = [COMPILER or "c++", "-std=c++17", "-O1", "-Wno-psabi", *includes, "rules.cpp", "-o", "rules"]
    subprocess.run(command, check=True, cwd=folder)
    out = subprocess.run([folder / "rules"], check=True, capture_output=True, text=True).stdout
    values = torch.tensor([float(number) for number in out.split()]).view(len(X), -1)
    return dict(zip([*RULES, *SLOPES], values.unbind(1), strict=True))


NEEDS_COMPILER = pytest.mark.skipif(COMPILER is None, reason="there is no C++ compiler")


@NEEDS_COMPILER
@pytest.mark.parametrize("rule", RULES)
def test_a_rule_has_the_value_of_python(rule: str, computed: dict[str, Tensor]) -> None:
    assert_close(computed[rule], RULES[rule](X), rtol=1e-6, atol=1e-7)


@NEEDS_COMPILER
@pytest.mark.parametrize("slope", SLOPES)
def test_a_derivative_is_that_of_the_rule_in_python(slope: str, computed: dict[str, Tensor]) -> None:
    x = X.double().requires_grad_()
    (expected,) = torch.autograd.grad(RULES[SLOPES[slope]](x).sum(), x)
    assert_close(computed[slope], expected.float(), rtol=1e-5, atol=1e-6)


def test_every_rule_of_the_header_is_compared() -> None:
    """Those without limits, and the two shares of a layer, are tested by the rules that call them."""
    header = (ROOT / "torchdof" / "native" / "src" / "rules.h").read_text()
    names = set(re.findall(r"^inline \w+ (\w+)\(", header, re.MULTILINE))
    tested = set(re.findall(r"\w+(?=\()", " ".join([*RULES, *SLOPES])))
    called = {name for name in names if name.startswith("unlimited_")} | {"eased", "at_or_behind", "behind"}
    assert names - called == (names & tested) - called


def test_rules_at_points_computed_by_hand() -> None:
    assert disocclusion.is_another_surface(torch.tensor([0.5, 1.0, 1.5])).tolist() == [0.0, 0.5, 1.0]
    assert disocclusion.own_end(torch.tensor([-8.0, -2.0, 2.0, 8.0])).tolist() == [-7.0, -2.0, 2.0, 9.0]
    mean = torch.tensor([-8.0, 1.0, 1.0, 0.0, 0.0])
    one_side = disocclusion._on_one_side(mean, torch.tensor([8.0, 4.5, 8.0, 0.0, 0.3]))
    assert one_side.tolist() == pytest.approx([1.0, 0.5, 0.0, 1.0, 0.7])
    assert disocclusion.is_read(torch.tensor([0.5, -0.75, 1.0]), 0.5).tolist() == [0.0, 0.5, 1.0]
    assert frame.visible_part(torch.tensor([0.0, 0.03, 0.5])).tolist() == pytest.approx([1.0, 0.5, 0.0])
    cover = torch.tensor([0.003, 0.053, 0.6])
    assert frame.continuation_weight(cover).tolist() == pytest.approx([0.0, 0.4735, 0.4])
    farther, cover, beyond = torch.tensor([[-1.0, -2.9, -1.0, -1.0], [1.0, 1.0, 0.5, 1.0], [1.0, 0.0, 0.0, 0.97]])
    assert frame.is_clear(torch.tensor(-4.0), farther, cover, beyond).tolist() == pytest.approx([1.0, 0.5, 0.5, 0.5])
    assert frame.end_of_surface(torch.tensor([-8.0, -1.0, 0.0, 6.0])).tolist() == pytest.approx([-5.2, 0.0, 1.0, 8.1])
    assert frame.at_focus(torch.tensor([-1.0, -0.1, 0.0, 5.0])).tolist() == pytest.approx([0.0, 0.75, 1.0, 1.0])
    assert frame.stands_in(torch.tensor([-3.5, -2.25, -1.0, -0.0125, 1.0])).tolist() == pytest.approx(
        [0, 0.5, 1, 0.25, 0]
    )
    assert frame.counts(torch.tensor([0.0, 0.0012, 0.003])).tolist() == pytest.approx([0.0, 0.5, 1.0])
    weights = torch.tensor([0.0, 0.001, 0.1])
    assert composite.raised(weights, weights).tolist() == pytest.approx([0.001, 0.001, 0.1])
