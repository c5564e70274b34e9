"""A tuned number has one definition, in Python; the build writes the C++ headers from it (`cmake/constants.py`)."""

import importlib
import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from torchdof import native
from torchdof.kernels import loader

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "cmake" / "constants.py"
SOURCES = sorted(
    file for name in ("native", "native/src", "kernels") for file in (ROOT / "torchdof" / name).glob("*.[ch]*")
)
DEFINITION = re.compile(r"constexpr \w+ (\w+)(?:\[\])? = (.*);")


def script() -> Any:
    spec = importlib.util.spec_from_file_location("constants_script", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


CONSTANTS = script()
MODULES = {name.removesuffix("/__init__"): name for name in CONSTANTS.MODULES}


def written(text: str) -> dict[str, Any]:
    """Values that a header defines, by name."""
    values = {}
    for name, value in DEFINITION.findall(text):
        assert name not in values
        numbers = [float(number) for number in re.findall(r"[-+.\de]+", value)]
        values[name] = tuple(numbers) if value.startswith("{") else numbers[0]
    return values


def numbers_of(module: ModuleType, source: str) -> dict[str, Any]:
    """Values of the names in capitals that a module assigns, as its running code has them."""
    targets = re.findall(r"^([A-Z_][A-Z0-9_]*(?:, [A-Z_][A-Z0-9_]*)*)(?:: [^=]*)? = ", source, re.MULTILINE)
    names = {name for target in targets for name in target.split(", ")}
    values = {name.lstrip("_"): getattr(module, name, None) for name in names}
    kinds = (int, float)
    return {
        name: value
        for name, value in values.items()
        if type(value) in kinds or (type(value) is tuple and value and all(type(item) in kinds for item in value))
    }


@pytest.mark.parametrize("name", MODULES)
def test_a_header_has_each_number_that_its_python_module_defines(name: str) -> None:
    module = importlib.import_module(f"torchdof.{name.replace('/', '.')}")
    source = (ROOT / "torchdof" / f"{MODULES[name]}.py").read_text()
    assert written(CONSTANTS.headers()[name.rpartition("/")[2]]) == numbers_of(module, source)


def test_a_number_changed_in_python_reaches_the_header(tmp_path: Path) -> None:
    """As the build runs it: on a copy of the sources, with a Python that has no packages."""
    for name in CONSTANTS.MODULES:
        copy = tmp_path / "torchdof" / f"{name}.py"
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text((ROOT / "torchdof" / f"{name}.py").read_text())
    (tmp_path / "torchdof" / "native" / "api.h").write_text((ROOT / "torchdof" / "native" / "api.h").read_text())
    (tmp_path / "cmake").mkdir()
    (tmp_path / "cmake" / "constants.py").write_text(SCRIPT.read_text())

    def build() -> dict[str, str]:
        out = tmp_path / "constants"
        subprocess.run([sys.executable, "-S", "-E", tmp_path / "cmake" / "constants.py", out], check=True)
        return {file.stem: file.read_text() for file in out.iterdir()}

    before = build()
    changed = tmp_path / "torchdof" / "render" / "surfaces" / "disocclusion.py"
    changed.write_text(re.sub(r"\n_FALL = \S+", "\n_FALL = 0.25", changed.read_text()))
    after = build()
    assert written(after["disocclusion"]) == written(before["disocclusion"]) | {"FALL": 0.25}
    assert {name for name in before if before[name] != after[name]} == {"disocclusion", "checksum"}


@pytest.mark.skipif(not native.chosen(), reason="the compiled engine is not built")
def test_the_engine_was_compiled_with_the_numbers_of_these_sources() -> None:
    """`make install` compiles it again after a number has changed."""
    checksums = written(CONSTANTS.headers()["checksum"])
    assert native._engine().torchdof_constants() == checksums["ALL"]
    assert native._engine().torchdof_interface() == checksums["INTERFACE"]


@pytest.mark.parametrize("name", loader.HEADERS)
def test_the_kernels_include_the_headers_of_these_sources(name: str) -> None:
    """`make install` installs them again after a number or a rule has changed."""
    if name.startswith("constants/"):
        assert loader.text(name) == CONSTANTS.headers()[Path(name).stem]
    else:
        folder = "kernels" if (ROOT / "torchdof" / "kernels" / name).exists() else "native/src"
        assert loader.text(name) == (ROOT / "torchdof" / folder / name).read_text()


def test_no_source_of_the_engine_defines_a_number_that_python_defines() -> None:
    """Neither under the same name, nor the value of one that is hardly used by chance."""
    known = {pair for text in CONSTANTS.headers().values() for pair in written(text).items()}
    telling = {value for _, value in known if isinstance(value, float) and is_telling(value)}
    copies = []
    for source in SOURCES:
        for line in source.read_text().splitlines():
            code = line.partition("//")[0]
            named = re.findall(r"\b([A-Z]\w+) = (-?[.\d]+(?:e-?\d+)?)f?\b", code)
            copies += [f"{source.name}: {line}" for name, literal in named if (name, float(literal)) in known]
            literals = re.findall(r"(?<![\w.])(\d+\.\d*(?:e-?\d+)?|\d+e-?\d+)f?\b", code)
            copies += [f"{source.name}: {line}" for literal in literals if float(literal) in telling]
    assert copies == []


def is_telling(value: float) -> bool:
    """Whether a number is not 0, a power of ten, or a multiple of 1/16."""
    return value * 16 % 1 != 0 and f"{value:e}".partition("e")[0].strip("0.") != "1"
