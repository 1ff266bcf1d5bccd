"""The compiled core; its sources lie in core/ of the repository."""

def instructions() -> str:
    """The instructions that the kernels use: "v2", "v3" or "v4" of x86-64, "neon" or "baseline".

    They are the widest that this machine has, unless the environment variable ECHOGRID_INSTRUCTIONS names others at the
    first use of a kernel.

    Raises:
        UsageError: the machine does not have those that the variable names, or none that the core was built for.
    """

def threads() -> int:
    """How many threads the core uses: at first, as many as the process may run on. No result depends on it."""

def set_threads(count: int) -> None:
    """Set the number of threads.

    Raises:
        UsageError: it is not in 1 to 256.
    """
