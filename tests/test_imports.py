"""Imports: a folder imports only folders below it, and heavy packages are loaded only when they are used."""

import ast
import graphlib
import importlib.util
from collections.abc import Iterator
from pathlib import Path

import torchdof
from tests.processes import output_of

ROOT = Path(__file__).parents[1]
FOLDERS = {"torchdof": "torchdof", "torchdof.fit": "fit", "torchdof.export": "export"}

# Folder or module of torchdof -> those that it may import; the lowest first.
ALLOWED = {
    "extras": set(),
    "kernels": set(),
    "native": set(),
    "pixels": set(),
    "tensors": set(),
    "validation": {"native", "tensors"},
    "batch": {"tensors", "validation"},
    "io": {"validation"},
    "optics": {"tensors", "validation", "native", "io"},
    "options": {"validation", "optics"},
    "render": {"tensors", "validation", "pixels", "kernels", "native", "optics", "options"},
    "depth": {"tensors", "validation", "io", "optics", "render"},
    "reference": {"validation", "io", "optics", "render"},
    "module": {"tensors", "validation", "batch", "optics", "options", "render"},
    "functional": {"validation", "batch", "optics", "options", "render"},
    "fit": {"extras", "validation", "io", "optics"},
    "export": {"extras", "pixels", "tensors", "validation", "io", "optics", "options", "render", "reference", "module"},
    "augmentation": {"tensors", "validation", "io", "optics", "options", "module"},
    "distributed": {"extras", "validation", "io", "depth", "render", "module", "augmentation"},
    "bench": {"validation", "io", "optics", "render", "reference", "module", "export"},
    "cli": {
        *("tensors", "validation", "native", "io", "optics", "depth", "options", "render", "module"),
        *("extras", "fit", "export", "bench"),
    },
    "photograph": {"validation", "io", "optics", "cli"},
}


FILES = {  # dotted name -> file, of every module that is shipped
    ".".join([package, *path.relative_to(ROOT / folder).with_suffix("").parts]).removesuffix(".__init__"): path
    for package, folder in FOLDERS.items()
    for path in sorted((ROOT / folder).rglob("*.py"))
}
HOMES = {name: f"torchdof.{home}" for name, home in torchdof._HOMES.items()}


def folder_of(module: str) -> str:
    return (module.split(".") + [""])[1]


def imports(module: str) -> Iterator[str]:
    """Modules of torchdof that a module imports, anywhere in its file; for types alone not in "cli" and "fit"."""
    path = FILES[module]
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for branch in ast.walk(tree) if folder_of(module) in ("", "cli", "fit") else ():
        if isinstance(branch, ast.If) and ast.unparse(branch.test) == "TYPE_CHECKING":
            branch.body.clear()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in FILES)
        elif isinstance(node, ast.ImportFrom):
            source = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            for alias in node.names:
                name = f"{source}.{alias.name}"
                found = name if name in FILES else HOMES.get(alias.name, source) if source == "torchdof" else source
                if found in FILES:
                    yield found


GRAPH = {module: set(imports(module)) - {module} for module in FILES}


def test_no_imports_are_cyclic_and_the_module_imports_at_most_ten_levels_of_files() -> None:
    """A file is one level above the highest file that it imports."""
    level: dict[str, int] = {}
    for module in graphlib.TopologicalSorter(GRAPH).static_order():
        level[module] = 1 + max((level[file] for file in GRAPH[module]), default=0)
    assert level["torchdof.module"] <= 10


def test_every_file_has_a_folder_which_imports_only_folders_below_it() -> None:
    for place, (folder, allowed) in enumerate(ALLOWED.items()):
        assert allowed <= set([*ALLOWED][:place]), folder
    for module in GRAPH:
        if (folder := folder_of(module)) not in ("", "__main__"):
            assert set(map(folder_of, GRAPH[module])) <= {folder, *ALLOWED[folder]}, module
    # fit.photo and fit.lens do not import each other
    halves = {module: (module.split(".") + ["", ""])[2] for module in GRAPH if folder_of(module) == "fit"}
    pairs = {(half, halves.get(target)) for module, half in halves.items() for target in GRAPH[module]}
    assert not pairs & {("photo", "lens"), ("lens", "photo")}


def loaded(code: str, *names: str) -> list[str]:
    """Which of the packages `names` are loaded after `code` has run in a new process."""
    script = f"import sys\n{code}\nprint([name for name in {names!r} if name in sys.modules])"
    return list(ast.literal_eval(output_of(script, flags=["-W", "error"]).splitlines()[-1]))


HEAVY = ["scipy", "onnx", "onnxruntime", "onnxscript", "OpenImageIO", "matplotlib", "kornia", "click", "rich"]
HEAVY += ["sympy", "torch._dynamo", "torch._inductor"]  # which take a second
FIRST = """
import torch
from torchdof import *
torch.set_num_threads(2)
dof = DepthOfField(Camera(focus_m=1.0, sensor_width_mm=4.0), BlurTable.polygon(6))
image, depth = torch.rand(2, 3, 24, 32), 1 + torch.rand(2, 1, 24, 32).requires_grad_()
with torch.no_grad():
    assert not torch.equal(dof(image, depth, focus_m=[1.0, 1.5]), image)
from torchdof.functional import splat
dof(image, depth).sum().backward()
splat(image, depth).sum().backward()
"""


def test_public_names_and_a_first_picture_with_gradients_load_nothing_heavy(engine: str) -> None:
    assert loaded(FIRST, *HEAVY) == []


WITHOUT_PYTORCH = [
    *(f"{command} --help" for command in ("", "render", "fit", "export", "bench", "inspect", "tables")),
    *(f"{command} --no-such-option" for command in ("render", "fit", "export", "bench", "inspect", "tables")),
    *(f"render a.png d.png -o o.png {wrong}" for wrong in (
        "--f-number wide", "--f-number 0", "--focus-m 2 --focus-at 3,4", "--depth-kind z --near-m 1",
        "--tolerance best")),
    "render a.####.png d.png -o o.####.png --frames 1-",
    *("render none.png d.png -o o.png", "render pyproject.toml -o o.png"),
    *("inspect a.png d.png --depth-kind coc", "inspect none.png", "bench none.png", "bench --views 3"),
    *("no-such-command", "export", "fit", "render a.png d.png -o o.png --rotation 5"),
]  # fmt: skip


def test_the_command_line_answers_without_pytorch() -> None:
    code = f"""
from torchdof.cli.main import main
for arguments in {WITHOUT_PYTORCH!r}:
    sys.argv = ["torchdof", *arguments.split()]
    try:
        main()
    except SystemExit as end:
        assert end.code == (0 if "--help" in arguments else 2), (arguments, end.code)
    else:
        raise AssertionError(arguments)
    assert "torch" not in sys.modules, arguments
"""
    assert loaded(code, "torch", "numpy", "kornia", "scipy", "onnx", "rich") == []


def test_a_checkout_has_the_packages_that_lie_beside_it(tmp_path: Path) -> None:
    """Without the finder of an editable install, as where the folder of the repository hides an installed package."""
    script = f"""
import sys
sys.meta_path[:] = [finder for finder in sys.meta_path if "editable" not in type(finder).__module__]
sys.path.insert(0, {str(ROOT)!r})
import torchdof.fit, torchdof.export
print(torchdof.fit.__file__)
"""
    assert output_of(script).splitlines()[-1] == str(ROOT / "fit" / "__init__.py")


def test_a_missing_package_of_an_extra_is_named_with_what_installs_it() -> None:
    script = """
import sys
sys.modules |= {"scipy": None, "onnx": None}
for name in ("torchdof.fit", "torchdof.export"):
    try:
        __import__(name)
    except ModuleNotFoundError as error:
        print(error)
"""
    lines = output_of(script).splitlines()[-2:]
    assert [line.partition(";")[0] for line in lines] == ["torchdof.fit needs scipy", "torchdof.export needs onnx"]
    assert [line.rpartition("install ")[2] for line in lines] == ["'.[fit]'", "'.[export]'"]
