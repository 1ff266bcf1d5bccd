// What the parts of the Python module share. Each part of the core has a file bind_*.cpp.
#pragma once

#include <nanobind/nanobind.h>

#include <string>

#include "kernels.hpp"

namespace echogrid {

// Raises the UsageError of echogrid.errors, whose text is one line: where: found X, expected Y.
[[noreturn]] void refuse(const std::string& text);

// Those of this machine, or what was asked for (see instructions.hpp); refuses where they are not to be had.
const Kernels& kernels();

void bind_score(nanobind::module_& module);
void bind_paper_network(nanobind::module_& module);
void bind_set_network(nanobind::module_& module);
void bind_cost_to_go(nanobind::module_& module);
void bind_drive(nanobind::module_& module);
void bind_rays(nanobind::module_& module);

}  // namespace echogrid
