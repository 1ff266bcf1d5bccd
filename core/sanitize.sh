#!/usr/bin/env bash
# The tests of the core with every access and every operation checked. Python, cmake and ninja are those on the PATH.
set -euo pipefail
cd "$(dirname "$0")/.."
asan=$(c++ -print-file-name=libasan.so 2>/dev/null) || asan=
if [ ! -f "$asan" ]; then
    echo "sanitize: found no GCC with its sanitizers, so the core is not checked"
    exit 0
fi
out=build/sanitize
cmake -G Ninja -S core -B $out/core -DECHOGRID_SANITIZE=ON -DECHOGRID_WERROR=ON -DPython_EXECUTABLE="$(command -v python)" >/dev/null
cmake --build $out/core
# The package again, with this core in it. What the interpreter leaks is not ours.
rm -rf $out/site && mkdir -p $out/site && cp -R src/echogrid $out/site/ && rm -f $out/site/echogrid/_core*.so
cmake --install $out/core --prefix $out/site >/dev/null
PYTHONPATH=$out/site LD_PRELOAD="$asan $(c++ -print-file-name=libstdc++.so)" ASAN_OPTIONS=detect_leaks=0 \
    UBSAN_OPTIONS=print_stacktrace=1 python -m pytest -n 0 -p no:cacheprovider tests/core
