"""Two workers of `dope prep run` against one: wall-clock seconds of the same sequences, on an otherwise idle machine.

    python -m benchmarks.workers --sequences 8 --out /tmp/workers

Films the objects once, then runs each number of workers from nothing, in turn, `--repeat` times. Prints a JSON line a
run and one with the ratio of the medians; compares the shards, which do not depend on the number of workers.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import statistics
import sys
import time
from pathlib import Path

from benchmarks.kills import Run, film
from pipeline.engines import default_workers


def children_cpu_seconds() -> float:
    """User and system seconds of all finished children and theirs."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", type=int, default=8)
    parser.add_argument("--workers", type=int, default=2, help="compared with one")
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("workers"), help="scratch folder; work and shards are removed")
    options = parser.parse_args()
    out = options.out.absolute()
    film(out / "films", options.sequences)
    seconds: dict[int, list[float]] = {1: [], options.workers: []}
    shards = []
    for _ in range(options.repeat):
        for workers, taken in seconds.items():
            run = Run(out / "films", out / "run", workers)
            start, cpu = time.monotonic(), children_cpu_seconds()
            run.finish()
            taken.append(time.monotonic() - start)
            facts = {"workers": workers, "seconds": round(taken[-1], 2)}
            facts |= {
                "cpu_seconds": round(children_cpu_seconds() - cpu, 2),
                "load_before": round(os.getloadavg()[1], 2),
            }
            print(json.dumps(facts), flush=True)
            shards.append(run.bytes())
            shutil.rmtree(run.home)
    one, many = (statistics.median(taken) for taken in seconds.values())
    same = all(files == shards[0] for files in shards)
    facts = {"sequences": options.sequences, "workers": options.workers, "cpus": default_workers()}
    print(json.dumps({**facts, "times_one_worker": round(one / many, 3), "identical": same}))
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
