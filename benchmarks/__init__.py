"""Speed and memory: a module a benchmark, run from the root of the repository: ``python -m benchmarks.mapping``."""
