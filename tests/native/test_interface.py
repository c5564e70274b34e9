"""Python takes structures and functions from the header of the engine, as a compiler does."""

import ctypes
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from torchdof.native import read_header

HEADER = Path(__file__).parents[2] / "torchdof" / "native" / "api.h"
COMPILER = os.environ.get("CXX") or shutil.which("c++")
API = read_header(HEADER.read_text())


@pytest.mark.skipif(COMPILER is None, reason="there is no C++ compiler")
def test_each_field_lies_where_the_compiler_puts_it(tmp_path: Path) -> None:
    """Size of each structure, offset and size of each field, and value of each constant."""
    shown, expected = [], []
    for name, structure in API.structures.items():
        shown.append(f"sizeof(torchdof_{name})")
        expected.append(ctypes.sizeof(structure))
        for field, *_ in structure._fields_:
            shown += [f"offsetof(torchdof_{name}, {field})", f"sizeof(torchdof_{name}::{field})"]
            expected += [getattr(structure, field).offset, getattr(structure, field).size]
    shown += [f"TORCHDOF_{name}" for name in API.constants]
    lines = "".join(f'  std::printf("%d ", (int)({each}));\n' for each in shown)
    program = f'#include <cstddef>\n#include <cstdio>\n#include "{HEADER}"\nint main() {{\n{lines}}}\n'
    (tmp_path / "fields.cpp").write_text(program)
    subprocess.run([COMPILER or "c++", "-std=c++17", "fields.cpp", "-o", "fields"], check=True, cwd=tmp_path)
    out = subprocess.run([tmp_path / "fields"], check=True, capture_output=True, text=True).stdout
    assert [int(number) for number in out.split()] == [*expected, *API.constants.values()]


def test_types_of_functions_and_fields() -> None:
    """A pointer to floats is any pointer, because tensors are passed as addresses."""
    header = """
        #define TORCHDOF_API extern
        enum { TORCHDOF_A = 3, TORCHDOF_B = 4, };  // with a comment; and another
        typedef struct torchdof_job torchdof_job;
        typedef struct {
          const float *const *light;
          const double *part, *finer;
          int32_t a, b;
        } torchdof_pair;
        TORCHDOF_API int64_t torchdof_next(const torchdof_pair *pair, torchdof_job **job, const volatile int32_t *n,
                                           float scale);
        TORCHDOF_API void torchdof_end(void);
    """
    found = read_header(header)
    assert found.constants == {"A": 3, "B": 4}
    pair, data, double = found.structures["pair"], ctypes.c_void_p, ctypes.POINTER(ctypes.c_double)
    light, job = ctypes.POINTER(data), ctypes.POINTER(data)
    fields = [("light", light), ("part", double), ("finer", double), ("a", ctypes.c_int32), ("b", ctypes.c_int32)]
    assert pair._fields_ == fields
    arguments = [ctypes.POINTER(pair), job, ctypes.POINTER(ctypes.c_int32), ctypes.c_float]
    assert found.functions == {"next": (ctypes.c_int64, arguments), "end": (None, [])}


@pytest.mark.parametrize(
    "declaration",
    [
        "typedef struct { unsigned a; } torchdof_a;",
        "typedef struct { int32_t a[3]; } torchdof_a;",
        "typedef struct { int32_t a : 3; } torchdof_a;",
        "typedef struct { union { float a; int32_t b; }; } torchdof_a;",
        "typedef struct { int32_t a; } another;",
        "typedef int32_t torchdof_a;",
        "enum { TORCHDOF_A };",
        "TORCHDOF_API int32_t torchdof_a(void (*call)(void));",
        "TORCHDOF_API size_t torchdof_a(void);",
        "TORCHDOF_API int32_t torchdof_a(int32_t);",
        "TORCHDOF_API int32_t torchdof_a(void)",
        "int32_t torchdof_a(void);",
    ],
)
def test_a_declaration_that_the_reader_does_not_know_is_refused_by_its_text(declaration: str) -> None:
    with pytest.raises(ValueError, match="reader in native/__init__.py does not know: ") as error:
        read_header(f"enum {{ TORCHDOF_OK = 0 }};\n{declaration}\n")
    assert declaration.split()[0] in str(error.value)


def test_the_checksum_changes_with_the_header() -> None:
    text = HEADER.read_text()
    assert read_header(text + "// another comment\n").checksum != API.checksum == read_header(text).checksum
