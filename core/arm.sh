#!/usr/bin/env bash
# The wheel for aarch64, made by zig, and the tests of the core on it under qemu, with a Python of Debian 13 for that
# machine, which is unpacked and not installed. pip and python are those on the PATH.
set -euo pipefail
cd "$(dirname "$0")/.."
out=build/arm
target=aarch64-linux-gnu.2.28
python -c "import ziglang" 2>/dev/null || pip install --quiet --constraint constraints.txt ziglang
rm -rf $out/wheel && ECHOGRID_ZIG_TARGET=$target pip wheel --quiet --no-build-isolation --no-deps --wheel-dir $out/wheel .
ls -sh $out/wheel/*.whl

skip() {
    echo "arm: $1, so the tests of the core do not run on the wheel"
    exit 0
}
command -v qemu-aarch64-static >/dev/null || skip "found no qemu-aarch64-static (Debian's qemu-user-static)"
command -v apt-get >/dev/null || skip "found no apt-get to fetch a Python for aarch64 with"

# Debian's Python for that machine, by an apt that knows no other and leaves that of the system alone.
root=$PWD/$out/root
if [ ! -x "$root/usr/bin/python3.13" ]; then
    apt=$PWD/$out/apt
    mkdir -p "$apt"/{etc/apt/apt.conf.d,etc/apt/preferences.d,var/lib/apt/lists/partial,var/cache/apt/archives/partial}
    mkdir -p "$apt/var/lib/dpkg" "$apt/debs" && touch "$apt/var/lib/dpkg/status"
    mirror=$(sed -nE 's/^(URIs: |deb (\[.*\] )?)(http[^ ]*\/debian)\/?( .*)?$/\3/p' \
        /etc/apt/sources.list.d/debian.sources /etc/apt/sources.list 2>/dev/null | head -1 || true)
    [ -n "$mirror" ] || skip "found no mirror of Debian among the sources of apt"
    echo "deb [arch=arm64 signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] $mirror trixie main" >"$apt/sources"
    options=(-o "Dir=$apt" -o "Dir::Etc::sourcelist=$apt/sources" -o Dir::Etc::sourceparts=- -o APT::Architecture=arm64
        -o APT::Architectures=arm64 -o Dir::Bin::Methods=/usr/lib/apt/methods -o APT::Sandbox::User=root)
    apt-get "${options[@]}" -qq update || skip "could not read Debian's list of packages"
    (cd "$apt/debs" && apt-get "${options[@]}" -qq download python3.13-minimal libpython3.13-minimal \
        libpython3.13-stdlib libc6 libexpat1 zlib1g libssl3t64 libzstd1 libffi8 libbz2-1.0 liblzma5 libsqlite3-0 libuuid1 \
        libgcc-s1 libstdc++6) || skip "could not fetch Debian's Python for aarch64"
    mkdir -p "$root"/usr/{lib,bin} && ln -sfn usr/lib "$root/lib" && ln -sfn usr/bin "$root/bin"
    for package in "$apt"/debs/*.deb; do dpkg -x "$package" "$root"; done
fi
platforms=()
for glibc in 17 27 28; do platforms+=(--platform manylinux_2_${glibc}_aarch64); done
rm -rf $out/site
pip install --quiet --target $out/site --only-binary :all: --implementation cp --python-version 3.13 "${platforms[@]}" \
    --platform manylinux2014_aarch64 --constraint constraints.txt numpy scipy pytest hypothesis jaxtyping beartype pyyaml
python -m zipfile -e $out/wheel/*.whl $out/site
cat >$out/python <<END
#!/bin/sh
exec qemu-aarch64-static -L "$root" "$root/usr/bin/python3.13" "\$@"
END
chmod +x $out/python
# Tests that start a Python start it the same way.
echo "import sys; sys.executable = '$PWD/$out/python'" >$out/site/sitecustomize.py
# What the kernels make of random things here, to compare theirs with.
python tests/kernel_samples.py $out/here.npz
# What is compiled once is kept: qemu compiles slowly, and each test that starts a Python would do it again. The tests
# are those of what a processor has of its own: kernels (compared with those of this machine), denormals, threads. The
# rest of the core is the same C++ everywhere, and hundreds of random examples of it take too long here.
ECHOGRID_SAMPLES=$PWD/$out/here.npz PYTHONDONTWRITEBYTECODE= PYTHONPATH=$PWD/$out/site $out/python -u -m pytest \
    -o addopts="-q --strict-markers --import-mode=importlib" -p no:cacheprovider --durations=5 \
    tests/core/test_{instructions,denormals,score,pool}.py
