#!/bin/sh
# Builds the robot of tests/live and tests/cli into build/peers/fastdds; needs fastddsgen, g++ and libfastrtps-dev (Debian).
set -eu

here=$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd)
out=$here/../../../build/peers/fastdds
mkdir -p "$out"
cd "$out"
fastddsgen -replace -d . "$here/ros.idl" >fastddsgen.log 2>&1 || { cat fastddsgen.log >&2; exit 1; }
g++ -std=c++17 -O1 -I. "$here/robot.cpp" ros.cxx rosPubSubTypes.cxx -lfastrtps -lfastcdr -pthread -o robot.new
mv robot.new robot
