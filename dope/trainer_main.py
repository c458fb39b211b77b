"""`dope train` for launchers that take a module: `torchrun --nproc-per-node 2 -m dope.trainer_main SHARDS ...`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from dope.common.errors import DopeError, UsageError


def main(arguments: list[str] | None = None) -> int:
    """Parse, train, print the result; 0 finished, 1 failed, 2 wrong usage, 75 stopped with a checkpoint."""
    parser = argparse.ArgumentParser(prog="dope.trainer_main", description=__doc__)
    parser.add_argument("shards", type=Path, help="folder of shards")
    parser.add_argument("--out", type=Path, required=True, help="the run's folder")
    parser.add_argument("--preset", default=None, help="paper or nano")
    parser.add_argument("--config", type=Path, default=None, help="YAML file of settings")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one setting; repeatable")
    parser.add_argument("--resume", default="auto", help="auto, never, or a checkpoint")
    parser.add_argument("--stop-after", type=int, default=None, help="stop with a checkpoint after so many steps")
    given = parser.parse_args(arguments)

    from dope.config import load_config
    from dope.stop_signals import EXIT_STOPPED
    from dope.trainer import train

    try:
        config = load_config(given.preset, given.config, given.set)
        result = train(given.shards, given.out, config, resume=given.resume, stop_after=given.stop_after)
    except DopeError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2 if isinstance(error, UsageError) else 1
    print(f"{result['status']} at step {result['step']}: loss {result['loss']:.4f}, PCK {result['pck']}")
    return EXIT_STOPPED if result["status"] == "stopped" and given.stop_after is None else 0


if __name__ == "__main__":
    sys.exit(main())
