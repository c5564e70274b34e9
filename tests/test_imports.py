"""Imports: a folder imports only folders below it, and heavy packages are loaded only when they are used."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import torchdof
from tests.processes import output_of

ROOT = Path(__file__).parents[1]
FOLDERS = {"torchdof": "torchdof", "torchdof.fit": "fit", "torchdof.export": "export"}

# Folder or module of torchdof -> those that it may import; the lowest first.
ALLOWED = {
    "native": set(),
    "pixels": set(),
    "tensors": set(),
    "validation": {"native", "tensors"},
    "batch": {"tensors", "validation"},
    "io": {"validation"},
    "optics": {"tensors", "validation", "native", "io"},
    "options": {"validation", "optics"},
    "render": {"tensors", "validation", "pixels", "native", "optics", "options"},
    "depth": {"tensors", "validation", "io", "optics", "render"},
    "reference": {"validation", "io", "optics", "render"},
    "module": {"tensors", "validation", "batch", "optics", "options", "render"},
    "functional": {"tensors", "validation", "batch", "optics"},
    "fit": {"validation", "io", "optics"},
    "export": {"pixels", "tensors", "validation", "io", "optics", "options", "render", "reference", "module"},
    "augmentation": {"tensors", "validation", "io", "optics", "options", "module"},
    "distributed": {"validation", "io", "depth", "render", "module", "augmentation"},
    "bench": {"validation", "io", "optics", "reference", "module", "export"},
    "cli": {
        *("tensors", "validation", "native", "io", "optics", "depth", "options", "render", "module"),
        *("fit", "export", "bench"),
    },
}
MAX_LEVELS = 10  # of folders, and of files below torchdof.module


def modules() -> dict[str, Path]:
    """Dotted name -> file, of every module that is shipped."""
    found = {}
    for package, folder in FOLDERS.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = [package, *path.relative_to(ROOT / folder).with_suffix("").parts]
            found[".".join(parts).removesuffix(".__init__")] = path
    return found


FILES = modules()
HOMES = {name: f"torchdof.{home}" for name, home in torchdof._HOMES.items()}


def folder_of(module: str) -> str:
    return (module.split(".") + [""])[1]


def imports(module: str, for_types: bool = False) -> Iterator[str]:
    """Modules of torchdof that a module imports, anywhere in its file; under ``TYPE_CHECKING`` only if `for_types`."""
    path = FILES[module]
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    tree = ast.parse(path.read_text(encoding="utf-8"))
    checked = {
        id(node)
        for branch in ast.walk(tree)
        if isinstance(branch, ast.If) and isinstance(branch.test, ast.Name) and branch.test.id == "TYPE_CHECKING"
        for node in ast.walk(branch)
        if not for_types
    }
    for node in ast.walk(tree):
        if id(node) in checked:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in FILES)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
            source = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                name = f"{source}.{alias.name}"
                found = name if name in FILES else HOMES.get(alias.name, source) if source == "torchdof" else source
                if found in FILES:
                    yield found


GRAPH = {module: set(imports(module)) - {module} for module in FILES}


def levels(graph: dict[str, set[str]]) -> list[set[str]]:
    """Modules by level: level 0 imports nothing, level n only lower ones. The last set has those in import cycles."""
    left, found = dict(graph), list[set[str]]()
    while level := {name for name, targets in left.items() if not targets & set(left)}:
        found.append(level)
        left = {name: targets for name, targets in left.items() if name not in level}
    return [*found, set(left)]


def test_every_file_has_a_folder_and_folders_have_at_most_ten_levels() -> None:
    below: set[str] = set()
    for folder, allowed in ALLOWED.items():
        assert allowed <= below, folder
        below.add(folder)
    *found, cyclic = levels(ALLOWED)
    assert cyclic == set() and len(found) <= MAX_LEVELS
    assert {folder_of(module) for module in FILES} - {"", "__main__"} <= set(ALLOWED)


def test_the_module_imports_at_most_ten_levels_of_files() -> None:
    """A file is one level above the highest file that it imports."""
    *found, _ = levels(GRAPH)
    (level,) = (number for number, files in enumerate(found, 1) if "torchdof.module" in files)
    assert level <= MAX_LEVELS


@pytest.mark.parametrize("folder", ALLOWED)
def test_a_folder_imports_only_folders_below_it(folder: str) -> None:
    wrong = [
        f"{module} imports {target}"
        for module, targets in GRAPH.items()
        if folder_of(module) == folder
        for target in sorted(targets)
        if folder_of(target) not in {folder, *ALLOWED[folder]}
    ]
    assert wrong == []


def test_no_imports_are_cyclic_not_even_those_for_the_type_checker_up_to_the_module() -> None:
    assert sorted(levels(GRAPH)[-1]) == []
    graph = {module: set(imports(module, for_types=True)) - {module, "torchdof"} for module in FILES}
    below = {"optics", "options", "render", "depth", "module", "export"}
    assert [module for module in levels(graph)[-1] if folder_of(module) in below] == []


@pytest.mark.parametrize(("half", "other"), [("photo", "lens"), ("lens", "photo")])
def test_fit_photo_and_fit_lens_do_not_import_each_other(half: str, other: str) -> None:
    targets = [t for module, imported in GRAPH.items() if module.startswith(f"torchdof.fit.{half}") for t in imported]
    assert [target for target in targets if target.startswith(f"torchdof.fit.{other}")] == []


def loaded(code: str, *names: str) -> list[str]:
    """Which of the packages `names` are loaded after `code` has run in a new process."""
    script = f"import sys\n{code}\nprint([name for name in {names!r} if name in sys.modules])"
    return list(ast.literal_eval(output_of(script, flags=["-W", "error"]).splitlines()[-1]))


HEAVY = ["scipy", "onnx", "onnxruntime", "onnxscript", "OpenImageIO", "matplotlib"]
HEAVY += ["kornia", "click", "rich", "torch._dynamo"]
PUBLIC = f"""
import torchdof
for name in torchdof.__all__:
    getattr(torchdof, name)
heavy = [name for name in {HEAVY} if name in sys.modules]
assert heavy == [], heavy
"""


FIRST = """
import torch
from torchdof import BlurTable, Camera, DepthOfField
dof = DepthOfField(Camera(focus_m=1.0, sensor_width_mm=4.0), BlurTable.polygon(6))
image, depth = torch.rand(2, 3, 24, 32), 1 + torch.rand(2, 1, 24, 32).requires_grad_()
with torch.no_grad():
    assert not torch.equal(dof(image, depth, focus_m=[1.0, 1.5]), image)
from torchdof.functional import splat
dof(image, depth).sum().backward()
splat(image, depth).sum().backward()
"""


def test_public_names_and_a_first_picture_with_gradients_load_nothing_heavy(engine: str) -> None:
    """Sympy and the compiler take a second, and eager code needs neither."""
    assert loaded(PUBLIC + FIRST, "sympy", "torch._dynamo", "torch._inductor", "kornia") == []


WITHOUT_PYTORCH = [
    ["--help"],
    ["no-such-command"],
    *([command, "--help"] for command in ("render", "fit", "export", "bench", "inspect", "tables")),
    *([command, "--no-such-option"] for command in ("render", "fit", "export", "bench", "inspect", "tables")),
    ["render", "a.png", "d.png", "-o", "o.png", "--f-number", "wide"],
    ["render", "a.png", "d.png", "-o", "o.png", "--focus-m", "2", "--focus-at", "3,4"],
    ["render", "a.png", "d.png", "-o", "o.png", "--depth-kind", "z", "--near-m", "1"],
    ["render", "a.png", "d.png", "-o", "o.png", "--tolerance", "best"],
    ["render", "a.####.png", "d.png", "-o", "o.####.png", "--frames", "1-"],
    ["inspect", "a.png", "d.png", "--depth-kind", "coc"],
    ["render", "a.png", "d.png", "-o", "o.png", "--f-number", "0"],
    ["render", "none.png", "d.png", "-o", "o.png"],
    ["render", "pyproject.toml", "-o", "o.png"],
    ["inspect", "none.png"],
    ["bench", "none.png"],
    ["bench", "--views", "3"],
    ["export"],
    ["fit"],
    ["tables", "--rotation", "5"],
]


def test_the_command_line_answers_without_pytorch() -> None:
    code = f"""
from torchdof.cli.main import main
for arguments in {WITHOUT_PYTORCH!r}:
    sys.argv = ["torchdof", *arguments]
    try:
        main()
    except SystemExit as end:
        assert end.code == (0 if "--help" in arguments else 2), (arguments, end.code)
    else:
        raise AssertionError(arguments)
    assert "torch" not in sys.modules, arguments
"""
    assert loaded(code, "torch", "numpy", "kornia", "scipy", "onnx", "rich") == []
