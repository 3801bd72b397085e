"""Speed compared with a peer library, in one run on one machine: ``python scripts/benchmark.py NAME [--json]``.

Every NAME is a file of ``scripts/benchmarks`` with a function ``run``, which returns the figures of both libraries and
``ratio``, our throughput over the peer's. ``--full`` takes the camera's full size where a benchmark has two.
"""

import argparse
import importlib
import inspect
import json
import os
import platform
import sys
from pathlib import Path

import torch

FOLDER = Path(__file__).parent / "benchmarks"


def machine() -> dict[str, str | int]:
    """Processor, cores and versions, with which the figures change."""
    return {
        "processor": platform.processor() or platform.machine(),
        "cpu": torch.backends.cpu.get_cpu_capability(),
        "cores": os.cpu_count() or 1,
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def main() -> None:
    """Run one benchmark and print its figures; with ``--json`` the last line is one JSON object."""
    names = sorted(path.stem for path in FOLDER.glob("[a-z]*.py"))
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("name", choices=names)
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    parser.add_argument("--full", action="store_true", help="the camera's full size, where a benchmark has two")
    arguments = parser.parse_args()
    sys.path.insert(0, str(FOLDER))
    run = importlib.import_module(arguments.name).run
    if arguments.full and "full" not in inspect.signature(run).parameters:
        parser.error(f"{arguments.name} has one size only")
    measured = run(full=True) if arguments.full else run()
    figures = {"benchmark": arguments.name} | measured | {"machine": machine()}
    if arguments.json:
        print(json.dumps(figures))
    else:
        for key, value in figures.items():
            print(f"{key}: {value}")


if __name__ == "__main__":
    main()
