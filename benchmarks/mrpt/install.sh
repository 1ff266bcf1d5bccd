#!/bin/sh
# Installs MRPT from Debian's packages and builds the harnesses that benchmarks/mrpt.py and mrpt_position.py run, in
# build/ beside this file.
set -eu

fail() {
    echo "benchmarks/mrpt/install.sh: $1" >&2
    exit 2
}

command -v apt-get >/dev/null 2>&1 || fail "found no apt-get, expected Debian or Ubuntu (MRPT comes from their packages)"
as_root=
if [ "$(id -u)" -ne 0 ]; then
    command -v sudo >/dev/null 2>&1 || fail "found neither root nor sudo, expected one of them to install packages"
    as_root=sudo
fi

here=$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd)
$as_root apt-get update -q
$as_root env DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends \
    g++ make cmake libmrpt-maps-dev libmrpt-obs-dev libmrpt-slam-dev

cmake -S "$here" -B "$here/build"
cmake --build "$here/build"
echo "built $here/build/mrpt_grid and $here/build/mrpt_position"
