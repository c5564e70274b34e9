"""Who imports whom: rooms import only rooms on lower floors, and what is not asked for is not loaded."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import torchdof

ROOT = Path(__file__).parents[1]
FOLDERS = {"torchdof": "torchdof", "torchdof.fit": "fit", "torchdof.export": "export"}

# Room -> what it may import, from the lowest floor up.
ROOMS = {
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
    "fit": {"validation", "io", "optics"},
    "export": {"pixels", "io", "optics", "options", "render", "reference", "module"},
    "augmentation": {"tensors", "validation", "io", "optics", "options", "module"},
    "distributed": {"validation", "io", "depth", "render", "module", "augmentation"},
    "bench": {"validation", "io", "optics", "reference", "module", "export"},
    "cli": {
        *("validation", "native", "io", "optics", "depth", "options", "render", "module"),
        *("fit", "export", "bench"),
    },
}
MOST_FLOORS = 10


def modules() -> dict[str, Path]:
    """Dotted name -> file, of everything that is shipped."""
    found = {}
    for package, folder in FOLDERS.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = [package, *path.relative_to(ROOT / folder).with_suffix("").parts]
            found[".".join(parts).removesuffix(".__init__")] = path
    return found


FILES = modules()
HOMES = {name: f"torchdof.{home}" for name, home in torchdof._HOMES.items()}


def room_of(module: str) -> str:
    return (module.split(".") + [""])[1]


def imports(module: str, for_types: bool = False) -> Iterator[str]:
    """Modules of ours that a module imports, anywhere in its file, also or not for the type checker alone."""
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


def floors(graph: dict[str, set[str]]) -> list[set[str]]:
    """What imports nothing, what imports only that, and so on upwards; the last is all that is in a circle."""
    left, found = dict(graph), list[set[str]]()
    while floor := {name for name, targets in left.items() if not targets & set(left)}:
        found.append(floor)
        left = {name: targets for name, targets in left.items() if name not in floor}
    return [*found, set(left)]


def test_rooms_hold_every_file_and_only_what_is_below_them_on_ten_floors() -> None:
    below: set[str] = set()
    for room, allowed in ROOMS.items():
        assert allowed <= below, room
        below.add(room)
    *found, circle = floors(ROOMS)
    assert circle == set() and len(found) <= MOST_FLOORS
    assert {room_of(module) for module in FILES} - {"", "__main__"} <= set(ROOMS)


def test_files_of_the_engine_have_ten_floors_at_most() -> None:
    """The module, and all that it stands on: a file is one floor above the highest that it imports."""
    *found, _ = floors(GRAPH)
    (floor,) = (number for number, files in enumerate(found, 1) if "torchdof.module" in files)
    assert floor <= MOST_FLOORS


@pytest.mark.parametrize("room", ["optics", "options", "render", "depth", "module", "export"])
def test_files_are_in_no_circle_even_to_the_type_checker(room: str) -> None:
    graph = {module: set(imports(module, for_types=True)) - {module, "torchdof"} for module in FILES}
    assert [module for module in floors(graph)[-1] if room_of(module) == room] == []


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_rooms_below_it(room: str) -> None:
    wrong = [
        f"{module} imports {target}"
        for module, targets in GRAPH.items()
        if room_of(module) == room
        for target in sorted(targets)
        if room_of(target) not in {room, *ROOMS[room]}
    ]
    assert wrong == []


def test_no_file_imports_itself_through_others() -> None:
    assert sorted(floors(GRAPH)[-1]) == []


@pytest.mark.parametrize(("wing", "other"), [("photo", "lens"), ("lens", "photo")])
def test_the_wings_of_fit_do_not_know_each_other(wing: str, other: str) -> None:
    wrong = [
        f"{module} imports {target}"
        for module, targets in GRAPH.items()
        if module.startswith(f"torchdof.fit.{wing}")
        for target in targets
        if target.startswith(f"torchdof.fit.{other}")
    ]
    assert wrong == []


@pytest.mark.parametrize("module", ["problems", "result", "solve", "validation"])
def test_what_both_wings_stand_on_knows_neither(module: str) -> None:
    targets = GRAPH[f"torchdof.fit.{module}"]
    assert not [target for target in targets if target.startswith(("torchdof.fit.photo", "torchdof.fit.lens"))]


def loaded(code: str, *names: str) -> list[str]:
    """Which of some packages are loaded once code has run in a fresh process."""
    told = f"import sys\n{code}\nprint([name for name in {names!r} if name in sys.modules])"
    run = subprocess.run([sys.executable, "-W", "error", "-c", told], capture_output=True, text=True, check=True)
    return list(ast.literal_eval(run.stdout.splitlines()[-1]))


HEAVY = (
    "scipy",
    "onnx",
    "onnxruntime",
    "onnxscript",
    "OpenImageIO",
    "matplotlib",
    "kornia",
    "click",
    "rich",
    "torch._dynamo",
)
PUBLIC = "import torchdof\nfor name in torchdof.__all__: getattr(torchdof, name)"


def test_public_names_load_nothing_heavy() -> None:
    assert loaded(PUBLIC, *HEAVY) == []


def test_rooms_below_the_engine_do_not_load_the_compiler() -> None:
    code = (
        "import torchdof.options, torchdof.depth, torchdof.io.images, torchdof.reference.metrics, torchdof.fit.result"
    )
    assert loaded(code, "torch._dynamo", "kornia", "OpenImageIO") == []


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
