# A toolchain of CMake: the compiler of zig, which comes as a package of Python (ziglang). The environment says where it
# is (ECHOGRID_ZIG) and, to build for another machine, for which (ECHOGRID_ZIG_TARGET, such as aarch64-linux-gnu.2.17).
if(NOT ECHOGRID_ZIG)
  set(ECHOGRID_ZIG "$ENV{ECHOGRID_ZIG}" CACHE FILEPATH "the program zig")
  set(ECHOGRID_ZIG_TARGET "$ENV{ECHOGRID_ZIG_TARGET}" CACHE STRING "the machine to build for; none: this one")
endif()
list(APPEND CMAKE_TRY_COMPILE_PLATFORM_VARIABLES ECHOGRID_ZIG ECHOGRID_ZIG_TARGET)

set(CMAKE_CXX_COMPILER "${ECHOGRID_ZIG}" c++)
if(ECHOGRID_ZIG_TARGET)
  list(APPEND CMAKE_CXX_COMPILER -target ${ECHOGRID_ZIG_TARGET})
  string(REGEX MATCH "^[^-]+" CMAKE_SYSTEM_PROCESSOR "${ECHOGRID_ZIG_TARGET}")
  set(CMAKE_SYSTEM_NAME Linux)
else()
  # zig builds for the very processor that it runs on unless told: what chooses the kernels has to run on any.
  list(APPEND CMAKE_CXX_COMPILER -mcpu=baseline)
endif()

# CMake wants one program each to make static libraries.
foreach(tool ar ranlib)
  string(TOUPPER ${tool} name)
  set(CMAKE_${name} "${CMAKE_BINARY_DIR}/zig-${tool}")
  file(WRITE "${CMAKE_${name}}" "#!/bin/sh\nexec '${ECHOGRID_ZIG}' ${tool} \"$@\"\n")
  file(CHMOD "${CMAKE_${name}}" PERMISSIONS OWNER_READ OWNER_WRITE OWNER_EXECUTE)
endforeach()
