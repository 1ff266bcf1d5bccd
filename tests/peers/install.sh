#!/bin/sh
# Installs, from Debian's packages, the programs of other people that tests talk to: rosbag (ROS 1), Fast DDS, Chromium,
# a compiler for ARM and an emulator. Without them those tests skip.
set -eu

fail() {
    echo "tests/peers/install.sh: $1" >&2
    exit 2
}

command -v apt-get >/dev/null 2>&1 || fail "found no apt-get, expected Debian or Ubuntu"
as_root=
if [ "$(id -u)" -ne 0 ]; then
    command -v sudo >/dev/null 2>&1 || fail "found neither root nor sudo, expected one of them to install packages"
    as_root=sudo
fi
$as_root apt-get update -q
$as_root env DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends \
    python3-rosbag python3-sensor-msgs python3-nav-msgs python3-tf2-msgs \
    g++ libfastrtps-dev fastddsgen iproute2 \
    chromium chromium-driver \
    gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-user
