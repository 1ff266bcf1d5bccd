// Which kernels this machine runs.
#pragma once

#include <string>

#include "kernels.hpp"

namespace echogrid {

// Those of the widest instructions that this machine has, or, to try the others, of the ones named by the environment
// variable ECHOGRID_INSTRUCTIONS. Returns nullptr, and says why in one line, if there are none.
const Kernels* choose_kernels(std::string& why_not);

}  // namespace echogrid
