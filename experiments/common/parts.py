"""Studies in parts: what a command line may ask of them, and their run."""

import argparse
import time
from collections.abc import Callable, Iterable, Mapping

from echogrid.errors import EchogridError
from echogrid.mapping.registry import sensor_model


def check(
    parser: argparse.ArgumentParser,
    asked: Iterable[str],
    parts: Iterable[str],
    rooms: int | None,
    models: Iterable[str],
) -> None:
    """End the command where it asks for parts, numbers of rooms or models that there are not."""
    if unknown := set(asked) - set(parts):
        parser.error(f"found {', '.join(sorted(unknown))}, expected some of {', '.join(parts)}")
    if rooms is not None and rooms < 1:
        parser.error(f"--rooms: found {rooms}, expected at least 1")
    for name in models:
        try:
            sensor_model(name)
        except EchogridError as error:
            parser.error(str(error))


def run[S](parts: Mapping[str, Callable[[S], None]], asked: Iterable[str], study: S) -> None:
    """Run the parts that are asked for, or all, and say how long each took."""
    for name in asked or parts:
        begin = time.perf_counter()
        print(f"\n## {name}")
        parts[name](study)
        print(f"\n{name}: {(time.perf_counter() - begin) / 60:.1f} min", flush=True)
