// The Python module echogrid._core. src/echogrid/_core.pyi says what it offers.
#include "bindings.hpp"
#include "instructions.hpp"
#include "pool.hpp"

namespace nb = nanobind;

namespace echogrid {

void refuse(const std::string& text) {
    const nb::object error = nb::module_::import_("echogrid.errors").attr("UsageError");
    PyErr_SetObject(error.ptr(), nb::cast(text.c_str()).ptr());
    throw nb::python_error();
}

const Kernels& kernels() {
    static std::string why_not;
    static const Kernels* const chosen = choose_kernels(why_not);
    if (!chosen) refuse(why_not);
    return *chosen;
}

namespace {

void checked_set_threads(long long count) {
    if (count < 1 || count > static_cast<long long>(max_threads))
        refuse("threads: found " + std::to_string(count) + ", expected 1 to " + std::to_string(max_threads));
    const nb::gil_scoped_release others_run;
    set_threads(static_cast<size_t>(count));
}

}  // namespace
}  // namespace echogrid

NB_MODULE(_core, module) {
    // What threads still hold when Python ends is no leak that a user could mend.
    nb::set_leak_warnings(false);
    module.def("instructions", [] { return echogrid::kernels().variant; });
    module.def("threads", &echogrid::threads);
    module.def("set_threads", &echogrid::checked_set_threads, nb::arg("count"));
    echogrid::bind_score(module);
    echogrid::bind_paper_network(module);
    echogrid::bind_set_network(module);
    echogrid::bind_cost_to_go(module);
    echogrid::bind_drive(module);
    echogrid::bind_rays(module);
}
