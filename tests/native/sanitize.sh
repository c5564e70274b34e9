#!/usr/bin/env bash
# The compiled engine under sanitizers: sanitize.sh PYTHON, a Python with torchdof's dependencies; needs GCC.
# Random scenes by many threads under ThreadSanitizer and AddressSanitizer with UBSan (driver.cpp),
# then the tests of this folder and of both engines, in Python, under AddressSanitizer. A report ends it with an error.
set -euo pipefail
python=$(realpath --no-symlinks "$1")
cd "$(dirname "$0")/../.."
export CXX="${CXX:-g++}"
export ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1

packages() { "$1" -c 'import sysconfig; print(sysconfig.get_path("purelib"))'; }

for kind in address thread; do
    build=build/sanitize/$kind
    "$python" -m venv --without-pip "$build/venv"
    packages "$python" >"$(packages "$build/venv/bin/python")/dependencies.pth" # without its editable torchdof
    "$python" -m pip install --quiet --no-deps --upgrade --target "$(packages "$build/venv/bin/python")" \
        -C build-dir="$build/cmake" -C cmake.define.TORCHDOF_SANITIZE=$kind .
    echo "driver, $kind sanitizer"
    for driver in "$build"/cmake/driver_engine*; do
        ASAN_OPTIONS=detect_leaks=1 "$driver" # the processor must have AVX2
    done
done

echo "tests of the engine, address sanitizer"
# What throws in other libraries must be found too, so the C++ library comes with the sanitizer's.
LD_PRELOAD="$("$CXX" -print-file-name=libasan.so) $("$CXX" -print-file-name=libstdc++.so.6)" TORCHDOF_ENGINE=native \
    build/sanitize/address/venv/bin/python -P -m pytest -p no:cacheprovider tests/native tests/test_engines.py -k "not file"
