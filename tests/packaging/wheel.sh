#!/usr/bin/env bash
# What people install, on machines without a compiler: wheel.sh PYTHON, a Python with pip.
# From a source distribution made of this folder it builds the wheel for this machine into dist/, installs it in an
# empty environment and tries it there; then installs the source distribution itself, which must do without the engine.
set -euo pipefail
python=$(realpath --no-symlinks "$1")
cd "$(dirname "$0")/../.."
here=$PWD
export PIP_CONSTRAINT="$here/constraints.txt" PIP_BUILD_CONSTRAINT="$here/constraints.txt"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
rm -rf dist

echo "building the source distribution and, from it, the wheel"
"$python" -m venv "$work/build"
"$work/build/bin/pip" install --quiet scikit-build-core setuptools-scm
"$work/build/bin/python" -c 'from scikit_build_core.build import build_sdist; build_sdist("dist")' >"$work/log" ||
    { cat "$work/log"; exit 1; }
"$python" -m pip wheel --quiet --no-deps --wheel-dir dist dist/*.tar.gz
ls -l dist

# Only Python and what it installs are found here, no compiler.
"$python" -m venv "$work/empty"
without_compiler() { (cd "$work" && env -u CC CXX="$work/none" PATH="$work/empty/bin" "$@"); }
if without_compiler "$BASH" -c 'command -v cc gcc g++ c++ clang cmake ninja'; then
    echo "there is a compiler after all"
    exit 1
fi

echo "the wheel, in an empty environment"
without_compiler pip install --quiet "$here"/dist/*.whl
without_compiler python "$here/tests/packaging/installed.py" native

echo "the source distribution, without a compiler"
without_compiler pip uninstall --quiet --yes torchdof
without_compiler pip install --quiet --no-deps "$here"/dist/*.tar.gz
without_compiler python "$here/tests/packaging/installed.py" torch
