"""Any argument of the fits gives a result or a named error."""

import inspect
import math
import re
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.hard.test_arguments import FEW, JUNK, NUMBERS
from torchdof.fit import (
    Capture,
    Captures,
    FitWarning,
    blur_strength,
    fit_captures,
    fit_pair,
    fit_profile,
    fit_table,
    natural_psnr,
    read_captures,
    trace_table,
)
from torchdof.fit.lens.lens import Lens
from torchdof.fit.lens.surface import Surface

pytestmark = pytest.mark.hard

ARRAYS = st.builds(
    lambda shape, value, kind: np.full(shape, value, dtype=kind),
    st.sampled_from([(), (0,), (3,), (0, 0), (15, 15), (20, 17), (3, 15, 15), (1, 1)]),
    st.sampled_from([0.0, 1.0, -1.0, math.nan, math.inf, 1e35]),
    st.sampled_from(["float64", "float32", "complex128", "object", "str"]),
)
ANYTHING = st.one_of(NUMBERS, ARRAYS, JUNK, st.tuples(NUMBERS, NUMBERS))


def dot(size: int = 31, sigma: float = 3.0) -> Any:
    y, x = np.indices((size, size)) - size // 2
    return np.exp(-(x**2 + y**2) / (2 * sigma**2))


def options_of(function: Callable[..., Any]) -> dict[str, Any]:
    """Optional arguments of a function with their defaults; without those of fields, and without mere labels."""
    given = inspect.signature(function).parameters
    omitted = ("files", "name", "notes", "field", "field_nodes", "field_rays")
    return {name: one.default for name, one in given.items() if one.default is not one.empty and name not in omitted}


SHARP, BLURRED = dot(), dot(sigma=4.0)
PAIR = Capture(SHARP, BLURRED, 1.5)
R = np.linspace(0, 8, 20)
LENS = Lens.read("double_gauss_50mm")
CALLS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "fit_profile": (fit_profile, {"r": R, "strength": dot(39)[19, 19:], "family": "gaussian", "groups": None}),
    "fit_pair": (fit_pair, {"sharp": SHARP, "blurred": BLURRED, "family": "gaussian"}),
    "fit_pair, options": (lambda **a: fit_pair(SHARP, BLURRED, **a), {**options_of(fit_pair), "family": "gaussian"}),
    "Captures": (Captures, {**options_of(Captures), "pairs": (PAIR,), "focus_m": 1.0, "width_px": 100}),
    "Capture": (lambda **a: Captures((Capture(**a),), 1.0, 100), {"sharp": SHARP, "blurred": SHARP, "distance_m": 2.0}),
    "fit_table": (fit_table, {"captures": None, "family": "gaussian"}),
    "fit_captures": (fit_captures, {"captures": None, "family": "gaussian"}),
    "blur_strength": (blur_strength, {"sharp": SHARP, "blurred": BLURRED}),
    "natural_psnr": (natural_psnr, {"kernel": SHARP, "other": BLURRED}),
    "trace_table": (
        trace_table,
        {**options_of(trace_table), "lens": None, "nodes": 5, "points": 9, "width_px": 100, "rays": 100}
    ),
    "Lens": (Lens, {"surfaces": LENS.surfaces, "stop": 0}),
    "Surface": (Surface, vars(LENS.surfaces[0])),
    "Lens.with_f_number": (LENS.with_f_number, {"f_number": 4.0}),
    "Lens.read": (Lens.read, {"source": "wide_22mm"}),
    "read_captures": (read_captures, {"folder": "nowhere"}),
}  # fmt: skip


EXPECTED = "must|need|at least|no such|no lens|negative|flat|no dot|give |takes|NaN|converge|pass|edge|expected|"
EXPECTED += "lies at|goes with|stand|can be read|nothing in common"


def check_error(call: Callable[[], Any]) -> None:
    """Runs a call; an error of it must be one sentence with the expected value."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)
        try:
            call()
        except (ValueError, FileNotFoundError) as error:
            message = str(error)
            assert 20 < len(message) < 1000
            assert re.search(EXPECTED, message), message


@pytest.mark.parametrize("name", CALLS)
@FEW
@given(st.data())
def test_any_argument_gives_a_result_or_a_named_error(name: str, data: st.DataObject) -> None:
    function, good = CALLS[name]
    most = data.draw(st.sampled_from([1, 1, 2, 8]), label="wrong arguments")
    wrong = data.draw(st.lists(st.sampled_from(sorted(good)), min_size=1, max_size=most, unique=True), label="which")
    arguments = {**good, **{k: data.draw(ANYTHING, label=k) for k in wrong}}
    if name == "trace_table" and "lens" not in wrong:
        arguments["lens"] = LENS
    check_error(lambda: function(**arguments))
