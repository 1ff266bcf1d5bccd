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
# The package again, with this core in it. What the interpreter leaks is not ours. A report ends the process, so nothing
# may hold back what it says.
rm -rf $out/site && mkdir -p $out/site && cp -R src/echogrid $out/site/ && rm -f $out/site/echogrid/_core*.so
cmake --install $out/core --prefix $out/site >/dev/null
# An editable install of the package stands in front of PYTHONPATH; it is taken away, and that is looked at.
echo "import sys; sys.meta_path = [each for each in sys.meta_path if 'editable' not in type(each).__module__]" \
    >$out/site/sitecustomize.py
export PYTHONPATH=$PWD/$out/site ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1
export LD_PRELOAD="$asan $(c++ -print-file-name=libstdc++.so)"
python -c "from echogrid import _core; assert _core.__file__.startswith('$PWD/$out/site/'), _core.__file__"
python -m pytest -s -n 0 -p no:cacheprovider tests/core
